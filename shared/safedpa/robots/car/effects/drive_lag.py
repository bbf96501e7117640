"""A drive that follows its command slowly."""

from __future__ import annotations

from typing import Any, final

from safedpa.effects.channels import drive_of
from safedpa.effects.effect import CommandEffect, Named, Stage
from safedpa.effects.memory import follow
from safedpa.effects.parameter import Parameter
from safedpa.operations import Operations

__all__ = ["DriveLag"]


@final
class DriveLag(CommandEffect):
    """time_constant d(felt drive)/dt = drive - felt drive, for target_speed or throttle.

    The memory is the felt drive.
    """

    name = "drive_lag"
    robot = "car"
    stage = Stage.COMMAND_LAG
    equation = "time_constant d(drive_felt)/dt = drive - drive_felt"
    parameters = (Parameter("time_constant", "s", 0.0, 2.0, 0.15),)
    signature = "acceleration residual after each change of the drive, of opposite sign to the change, dying out"
    source = (
        "Astrom and Murray, Feedback Systems, 2nd ed., ch. 3; Lyons et al., DART, IEEE Intelligent Vehicles "
        "Symposium 2024 (throttle dynamics)"
    )

    def initial_memory(self, action: Named) -> Any:  # noqa: D102
        return action[drive_of(action)]

    def transform(  # noqa: D102
        self, action: Named, memory: Any, parameters: Named, period: float, operations: Operations
    ) -> tuple[Named, Any]:
        drive = drive_of(action)
        mean, memory = follow(action[drive], memory, parameters["time_constant"], period, operations)
        return {**action, drive: mean}, memory
