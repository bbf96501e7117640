"""All commands of an action that arrive late by as much: the family of each robot's ``actuator_delay``."""

from __future__ import annotations

from typing import Any

from safedpa.effects.effect import CommandEffect, Named, Stage
from safedpa.effects.memory import delayed, settled
from safedpa.effects.parameter import Parameter
from safedpa.operations import Operations

__all__ = ["ActionDelay"]


class ActionDelay(CommandEffect):
    """felt action(t) = action(t - seconds), for every command alike; the memory is the history of each."""

    name = "actuator_delay"
    stage = Stage.COMMAND_DELAY
    equation = "action_felt(t) = action(t - seconds)"
    parameters = (Parameter("seconds", "s", 0.0, 0.5, 0.1),)
    source = "dead time; Astrom and Murray, Feedback Systems, 2nd ed., ch. 9"

    def initial_memory(self, action: Named) -> Any:  # noqa: D102
        return {name: settled(command) for name, command in action.items()}

    def transform(  # noqa: D102
        self, action: Named, memory: Any, parameters: Named, period: float, operations: Operations
    ) -> tuple[Named, Any]:
        longest, felt, cached = self.parameters[0].high, {}, {}
        for name, command in action.items():
            felt[name], cached[name] = delayed(
                command, memory[name], parameters["seconds"], longest, period, operations
            )
        return felt, cached
