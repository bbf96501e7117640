"""Mass that was added at the tip."""

from __future__ import annotations

from typing import final

from safedpa.effects.effect import Context, Named, RateEffect, Stage
from safedpa.effects.parameter import Parameter

__all__ = ["TipMass"]


@final
class TipMass(RateEffect):
    """(base mass + mass) length^2 d(rate)/dt = torques with the base mass + mass gravity length sin(angle)."""

    name = "tip_mass"
    robot = "pendulum"
    stage = Stage.MASS
    equation = "(base mass + mass) length^2 d(rate)/dt = torque + (base mass + mass) gravity length sin(angle)"
    parameters = (Parameter("mass", "kg", 0.0, 100.0, 0.1),)
    signature = "rate residual against the torque, in proportion to it; gravity alone fits"
    source = "Newton's second law for a point mass; Goldstein, Classical Mechanics, 3rd ed., ch. 1"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        base = context.base
        share = parameters["mass"] / (base["mass"] + parameters["mass"])
        free_fall = base["gravity"] / base["length"] * context.operations.sin(context.state["angle"])
        return {**rates, "rate": rates["rate"] + share * (free_fall - rates["rate"])}
