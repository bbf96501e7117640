"""A steering that turns further to one side."""

from __future__ import annotations

from typing import Any, final

from safedpa.effects.effect import CommandEffect, Named, Stage
from safedpa.effects.parameter import Parameter
from safedpa.operations import Operations

__all__ = ["SteeringAsymmetry"]


@final
class SteeringAsymmetry(CommandEffect):
    """felt steer = (1 + difference / 2) steer to the left, (1 - difference / 2) steer to the right."""

    name = "steering_asymmetry"
    robot = "car"
    stage = Stage.COMMAND_LINKAGE
    equation = "steer_felt = steer + difference |steer| / 2"
    parameters = (Parameter("difference", "1", -1.0, 1.0, 0.1, meaning="gain to the left minus gain to the right"),)
    signature = "yaw-rate residual of one sign in left and right curves, none when straight"
    source = (
        "Lyons et al., DART, IEEE Intelligent Vehicles Symposium 2024, steering model (left and right curves differ)"
    )
    mirrored = ("difference",)

    def transform(  # noqa: D102
        self, action: Named, memory: Any, parameters: Named, period: float, operations: Operations
    ) -> tuple[Named, Any]:
        steer = action["steer"]
        felt = steer + 0.5 * parameters["difference"] * operations.absolute(steer)
        return {**action, "steer": felt}, memory
