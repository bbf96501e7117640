"""A steering that meets its stops."""

from __future__ import annotations

from typing import Any, final

from safedpa.effects.effect import CommandEffect, Named, Stage
from safedpa.effects.parameter import Parameter
from safedpa.operations import Operations

__all__ = ["SteeringSaturation"]


@final
class SteeringSaturation(CommandEffect):
    """felt steer = clip(steer, -limit, limit)."""

    name = "steering_saturation"
    robot = "car"
    stage = Stage.COMMAND_STOPS
    equation = "steer_felt = clip(steer, -limit, limit)"
    parameters = (
        Parameter(
            "limit", "rad", 0.02, 1.5, 0.3, neutral=1.5, meaning="neutral: beyond every steer that the car accepts"
        ),
    )
    signature = "yaw-rate residual only beyond one angle of steer, growing with the excess, on both sides"
    source = (
        "Lyons et al., DART, IEEE Intelligent Vehicles Symposium 2024, steering model (the curve flattens at the stops)"
    )

    def transform(  # noqa: D102
        self, action: Named, memory: Any, parameters: Named, period: float, operations: Operations
    ) -> tuple[Named, Any]:
        limit = parameters["limit"]
        return {**action, "steer": operations.clip(action["steer"], -limit, limit)}, memory
