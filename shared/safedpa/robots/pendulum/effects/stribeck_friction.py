"""Extra friction near rest that fades with the rate."""

from __future__ import annotations

from typing import final

from safedpa.effects.effect import Context, Named, RateEffect, Stage
from safedpa.effects.friction import REST_RATE, resistance
from safedpa.effects.parameter import Parameter

__all__ = ["StribeckFriction"]


@final
class StribeckFriction(RateEffect):
    """mass length^2 d(rate)/dt is lowered by torque exp(-(rate / fading_rate)^2) sign(rate).

    The sign is rounded off near rest. Together with coulomb_friction, it is the difference between breakaway and
    sliding friction.
    """

    name = "stribeck_friction"
    robot = "pendulum"
    stage = Stage.RESISTANCE
    equation = "mass length^2 d(rate)/dt -= torque exp(-(rate/fading_rate)^2) sign(rate)"
    parameters = (
        Parameter("torque", "N m", 0.0, 10.0, 0.05),
        Parameter("fading_rate", "rad/s", 0.05, 20.0, 0.5, neutral=None, meaning="at which 37 % of it is left"),
    )
    signature = "rate residual against the motion at low rates only"
    source = "Armstrong-Helouvry et al., A survey of models with friction, Automatica 30, 1994, section 2 (Stribeck)"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        inertia = context.base["mass"] * context.base["length"] * context.base["length"]
        rate, deceleration = context.state["rate"], parameters["torque"] / inertia
        fading = context.operations.exp(-((rate / parameters["fading_rate"]) * (rate / parameters["fading_rate"])))
        held = resistance(rates["rate"], rate, deceleration, REST_RATE, context)  # at rest nothing has faded
        return {**rates, "rate": rates["rate"] - fading * held}
