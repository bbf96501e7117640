"""A throttle that does nothing near zero."""

from __future__ import annotations

from typing import Any, final

from safedpa.effects.effect import CommandEffect, Named, Stage
from safedpa.effects.parameter import Parameter
from safedpa.operations import Operations

__all__ = ["DriveDeadZone"]


@final
class DriveDeadZone(CommandEffect):
    """felt throttle = throttle - clip(throttle, -width, width): nothing within the width, shifted beyond it."""

    name = "drive_dead_zone"
    robot = "car"
    stage = Stage.COMMAND_SCALE
    equation = "throttle_felt = throttle - clip(throttle, -width, width)"
    parameters = (Parameter("width", "1", 0.0, 0.9, 0.15),)
    signature = "acceleration residual against the throttle: grows with it up to a width, then of one size"
    source = (
        "Lyons et al., DART, IEEE Intelligent Vehicles Symposium 2024; Tao and Kokotovic, Adaptive Control of "
        "Systems, 1996, ch. 2"
    )
    needs = ("throttle",)

    def transform(  # noqa: D102
        self, action: Named, memory: Any, parameters: Named, period: float, operations: Operations
    ) -> tuple[Named, Any]:
        throttle, width = action["throttle"], parameters["width"]
        return {**action, "throttle": throttle - operations.clip(throttle, -width, width)}, memory
