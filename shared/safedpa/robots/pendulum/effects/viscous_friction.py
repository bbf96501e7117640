"""Friction that grows with the rate."""

from __future__ import annotations

from typing import final

from safedpa.effects.effect import Context, Named, RateEffect, Stage
from safedpa.effects.parameter import Parameter

__all__ = ["ViscousFriction"]


@final
class ViscousFriction(RateEffect):
    """mass length^2 d(rate)/dt is lowered by coefficient rate; coefficient in N m s/rad."""

    name = "viscous_friction"
    robot = "pendulum"
    stage = Stage.RESISTANCE
    equation = "mass length^2 d(rate)/dt -= coefficient rate"
    parameters = (Parameter("coefficient", "N m s/rad", 0.0, 5.0, 0.1),)
    signature = "rate residual proportional to the rate and against it, whatever the angle"
    source = "Wiebe et al., Torque-limited simple pendulum, JOSS 7(74), 2022"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        inertia = context.base["mass"] * context.base["length"] * context.base["length"]
        torque = parameters["coefficient"] * context.state["rate"]
        return {**rates, "rate": rates["rate"] - torque / inertia}
