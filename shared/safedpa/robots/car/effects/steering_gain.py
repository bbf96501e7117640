"""A steering that turns more or less than it is told."""

from __future__ import annotations

from typing import Any, final

from safedpa.effects.effect import CommandEffect, Named, Stage
from safedpa.effects.parameter import Parameter
from safedpa.operations import Operations

__all__ = ["SteeringGain"]


@final
class SteeringGain(CommandEffect):
    """felt steer = gain steer."""

    name = "steering_gain"
    robot = "car"
    stage = Stage.COMMAND_SCALE
    equation = "steer_felt = gain steer"
    parameters = (Parameter("gain", "1", 0.1, 3.0, 0.85, neutral=1.0),)
    signature = "yaw-rate residual in proportion to the commanded yaw rate, the same share at every speed"
    source = "Lyons et al., DART, IEEE Intelligent Vehicles Symposium 2024, steering model"

    def transform(  # noqa: D102
        self, action: Named, memory: Any, parameters: Named, period: float, operations: Operations
    ) -> tuple[Named, Any]:
        return {**action, "steer": action["steer"] * parameters["gain"]}, memory
