"""What a robot does after an order to stop or to go; the command waits six seconds for one that does not obey."""

from typing import Any

import pytest

from safedpa.bus import StateMessage, VerdictMessage
from safedpa.bus.monitor.fleet_state import RobotOverview
from safedpa_services.command_line import stop_orders

STAMP: dict[str, Any] = {"epoch": 7, "tick": 1, "robot_time": 0.05, "publish_time": 0.0}


@pytest.mark.parametrize(
    ("do", "status", "speed", "corridor", "does"),
    [
        ("go", "passed", 1.0, False, "may drive"),
        ("go", None, 0.0, False, "may drive"),
        ("go", "stopped", 0.0, False, "stopped by an order for this robot"),
        ("stop", "stopped", 0.0, False, "is stationary"),
        ("stop", "passed", 0.02, False, "is stationary"),
        ("stop", "passed", -0.02, False, "is stationary"),
        ("stop", "passed", 0.5, False, "still drives, +0.50 m/s"),
        ("stop", None, -0.5, False, "still drives, -0.50 m/s"),
        ("stop", "stopped", 0.5, False, "still brakes, +0.50 m/s"),
        ("stop", "stopped", -0.5, False, "still brakes, -0.50 m/s"),
        ("stop", "stopped", 9.0, True, "stays in its corridor without the policy; it cannot stop"),
        ("stop", "passed", 0.0, True, "still obeys the policy"),
    ],
)
def test_a_robot_that_moves_or_obeys_the_policy_has_not_stopped(do, status, speed, corridor, does):
    state = StateMessage(
        **STAMP, values=(0.0, 0.0, 0.0, speed), applied=(1.0, 0.0), applied_by="filter", period=0.05, lockstep=False,
        goal=(), obstacles=(), field=(), footprint=(), corridor=(0.1, 0.1) if corridor else (),
    )  # fmt: skip
    verdict = None
    if status is not None:
        verdict = VerdictMessage(
            **STAMP, status=status, sentence="", action=(), nominal=(), slack=0.0, active=(), h_now=0.6, h_next=0.6,
            margin=0.02, solver="", microseconds=60.0,
        )  # fmt: skip
    robot = RobotOverview("r1", since=0.0, state=state, state_at=0.0, verdict=verdict)
    assert stop_orders._does(robot, do) == does
