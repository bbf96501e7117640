#!/usr/bin/env bash
# The filter's margin that ships with the car: twelve drives in lockstep on scenes that no experiment counts, then the
# calibration. About two minutes. Run it again whenever the car's model file or the filter's settings change.
set -euo pipefail
cd "$(dirname "$0")/.."
safedpa=${SAFEDPA:-.venv/bin/safedpa}
drives=$(mktemp -d)
trap 'rm -rf "$drives"' EXIT
for seed in 1000 1001 1002; do
    for load in none box chair large_chair; do
        "$safedpa" up --headless --lockstep --load "$load" --seed "$seed" --seconds 40 --json --out "$drives" > /dev/null
    done
done
"$safedpa" calibrate "$drives"/*/recording.mcap --out shared/safedpa/safety/named_margins/car.toml
