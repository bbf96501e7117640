#!/bin/sh
# Tries the gateway against rmw_zenoh_cpp itself: a container with ROS 2 (its router, odometry, a policy, a driver), this
# machine's safedpa in front of it; then a bag that ROS recorded is read. Needs docker or podman that can pull
# ros:jazzy-ros-base, and `pip install 'safedpa[ros,diagnosis]'` here.
#
#     deploy/ros/try.sh [humble|jazzy|kilted]
#
# It was not run where this project is made: no image of ROS could be had there. What it says is not part of any claim.
set -eu

distribution=${1:-jazzy}
here=$(cd "$(dirname "$0")" && pwd)
engine=$(command -v docker || command -v podman) || { echo "try.sh: wanted docker or podman on PATH" >&2; exit 2; }
command -v safedpa >/dev/null || { echo "try.sh: wanted safedpa on PATH: pip install 'safedpa[ros,diagnosis]'" >&2; exit 2; }
out=$(mktemp -d)
trap '"$engine" rm --force safedpa-ros >/dev/null 2>&1 || true; [ -z "${served:-}" ] || kill -INT "$served" 2>/dev/null || true' EXIT

"$engine" build --tag "safedpa-ros:$distribution" --build-arg "DISTRIBUTION=$distribution" "$here" ||
    { echo "try.sh: the image cannot be made; can ros:$distribution-ros-base be pulled here?" >&2; exit 1; }
"$engine" run --detach --name safedpa-ros --network host --volume "$out:/bags" --env SECONDS_TO_DRIVE=40 \
    "safedpa-ros:$distribution" >/dev/null
sleep 6

echo "== who is there"
safedpa ros discover tcp/127.0.0.1:7447
echo "== driven through the filter for 20 s"
safedpa serve "$here/robot.toml" --headless --no-diagnosis --out "$out/runs" >"$out/serve.log" 2>&1 &
served=$!
sleep 4
"$engine" exec safedpa-ros bash -c "source /opt/ros/$distribution/setup.bash && cd /bags && \
    timeout --signal INT 12 ros2 bag record --storage mcap --output bag /odom /drive /drive_in /diagnostics" || true
sleep 6
kill -INT "$served"; wait "$served" || true; served=
cat "$out/serve.log"
echo "== what the robot says"
"$engine" wait safedpa-ros >/dev/null
said=$("$engine" logs safedpa-ros 2>&1 | grep '"commands"' | tail -1)
echo "$said"
echo "== the bag that ROS recorded"
safedpa columns "$out/bag" --robot car >"$out/map.toml"
safedpa compare car "$out/bag" --columns "$out/map.toml" --out "$out/page"

# It held where commands came, the gateway was heard, and the car stands or drives short of the obstacle at x = 1.
printf '%s' "$said" | python3 -c '
import json, sys
found = json.loads(sys.stdin.read() or "{}")
good = found.get("commands", 0) > 100 and found.get("diagnostics", 0) > 100
near = ((found.get("x", 9) - 1.0) ** 2 + (found.get("y", 9) - 0.05) ** 2) ** 0.5
print("held" if good and near > 0.3 else "did NOT hold", found)
sys.exit(0 if good and near > 0.3 else 1)'
