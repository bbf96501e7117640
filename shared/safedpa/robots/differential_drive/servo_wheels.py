"""The base model of the differential drive: two wheels, each with a speed servo."""

from __future__ import annotations

from typing import final

from safedpa.dynamics.base import AbstractBase
from safedpa.effects.effect import Named
from safedpa.effects.parameter import Parameter
from safedpa.operations import Operations
from safedpa.robots.differential_drive.system import DIFFERENTIAL_DRIVE, TRACK


@final
class ServoWheels(AbstractBase):
    """x' = speed cos(yaw), y' = speed sin(yaw), yaw' = turn_rate, with servos for both wheel speeds w:

        w = speed -+ turn_rate track / 2 (left, right),  w' = clip(gain (target - w), +-acceleration_limit),
        speed' = (w_left' + w_right') / 2,  turn_rate' = (w_right' - w_left') / track.

    Source: Siegwart, Nourbakhsh, Scaramuzza, Introduction to Autonomous Mobile Robots, 2nd ed., section 3.2. Valid
    while no wheel slips.
    """

    kind = "servo_wheels"
    equation = "x' = v cos(yaw), y' = v sin(yaw), yaw' = turn_rate, wheel' = clip(gain (target - wheel), +-limit)"
    source = "Siegwart, Nourbakhsh, Scaramuzza, Introduction to Autonomous Mobile Robots, 2nd ed., section 3.2"

    def __init__(self) -> None:
        self.system = DIFFERENTIAL_DRIVE
        self.parameters = (
            Parameter("track", "m", 0.01, 5.0, TRACK, neutral=None, meaning="from wheel to wheel"),
            Parameter("gain", "1/s", 0.05, 100.0, 10.0, neutral=None, meaning="of a wheel's servo"),
            Parameter("acceleration_limit", "m/s2", 0.05, 50.0, 1.2, neutral=None, meaning="of a wheel"),
        )

    def rates(self, state: Named, action: Named, parameters: Named, operations: Operations) -> Named:  # noqa: D102
        half, limit = 0.5 * parameters["track"], parameters["acceleration_limit"]
        ahead = action["target_speed"] - state["speed"]
        aside = half * (action["target_turn_rate"] - state["turn_rate"])
        left = operations.clip(parameters["gain"] * (ahead - aside), -limit, limit)
        right = operations.clip(parameters["gain"] * (ahead + aside), -limit, limit)
        return {
            "x": state["speed"] * operations.cos(state["yaw"]),
            "y": state["speed"] * operations.sin(state["yaw"]),
            "yaw": state["turn_rate"],
            "speed": 0.5 * (left + right),
            "turn_rate": 0.5 * (right - left) / half,
        }
