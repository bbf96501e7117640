"""A thruster that gives more or less than it is told."""

from __future__ import annotations

from typing import Any, final

from safedpa.effects.effect import CommandEffect, Named, Stage
from safedpa.effects.parameter import Parameter
from safedpa.operations import Operations

__all__ = ["ActuatorGain"]


@final
class ActuatorGain(CommandEffect):
    """felt thrust = gain thrust."""

    name = "actuator_gain"
    robot = "point"
    stage = Stage.COMMAND_SCALE
    equation = "thrust_felt = gain thrust"
    parameters = (Parameter("gain", "1", 0.1, 3.0, 0.8, neutral=1.0),)
    signature = "acceleration residual along the heading in proportion to the thrust"
    source = "wear of a thruster; Chen and Patton, Robust Model-Based Fault Diagnosis, 1999, ch. 2"

    def transform(  # noqa: D102
        self, action: Named, memory: Any, parameters: Named, period: float, operations: Operations
    ) -> tuple[Named, Any]:
        return {**action, "thrust": action["thrust"] * parameters["gain"]}, memory
