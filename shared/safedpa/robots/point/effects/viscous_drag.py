"""Drag in proportion to the speed: the slides' damping."""

from __future__ import annotations

from typing import final

from safedpa.effects.effect import Context, Named, RateEffect, Stage
from safedpa.effects.parameter import Parameter

__all__ = ["ViscousDrag"]


@final
class ViscousDrag(RateEffect):
    """d(v)/dt -= coefficient v, v the velocity (vx, vy)."""

    name = "viscous_drag"
    robot = "point"
    stage = Stage.RESISTANCE
    equation = "d(v)/dt -= coefficient v, v = (vx, vy)"
    parameters = (Parameter("coefficient", "1/s", 0.0, 20.0, 0.5),)
    signature = "deceleration in proportion to the speed, in every direction"
    source = "Stokes' law; damping of a joint in MuJoCo, XML reference, joint/damping"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        state, own = context.state, parameters["coefficient"]
        return {**rates, "vx": rates["vx"] - own * state["vx"], "vy": rates["vy"] - own * state["vy"]}
