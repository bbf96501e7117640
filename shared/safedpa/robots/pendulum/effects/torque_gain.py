"""A motor that gives more or less torque than it is told."""

from __future__ import annotations

from typing import Any, final

from safedpa.effects.effect import CommandEffect, Named, Stage
from safedpa.effects.parameter import Parameter
from safedpa.operations import Operations

__all__ = ["TorqueGain"]


@final
class TorqueGain(CommandEffect):
    """felt torque = gain torque."""

    name = "torque_gain"
    robot = "pendulum"
    stage = Stage.COMMAND_SCALE
    equation = "torque_felt = gain torque"
    parameters = (Parameter("gain", "1", 0.1, 3.0, 0.85, neutral=1.0),)
    signature = "rate residual in proportion to the torque"
    source = "torque constant of the motor; Wiebe et al., Torque-limited simple pendulum, JOSS 7(74), 2022"

    def transform(  # noqa: D102
        self, action: Named, memory: Any, parameters: Named, period: float, operations: Operations
    ) -> tuple[Named, Any]:
        return {**action, "torque": action["torque"] * parameters["gain"]}, memory
