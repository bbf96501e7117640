"""Play in the gear."""

from __future__ import annotations

from typing import Any, final

from safedpa.effects.effect import CommandEffect, Named, Stage
from safedpa.effects.parameter import Parameter
from safedpa.operations import Operations

__all__ = ["Backlash"]


@final
class Backlash(CommandEffect):
    """felt torque = clip(felt torque before, torque - width / 2, torque + width / 2).

    A change of direction is felt once it has crossed the width. The memory is the felt torque [N m].
    """

    name = "backlash"
    robot = "pendulum"
    stage = Stage.COMMAND_LINKAGE
    equation = "torque_felt = clip(torque_felt, torque - width/2, torque + width/2)"
    parameters = (Parameter("width", "N m", 0.0, 10.0, 0.1),)
    signature = "rate residual that depends on the direction of the last change of torque: a loop of hysteresis"
    source = "Tao and Kokotovic, Adaptive Control of Systems with Actuator and Sensor Nonlinearities, 1996, ch. 2"

    def initial_memory(self, action: Named) -> Any:  # noqa: D102
        return action["torque"]

    def transform(  # noqa: D102
        self, action: Named, memory: Any, parameters: Named, period: float, operations: Operations
    ) -> tuple[Named, Any]:
        half = 0.5 * parameters["width"]
        felt = operations.clip(memory, action["torque"] - half, action["torque"] + half)
        return {**action, "torque": felt}, felt
