"""A load that is towed on a hitch."""

from __future__ import annotations

from typing import final

from safedpa.effects.effect import Context, Named, RateEffect, Stage
from safedpa.effects.friction import REST_SPEED, resistance
from safedpa.effects.parameter import Parameter

__all__ = ["TowedLoad"]


@final
class TowedLoad(RateEffect):
    """A load of mass_ratio times the car's mass, which alone would slide to rest at ``deceleration``.

    (1 + mass_ratio) d(speed)/dt = drive and resistance of the car - mass_ratio deceleration sign(speed),
    the sign rounded off near rest. The hitch is assumed stiff and in line with the car.
    """

    name = "towed_load"
    robot = "car"
    stage = Stage.MASS
    equation = "(1 + mass_ratio) d(speed)/dt = acceleration - mass_ratio deceleration sign(speed)"
    parameters = (
        Parameter("mass_ratio", "1", 0.0, 5.0, 0.5, meaning="mass of the load over mass of the car"),
        Parameter(
            "deceleration", "m/s2", 0.0, 9.81, 2.0, neutral=None, meaning="friction coefficient of the load times g"
        ),
    )
    signature = "all accelerations too small by one factor, and a steady pull against the motion"
    source = "Newton's second law for two bodies on a rigid hitch, Coulomb friction under the towed one"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        ratio = parameters["mass_ratio"]
        most = ratio * parameters["deceleration"]
        pull = resistance(rates["speed"], context.state["speed"], most, REST_SPEED, context, 1.0 + ratio)
        return {**rates, "speed": (rates["speed"] - pull) / (1.0 + ratio)}
