"""Wind on the mass."""

from __future__ import annotations

from typing import final

from safedpa.effects.effect import Context, Named, RateEffect, Stage
from safedpa.effects.parameter import Parameter

__all__ = ["Wind"]

_CALM = 1e-12
"""m2/s2; keeps the derivative of the square root finite when the tip moves exactly with the wind."""


@final
class Wind(RateEffect):
    """torque = length (cos(angle) F_x + sin(angle) F_y), F = drag |R| R, R = wind - velocity of the tip.

    x points towards positive angles, y down, so the tip moves with length rate (cos(angle), sin(angle)), and the wind
    is (speed, -upward). The viscous friction of the original model is the effect viscous_friction here.
    """

    name = "wind"
    robot = "pendulum"
    stage = Stage.RESISTANCE
    equation = (
        "mass length^2 d(rate)/dt += length (cos(angle) F_x + sin(angle) F_y), F = drag |R| R, R = wind - tip velocity"
    )
    parameters = (
        Parameter("speed", "m/s", -15.0, 15.0, 3.0, neutral=None, meaning="towards positive angles"),
        Parameter("drag", "N s2/m2", 0.0, 2.0, 0.5),
        Parameter("upward", "m/s", -15.0, 15.0, 0.0, neutral=None, meaning="against gravity"),
    )
    signature = "rate residual of one direction in space, largest at top and bottom, none when level"
    source = "Shi et al., Meta-Adaptive Nonlinear Control, NeurIPS 2021, inverted pendulum in wind"
    mirrored = ("speed",)

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        operations, base = context.operations, context.base
        cosine, sine = operations.cos(context.state["angle"]), operations.sin(context.state["angle"])
        tip = base["length"] * context.state["rate"]
        across, down = parameters["speed"] - tip * cosine, -parameters["upward"] - tip * sine
        size = operations.sqrt(across * across + down * down + _CALM)
        torque = base["length"] * parameters["drag"] * size * (cosine * across + sine * down)
        return {**rates, "rate": rates["rate"] + torque / (base["mass"] * base["length"] * base["length"])}
