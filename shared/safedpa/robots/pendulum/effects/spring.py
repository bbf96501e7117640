"""A torsion spring, or a cable that pulls back."""

from __future__ import annotations

from typing import final

from safedpa.effects.effect import Context, Named, RateEffect, Stage
from safedpa.effects.parameter import Parameter

__all__ = ["Spring"]


@final
class Spring(RateEffect):
    """mass length^2 d(rate)/dt is lowered by stiffness (angle - rest_angle).

    The angle counts from upright and is not wrapped.
    """

    name = "spring"
    robot = "pendulum"
    stage = Stage.RESISTANCE
    equation = "mass length^2 d(rate)/dt -= stiffness (angle - rest_angle)"
    parameters = (
        Parameter("stiffness", "N m/rad", 0.0, 100.0, 0.5),
        Parameter("rest_angle", "rad", -6.3, 6.3, 0.0, neutral=None, meaning="where it does not pull"),
    )
    signature = "rate residual in proportion to the angle from one position, whatever the rate"
    source = "Meriam and Kraige, Engineering Mechanics: Dynamics, 6th ed., ch. 8"
    mirrored = ("rest_angle",)

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        inertia = context.base["mass"] * context.base["length"] * context.base["length"]
        torque = parameters["stiffness"] * (context.state["angle"] - parameters["rest_angle"])
        return {**rates, "rate": rates["rate"] - torque / inertia}
