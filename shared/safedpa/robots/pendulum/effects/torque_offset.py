"""A motor that pulls to one side when nothing is asked."""

from __future__ import annotations

from typing import Any, final

from safedpa.effects.effect import CommandEffect, Named, Stage
from safedpa.effects.parameter import Parameter
from safedpa.operations import Operations

__all__ = ["TorqueOffset"]


@final
class TorqueOffset(CommandEffect):
    """felt torque = torque + offset."""

    name = "torque_offset"
    robot = "pendulum"
    stage = Stage.COMMAND_OFFSET
    equation = "torque_felt = torque + offset"
    parameters = (Parameter("offset", "N m", -5.0, 5.0, 0.1),)
    signature = "rate residual of one size and sign, whatever angle, rate and torque"
    source = "Wiebe et al., Torque-limited simple pendulum, JOSS 7(74), 2022"
    mirrored = ("offset",)

    def transform(  # noqa: D102
        self, action: Named, memory: Any, parameters: Named, period: float, operations: Operations
    ) -> tuple[Named, Any]:
        return {**action, "torque": action["torque"] + parameters["offset"]}, memory
