"""A true wheel radius that differs from the one that the driver assumes: worn, soft or replaced tyres."""

from __future__ import annotations

from typing import Any, final

from safedpa.effects.effect import CommandEffect, Named, Stage
from safedpa.effects.parameter import Parameter
from safedpa.operations import Operations

__all__ = ["WheelRadius"]


@final
class WheelRadius(CommandEffect):
    """felt target_speed = ratio target_speed, felt target_turn_rate = ratio target_turn_rate."""

    name = "wheel_radius"
    robot = "differential_drive"
    stage = Stage.COMMAND_SCALE
    equation = "action_felt = ratio action"
    parameters = (Parameter("ratio", "1", 0.3, 3.0, 0.9, neutral=1.0, meaning="true radius over assumed radius"),)
    signature = "speeds and turn rates off by the same factor"
    source = "Borenstein, Feng, Measurement and Correction of Systematic Odometry Errors, IEEE T-RA 12(6), 1996"

    def transform(  # noqa: D102
        self, action: Named, memory: Any, parameters: Named, period: float, operations: Operations
    ) -> tuple[Named, Any]:
        return {name: parameters["ratio"] * command for name, command in action.items()}, memory
