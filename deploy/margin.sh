#!/usr/bin/env bash
# The filter's margin that ships with a model of the car: twelve drives in lockstep on scenes that no experiment counts,
# then the calibration. About two minutes. Run it again whenever the model or the filter's settings change.
#   deploy/margin.sh [car | car_learned]
set -euo pipefail
cd "$(dirname "$0")/.."
model=${1:-car}
safedpa=${SAFEDPA:-.venv/bin/safedpa}
drives=$(mktemp -d)
trap 'rm -rf "$drives"' EXIT
for seed in 1000 1001 1002; do
    for load in none box chair large_chair; do
        "$safedpa" up --model "$model" --headless --lockstep --load "$load" --seed "$seed" --seconds 40 --json \
            --out "$drives" > /dev/null
    done
done
"$safedpa" calibrate "$drives"/*/recording.mcap --model "$model" \
    --out "shared/safedpa/safety/named_margins/$model.toml"
