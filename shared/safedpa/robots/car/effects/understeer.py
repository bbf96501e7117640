"""Understeer: the curve widens with the speed."""

from __future__ import annotations

from typing import final

from safedpa.effects.effect import Context, Named, RateEffect, Stage
from safedpa.effects.parameter import Parameter

__all__ = ["Understeer"]


@final
class Understeer(RateEffect):
    """yaw rate = speed tan(steer) / (wheelbase + gradient speed^2).

    A negative gradient is oversteer. The denominator is at least a quarter of the wheelbase: below that the
    steady-state formula is not valid (the car would spin).
    """

    name = "understeer"
    robot = "car"
    stage = Stage.MOTION
    equation = "d(yaw)/dt = speed tan(steer) / (wheelbase + gradient speed^2)"
    parameters = (
        Parameter(
            "gradient", "s2/m", -0.05, 1.0, 0.02, meaning="angle of steer per lateral acceleration; below 0: oversteer"
        ),
    )
    signature = "yaw-rate residual against the curve that grows with the cube of speed; none at low speed"
    source = "Rajamani, Vehicle Dynamics and Control, 2nd ed., section 3.3 (understeer gradient)"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        speed, wheelbase = context.state["speed"], context.base["wheelbase"]
        effective = context.operations.maximum(wheelbase + parameters["gradient"] * speed * speed, 0.25 * wheelbase)
        return {**rates, "yaw": rates["yaw"] * (wheelbase / effective)}
