"""A steady push: wind, or a sloping table."""

from __future__ import annotations

from typing import final

from safedpa.effects.effect import Context, Named, RateEffect, Stage
from safedpa.effects.parameter import Parameter

__all__ = ["ConstantForce"]


@final
class ConstantForce(RateEffect):
    """d(vx, vy)/dt += (ax, ay), in the world's frame."""

    name = "constant_force"
    robot = "point"
    stage = Stage.RESISTANCE
    equation = "d(vx)/dt += ax, d(vy)/dt += ay"
    parameters = (
        Parameter("ax", "m/s2", -20.0, 20.0, 0.8, meaning="force over the robot's own mass"),
        Parameter("ay", "m/s2", -20.0, 20.0, 0.8, meaning="force over the robot's own mass"),
    )
    mirrored = ("ay",)
    signature = "one constant acceleration in the world's frame, whatever the heading and the speed"
    source = "Newton's second law"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        del context
        return {**rates, "vx": rates["vx"] + parameters["ax"], "vy": rates["vy"] + parameters["ay"]}
