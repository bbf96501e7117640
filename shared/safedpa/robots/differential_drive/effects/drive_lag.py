"""Motors that follow their commands slowly."""

from __future__ import annotations

from typing import Any, final

from safedpa.effects.effect import CommandEffect, Named, Stage
from safedpa.effects.memory import follow
from safedpa.effects.parameter import Parameter
from safedpa.operations import Operations

__all__ = ["DriveLag"]


@final
class DriveLag(CommandEffect):
    """time_constant d(felt action)/dt = action - felt action, for both commands; the memory is what is felt."""

    name = "drive_lag"
    robot = "differential_drive"
    stage = Stage.COMMAND_LAG
    equation = "time_constant d(action_felt)/dt = action - action_felt"
    parameters = (Parameter("time_constant", "s", 0.0, 2.0, 0.15),)
    signature = "residuals of acceleration after each change of a command, against the change, dying out"
    source = "Astrom and Murray, Feedback Systems, 2nd ed., ch. 3"

    def initial_memory(self, action: Named) -> Any:  # noqa: D102
        return dict(action)

    def transform(  # noqa: D102
        self, action: Named, memory: Any, parameters: Named, period: float, operations: Operations
    ) -> tuple[Named, Any]:
        felt, cached = {}, {}
        for name, command in action.items():
            felt[name], cached[name] = follow(command, memory[name], parameters["time_constant"], period, operations)
        return felt, cached
