"""A drive that answers late."""

from __future__ import annotations

from typing import Any, final

from safedpa.effects.channels import drive_of
from safedpa.effects.effect import CommandEffect, Named, Stage
from safedpa.effects.memory import delayed, settled
from safedpa.effects.parameter import Parameter
from safedpa.operations import Operations

__all__ = ["DriveDelay"]


@final
class DriveDelay(CommandEffect):
    """felt drive(t) = drive(t - seconds), for target_speed or throttle; the memory is the history of the command."""

    name = "drive_delay"
    robot = "car"
    stage = Stage.COMMAND_DELAY
    equation = "drive_felt(t) = drive(t - seconds)"
    parameters = (Parameter("seconds", "s", 0.0, 0.5, 0.1),)
    signature = (
        "acceleration residual after each change of the drive, as if the command had not been sent yet, then none"
    )
    source = "dead time; Astrom and Murray, Feedback Systems, 2nd ed., ch. 9"

    def initial_memory(self, action: Named) -> Any:  # noqa: D102
        return settled(action[drive_of(action)])

    def transform(  # noqa: D102
        self, action: Named, memory: Any, parameters: Named, period: float, operations: Operations
    ) -> tuple[Named, Any]:
        drive, longest = drive_of(action), self.parameters[0].high
        felt, memory = delayed(action[drive], memory, parameters["seconds"], longest, period, operations)
        return {**action, drive: felt}, memory
