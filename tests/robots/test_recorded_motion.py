"""Simulated robots move as they were recorded: a parameter that is lost, or a load that is not attached, shows here.

``motions.json`` has the states; ``python tests/robots/test_recorded_motion.py`` records them again, after a change of
the simulation that is meant.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from safedpa.bus.messages.messages import ActionMessage
from safedpa.systems.robots import robot_named
from safedpa_sim.robots import LOADS
from safedpa_sim.robots.__main__ import robot_parser
from safedpa_sim.robots.robot_factory import make_robot

RECORD = Path(__file__).with_name("motions.json")
ROBOTS = (
    *(f"--robot car --load {load}" for load in ("none", *LOADS)),
    "--robot car --drive throttle",
    "--robot car --change hitch --change-after 1",
    "--robot car --change headwind --change-after 1",
    "--robot car --load chair --change steering_offset --change-after 1",
    "--robot pendulum --task swing --wind 1.5 --wind-direction 30 --payload 0.2 --dry-friction 0.05",
    "--robot pendulum --task balance",
    "--robot point --force 0.005 --wind-direction 60",
    "--robot differential_drive",
)
TICKS, EVERY = 120, 30


def motion(line: str) -> dict[str, Any]:
    """What the robot says of itself, and states under slowly changing actions, one of every 30 ticks."""
    options = robot_parser().parse_args([*line.split(), "--seed", "3", "--lockstep"])
    options.rate = robot_named(options.robot).rate
    robot = make_robot(options)
    low, high = np.array(robot.guard.low), np.array(robot.guard.high)
    found = []
    for tick in range(TICKS):
        share = 0.5 + 0.45 * np.sin(0.11 * tick + np.arange(len(low)))
        values = tuple((low + share * (high - low)).tolist())
        stamp: dict[str, Any] = {"epoch": robot.guard.epoch, "tick": robot.tick, "robot_time": 0.0, "publish_time": 0.0}
        assert robot.receive(ActionMessage(**stamp, values=values)) is None
        robot.advance()
        if (tick + 1) % EVERY == 0:
            found.append([float(f"{value:.9g}") for value in robot.values])
    return {"about": json.loads(json.dumps(robot.about)), "states": found}


@pytest.mark.parametrize("line", ROBOTS)
def test_a_simulated_robot_moves_as_recorded(line: str) -> None:
    wanted = json.loads(RECORD.read_text(encoding="utf-8"))[line]
    found = motion(line)
    assert found["about"] == wanted["about"]
    np.testing.assert_allclose(found["states"], wanted["states"], rtol=1e-5, atol=1e-6)


if __name__ == "__main__":
    lines = [f"{json.dumps(line)}: {json.dumps(motion(line))}" for line in ROBOTS]
    RECORD.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
