"""Friction of constant size."""

from __future__ import annotations

from typing import final

from safedpa.effects.effect import Context, Named, RateEffect, Stage
from safedpa.effects.friction import REST_RATE, resistance
from safedpa.effects.parameter import Parameter

__all__ = ["CoulombFriction"]


@final
class CoulombFriction(RateEffect):
    """mass length^2 d(rate)/dt is lowered by torque sign(rate), the sign rounded off near rest."""

    name = "coulomb_friction"
    robot = "pendulum"
    stage = Stage.RESISTANCE
    equation = "mass length^2 d(rate)/dt -= torque sign(rate)"
    parameters = (Parameter("torque", "N m", 0.0, 10.0, 0.1),)
    signature = "rate residual of one size at every rate, against the motion; changes sign with it"
    source = (
        "Armstrong-Helouvry et al., A survey of models with friction, Automatica 30, 1994, section 2; Wiebe "
        "et al., Torque-limited simple pendulum, JOSS 7(74), 2022"
    )

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        inertia = context.base["mass"] * context.base["length"] * context.base["length"]
        deceleration = parameters["torque"] / inertia
        held = resistance(rates["rate"], context.state["rate"], deceleration, REST_RATE, context)
        return {**rates, "rate": rates["rate"] - held}
