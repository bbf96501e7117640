"""Air drag."""

from __future__ import annotations

from typing import final

from safedpa.effects.effect import Context, Named, RateEffect, Stage
from safedpa.effects.parameter import Parameter

__all__ = ["QuadraticDrag"]


@final
class QuadraticDrag(RateEffect):
    """d(speed)/dt is lowered by coefficient |speed| speed; coefficient = rho C_d A / (2 m) [1/m]."""

    name = "quadratic_drag"
    robot = "car"
    stage = Stage.RESISTANCE
    equation = "d(speed)/dt -= coefficient |speed| speed"
    parameters = (Parameter("coefficient", "1/m", 0.0, 2.0, 0.12),)
    signature = "deceleration residual grows with the square of speed; nothing at standstill; no side preference"
    source = "Gillespie, Fundamentals of Vehicle Dynamics, ch. 4"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        speed = context.state["speed"]
        drag = parameters["coefficient"] * context.operations.absolute(speed) * speed
        return {**rates, "speed": rates["speed"] - drag}
