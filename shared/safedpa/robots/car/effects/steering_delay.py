"""A steering that answers late."""

from __future__ import annotations

from typing import Any, final

from safedpa.effects.effect import CommandEffect, Named, Stage
from safedpa.effects.memory import delayed, settled
from safedpa.effects.parameter import Parameter
from safedpa.operations import Operations

__all__ = ["SteeringDelay"]


@final
class SteeringDelay(CommandEffect):
    """felt steer(t) = steer(t - seconds); the memory is the history of the command."""

    name = "steering_delay"
    robot = "car"
    stage = Stage.COMMAND_DELAY
    equation = "steer_felt(t) = steer(t - seconds)"
    parameters = (Parameter("seconds", "s", 0.0, 0.5, 0.1),)
    signature = "yaw-rate residual after each change of steer, as if the command had not been sent yet, then none"
    source = "dead time; Astrom and Murray, Feedback Systems, 2nd ed., ch. 9"

    def initial_memory(self, action: Named) -> Any:  # noqa: D102
        return settled(action["steer"])

    def transform(  # noqa: D102
        self, action: Named, memory: Any, parameters: Named, period: float, operations: Operations
    ) -> tuple[Named, Any]:
        longest = self.parameters[0].high
        felt, memory = delayed(action["steer"], memory, parameters["seconds"], longest, period, operations)
        return {**action, "steer": felt}, memory
