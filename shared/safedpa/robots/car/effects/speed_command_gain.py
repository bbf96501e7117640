"""A speed servo that reads its command on another scale."""

from __future__ import annotations

from typing import Any, final

from safedpa.effects.effect import CommandEffect, Named, Stage
from safedpa.effects.parameter import Parameter
from safedpa.operations import Operations

__all__ = ["SpeedCommandGain"]


@final
class SpeedCommandGain(CommandEffect):
    """felt target_speed = gain target_speed. For a throttle this would be the base's drive_gain."""

    name = "speed_command_gain"
    robot = "car"
    stage = Stage.COMMAND_SCALE
    equation = "target_speed_felt = gain target_speed"
    parameters = (Parameter("gain", "1", 0.1, 3.0, 0.85, neutral=1.0),)
    signature = "settled speed differs from the commanded one by the same share at every speed"
    source = "static gain of a servo; Astrom and Murray, Feedback Systems, 2nd ed., ch. 3"
    needs = ("target_speed",)

    def transform(  # noqa: D102
        self, action: Named, memory: Any, parameters: Named, period: float, operations: Operations
    ) -> tuple[Named, Any]:
        return {**action, "target_speed": action["target_speed"] * parameters["gain"]}, memory
