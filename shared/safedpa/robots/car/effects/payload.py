"""Mass on board."""

from __future__ import annotations

from typing import final

from safedpa.effects.effect import Context, Named, RateEffect, Stage
from safedpa.effects.parameter import Parameter

__all__ = ["Payload"]


@final
class Payload(RateEffect):
    """(1 + mass_ratio) d(speed)/dt = drive and resistance of the empty car.

    Rolling resistance and cornering resistance keep their deceleration: those forces grow with the weight.
    """

    name = "payload"
    robot = "car"
    stage = Stage.OWN_MASS
    equation = "(1 + mass_ratio) d(speed)/dt = acceleration of the empty car"
    parameters = (Parameter("mass_ratio", "1", 0.0, 5.0, 0.3, meaning="mass of the load over mass of the empty car"),)
    signature = "all accelerations too small by one factor, speeding up and slowing down alike"
    source = "Newton's second law; Gillespie, Fundamentals of Vehicle Dynamics, SAE 1992, ch. 2"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        return {**rates, "speed": rates["speed"] / (1.0 + parameters["mass_ratio"])}
