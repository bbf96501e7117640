"""A force of fixed direction: steady wind, or a slope."""

from __future__ import annotations

from typing import final

from safedpa.effects.effect import Context, Named, RateEffect, Stage
from safedpa.effects.parameter import Parameter

__all__ = ["ConstantForce"]


@final
class ConstantForce(RateEffect):
    """d(speed)/dt grows by ax cos(yaw) + ay sin(yaw); the part across the car is carried by the tyres."""

    name = "constant_force"
    robot = "car"
    stage = Stage.RESISTANCE
    equation = "d(speed)/dt += ax cos(yaw) + ay sin(yaw)"
    parameters = (
        Parameter("ax", "m/s2", -5.0, 5.0, 0.5, meaning="along the world's x"),
        Parameter("ay", "m/s2", -5.0, 5.0, 0.5, meaning="along the world's y"),
    )
    signature = (
        "acceleration residual that turns with the heading: opposite signs in opposite directions, whatever the speed"
    )
    source = "Gillespie, Fundamentals of Vehicle Dynamics, SAE 1992, ch. 4 (grade and wind)"
    mirrored = ("ay",)

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        operations, yaw = context.operations, context.state["yaw"]
        push = parameters["ax"] * operations.cos(yaw) + parameters["ay"] * operations.sin(yaw)
        return {**rates, "speed": rates["speed"] + push}
