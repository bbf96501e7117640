"""A true track that differs from the one that the driver assumes."""

from __future__ import annotations

from typing import Any, final

from safedpa.effects.effect import CommandEffect, Named, Stage
from safedpa.effects.parameter import Parameter
from safedpa.operations import Operations

__all__ = ["TrackError"]


@final
class TrackError(CommandEffect):
    """felt target_turn_rate = target_turn_rate / ratio."""

    name = "track_error"
    robot = "differential_drive"
    stage = Stage.COMMAND_SCALE
    equation = "target_turn_rate_felt = target_turn_rate / ratio"
    parameters = (Parameter("ratio", "1", 0.3, 3.0, 1.1, neutral=1.0, meaning="true track over assumed track"),)
    signature = "turn rates off by one factor, speeds not"
    source = "Borenstein, Feng, Measurement and Correction of Systematic Odometry Errors, IEEE T-RA 12(6), 1996 (E_b)"

    def transform(  # noqa: D102
        self, action: Named, memory: Any, parameters: Named, period: float, operations: Operations
    ) -> tuple[Named, Any]:
        return {**action, "target_turn_rate": action["target_turn_rate"] / parameters["ratio"]}, memory
