"""A motor whose torque follows its command slowly."""

from __future__ import annotations

from typing import Any, final

from safedpa.effects.effect import CommandEffect, Named, Stage
from safedpa.effects.memory import follow
from safedpa.effects.parameter import Parameter
from safedpa.operations import Operations

__all__ = ["TorqueLag"]


@final
class TorqueLag(CommandEffect):
    """time_constant d(felt torque)/dt = torque - felt torque; the memory is the felt torque [N m]."""

    name = "torque_lag"
    robot = "pendulum"
    stage = Stage.COMMAND_LAG
    equation = "time_constant d(torque_felt)/dt = torque - torque_felt"
    parameters = (Parameter("time_constant", "s", 0.0, 1.0, 0.02),)
    signature = "rate residual after each change of torque, of opposite sign to the change, dying out"
    source = "Astrom and Murray, Feedback Systems, 2nd ed., ch. 3"

    def initial_memory(self, action: Named) -> Any:  # noqa: D102
        return action["torque"]

    def transform(  # noqa: D102
        self, action: Named, memory: Any, parameters: Named, period: float, operations: Operations
    ) -> tuple[Named, Any]:
        mean, memory = follow(action["torque"], memory, parameters["time_constant"], period, operations)
        return {**action, "torque": mean}, memory
