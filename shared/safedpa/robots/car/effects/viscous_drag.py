"""Resistance in proportion to the speed."""

from __future__ import annotations

from typing import final

from safedpa.effects.effect import Context, Named, RateEffect, Stage
from safedpa.effects.parameter import Parameter

__all__ = ["ViscousDrag"]


@final
class ViscousDrag(RateEffect):
    """d(speed)/dt is lowered by coefficient speed.

    Causes: bearings, drive train, and the part of rolling resistance that grows with the speed.
    """

    name = "viscous_drag"
    robot = "car"
    stage = Stage.RESISTANCE
    equation = "d(speed)/dt -= coefficient speed"
    parameters = (Parameter("coefficient", "1/s", 0.0, 10.0, 0.3),)
    signature = "deceleration residual in proportion to the speed, forwards and backwards alike, whatever the drive"
    source = "Gillespie, Fundamentals of Vehicle Dynamics, SAE 1992, ch. 4 (rolling resistance that grows with speed)"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        return {**rates, "speed": rates["speed"] - parameters["coefficient"] * context.state["speed"]}
