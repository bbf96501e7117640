"""Mass on board."""

from __future__ import annotations

from typing import final

from safedpa.effects.effect import Context, Named, RateEffect, Stage
from safedpa.effects.parameter import Parameter

__all__ = ["Payload"]


@final
class Payload(RateEffect):
    """(1 + mass_ratio) d(speed, turn_rate)/dt = acceleration of the empty robot.

    The load is assumed to be distributed like the robot's own mass.
    """

    name = "payload"
    robot = "differential_drive"
    stage = Stage.OWN_MASS
    equation = "(1 + mass_ratio) d(speed, turn_rate)/dt = that of the empty robot"
    parameters = (Parameter("mass_ratio", "1", 0.0, 5.0, 0.3, meaning="mass of the load over mass of the robot"),)
    signature = "all accelerations too small by one factor, those of turning as well"
    source = "Newton's second law"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        del context
        share = 1.0 / (1.0 + parameters["mass_ratio"])
        return {**rates, "speed": rates["speed"] * share, "turn_rate": rates["turn_rate"] * share}
