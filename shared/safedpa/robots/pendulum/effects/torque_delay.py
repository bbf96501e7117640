"""A motor that answers late."""

from __future__ import annotations

from typing import Any, final

from safedpa.effects.effect import CommandEffect, Named, Stage
from safedpa.effects.memory import delayed, settled
from safedpa.effects.parameter import Parameter
from safedpa.operations import Operations

__all__ = ["TorqueDelay"]


@final
class TorqueDelay(CommandEffect):
    """felt torque(t) = torque(t - seconds); the memory is the history of the command."""

    name = "torque_delay"
    robot = "pendulum"
    stage = Stage.COMMAND_DELAY
    equation = "torque_felt(t) = torque(t - seconds)"
    parameters = (Parameter("seconds", "s", 0.0, 0.2, 0.02),)
    signature = "rate residual after each change of torque, as if the command had not been sent yet, then none"
    source = "dead time; Astrom and Murray, Feedback Systems, 2nd ed., ch. 9"

    def initial_memory(self, action: Named) -> Any:  # noqa: D102
        return settled(action["torque"])

    def transform(  # noqa: D102
        self, action: Named, memory: Any, parameters: Named, period: float, operations: Operations
    ) -> tuple[Named, Any]:
        longest = self.parameters[0].high
        felt, memory = delayed(action["torque"], memory, parameters["seconds"], longest, period, operations)
        return {**action, "torque": felt}, memory
