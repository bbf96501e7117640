"""Resistance of constant size."""

from __future__ import annotations

from typing import final

from safedpa.effects.effect import Context, Named, RateEffect, Stage
from safedpa.effects.friction import REST_SPEED, resistance
from safedpa.effects.parameter import Parameter

__all__ = ["RollingResistance"]


@final
class RollingResistance(RateEffect):
    """d(speed)/dt is lowered by deceleration sign(speed), the sign rounded off near rest.

    deceleration = coefficient of rolling resistance times g. Mass on board does not change it: the force grows with
    the weight.
    """

    name = "rolling_resistance"
    robot = "car"
    stage = Stage.WEIGHT
    equation = "d(speed)/dt -= deceleration sign(speed)"
    parameters = (Parameter("deceleration", "m/s2", 0.0, 5.0, 0.4),)
    signature = "deceleration residual of one size at every speed, against the motion; changes sign with it"
    source = "Gillespie, Fundamentals of Vehicle Dynamics, SAE 1992, ch. 4 (rolling resistance)"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        pull = resistance(rates["speed"], context.state["speed"], parameters["deceleration"], REST_SPEED, context)
        return {**rates, "speed": rates["speed"] - pull}
