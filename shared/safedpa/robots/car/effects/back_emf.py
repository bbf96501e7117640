"""A motor that pulls less the faster it turns."""

from __future__ import annotations

from typing import final

from safedpa.effects.effect import Context, Named, RateEffect, Stage
from safedpa.effects.parameter import Parameter

__all__ = ["BackEmf"]


@final
class BackEmf(RateEffect):
    """d(speed)/dt is lowered by coefficient |throttle| speed.

    The motor's own voltage opposes the battery's for the share of time in which the chopper connects them. Unlike drag,
    the effect vanishes when the throttle is released.
    """

    name = "back_emf"
    robot = "car"
    stage = Stage.DRIVE
    equation = "d(speed)/dt -= coefficient |throttle| speed"
    parameters = (Parameter("coefficient", "1/s", 0.0, 20.0, 1.0),)
    signature = "acceleration residual in proportion to speed times throttle; none while coasting"
    source = "Lyons et al., DART, IEEE Intelligent Vehicles Symposium 2024 (motor force); Mohan, Electric Drives, ch. 7"
    needs = ("throttle",)

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        engaged = context.operations.absolute(context.action["throttle"])
        loss = parameters["coefficient"] * engaged * context.state["speed"]
        return {**rates, "speed": rates["speed"] - loss}
