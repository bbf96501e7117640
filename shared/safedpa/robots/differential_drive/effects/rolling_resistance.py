"""Castors and carpet: a deceleration against the motion."""

from __future__ import annotations

from typing import final

from safedpa.effects.effect import Context, Named, RateEffect, Stage
from safedpa.effects.friction import REST_SPEED, resistance
from safedpa.effects.parameter import Parameter

__all__ = ["RollingResistance"]


@final
class RollingResistance(RateEffect):
    """d(speed)/dt -= deceleration sign(speed), the sign rounded off near rest; mass on board does not change it."""

    name = "rolling_resistance"
    robot = "differential_drive"
    stage = Stage.WEIGHT
    equation = "d(speed)/dt -= deceleration sign(speed)"
    parameters = (Parameter("deceleration", "m/s2", 0.0, 10.0, 0.3),)
    signature = "one deceleration at every speed, none at rest: it stays below the commanded speed"
    source = "Gillespie, Fundamentals of Vehicle Dynamics, SAE 1992, ch. 4"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        pull = resistance(rates["speed"], context.state["speed"], parameters["deceleration"], REST_SPEED, context)
        return {**rates, "speed": rates["speed"] - pull}
