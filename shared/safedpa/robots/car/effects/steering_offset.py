"""A steering that is not centred."""

from __future__ import annotations

from typing import Any, final

from safedpa.effects.effect import CommandEffect, Named, Stage
from safedpa.effects.parameter import Parameter
from safedpa.operations import Operations

__all__ = ["SteeringOffset"]


@final
class SteeringOffset(CommandEffect):
    """felt steer = steer + angle."""

    name = "steering_offset"
    robot = "car"
    stage = Stage.COMMAND_OFFSET
    equation = "steer_felt = steer + angle"
    parameters = (Parameter("angle", "rad", -0.3, 0.3, 0.03),)
    signature = "yaw-rate residual in proportion to the speed, the same for left, right and straight"
    source = "Lyons et al., DART, IEEE Intelligent Vehicles Symposium 2024, steering model"
    mirrored = ("angle",)

    def transform(  # noqa: D102
        self, action: Named, memory: Any, parameters: Named, period: float, operations: Operations
    ) -> tuple[Named, Any]:
        return {**action, "steer": action["steer"] + parameters["angle"]}, memory
