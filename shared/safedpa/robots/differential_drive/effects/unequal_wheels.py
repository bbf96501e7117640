"""Unequal wheel radii, for example because of a soft tyre."""

from __future__ import annotations

from typing import Any, final

from safedpa.effects.effect import CommandEffect, Named, Stage
from safedpa.effects.parameter import Parameter
from safedpa.operations import Operations

__all__ = ["UnequalWheels"]


@final
class UnequalWheels(CommandEffect):
    """felt target_turn_rate = target_turn_rate + pull target_speed."""

    name = "unequal_wheels"
    robot = "differential_drive"
    stage = Stage.COMMAND_LINKAGE
    equation = "target_turn_rate_felt = target_turn_rate + pull target_speed"
    parameters = (
        Parameter("pull", "rad/m", -5.0, 5.0, 0.2, meaning="difference of the radii over their mean, over the track"),
    )
    mirrored = ("pull",)
    signature = "it drives a curve at command straight ahead, more at higher speed"
    source = "Borenstein, Feng, Measurement and Correction of Systematic Odometry Errors, IEEE T-RA 12(6), 1996 (E_d)"

    def transform(  # noqa: D102
        self, action: Named, memory: Any, parameters: Named, period: float, operations: Operations
    ) -> tuple[Named, Any]:
        turn = action["target_turn_rate"] + parameters["pull"] * action["target_speed"]
        return {**action, "target_turn_rate": turn}, memory
