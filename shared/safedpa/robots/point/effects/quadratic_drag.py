"""Drag with the square of the speed: air or water."""

from __future__ import annotations

from typing import final

from safedpa.effects.effect import Context, Named, RateEffect, Stage
from safedpa.effects.parameter import Parameter

__all__ = ["QuadraticDrag"]

_REST = 1e-12
"""m2/s2 added under the root, so that its derivative is defined at rest."""


@final
class QuadraticDrag(RateEffect):
    """d(v)/dt -= coefficient |v| v, v the velocity (vx, vy)."""

    name = "quadratic_drag"
    robot = "point"
    stage = Stage.RESISTANCE
    equation = "d(v)/dt -= coefficient |v| v, v = (vx, vy)"
    parameters = (Parameter("coefficient", "1/m", 0.0, 20.0, 0.4),)
    signature = "deceleration that grows with the square of the speed, in every direction"
    source = "Hoerner, Fluid-Dynamic Drag, 1965, ch. 1"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        state = context.state
        speed = context.operations.sqrt(state["vx"] * state["vx"] + state["vy"] * state["vy"] + _REST)
        own = parameters["coefficient"] * speed
        return {**rates, "vx": rates["vx"] - own * state["vx"], "vy": rates["vy"] - own * state["vy"]}
