"""A steering actuator that follows its command slowly."""

from __future__ import annotations

from typing import Any, final

from safedpa.effects.effect import CommandEffect, Named, Stage
from safedpa.effects.memory import follow
from safedpa.effects.parameter import Parameter
from safedpa.operations import Operations

__all__ = ["SteeringLag"]


@final
class SteeringLag(CommandEffect):
    """time_constant d(felt steer)/dt = steer - felt steer; the memory is the felt steer [rad]."""

    name = "steering_lag"
    robot = "car"
    stage = Stage.COMMAND_LAG
    equation = "time_constant d(steer_felt)/dt = steer - steer_felt"
    parameters = (Parameter("time_constant", "s", 0.0, 1.0, 0.15),)
    signature = "yaw-rate residual after each change of steer, of opposite sign to the change, dying out"
    source = "first-order actuator; Astrom and Murray, Feedback Systems, ch. 3"

    def initial_memory(self, action: Named) -> Any:  # noqa: D102
        return action["steer"]

    def transform(  # noqa: D102
        self, action: Named, memory: Any, parameters: Named, period: float, operations: Operations
    ) -> tuple[Named, Any]:
        mean, memory = follow(action["steer"], memory, parameters["time_constant"], period, operations)
        return {**action, "steer": mean}, memory
