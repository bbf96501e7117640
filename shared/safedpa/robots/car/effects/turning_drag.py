"""Resistance that steering adds."""

from __future__ import annotations

from typing import final

from safedpa.effects.effect import Context, Named, RateEffect, Stage
from safedpa.effects.parameter import Parameter

__all__ = ["TurningDrag"]


@final
class TurningDrag(RateEffect):
    """d(speed)/dt is lowered by coefficient |speed| speed steer^2.

    The tyres' side force grows with speed^2 steer and has a part steer against the motion. Mass on board does not
    change it: the side force grows with the mass.
    """

    name = "turning_drag"
    robot = "car"
    stage = Stage.WEIGHT
    equation = "d(speed)/dt -= coefficient |speed| speed steer^2"
    parameters = (Parameter("coefficient", "1/m", 0.0, 10.0, 2.0, meaning="about half of 1 / wheelbase, by theory"),)
    signature = (
        "deceleration residual in curves only, growing with the square of speed and of steer, the same to both sides"
    )
    source = (
        "Lyons et al., DART, IEEE Intelligent Vehicles Symposium 2024; Gillespie, Fundamentals of Vehicle "
        "Dynamics, ch. 6"
    )

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        speed, steer = context.state["speed"], context.action["steer"]
        drag = parameters["coefficient"] * context.operations.absolute(speed) * speed * steer * steer
        return {**rates, "speed": rates["speed"] - drag}
