"""A speed sensor on another scale: wrong wheel radius."""

from __future__ import annotations

from typing import final

from safedpa.effects.effect import Named, SensorEffect, Stage
from safedpa.effects.parameter import Parameter

__all__ = ["SpeedSensorScale"]


@final
class SpeedSensorScale(SensorEffect):
    """measured speed = scale true speed; the position follows the true one."""

    name = "speed_sensor_scale"
    robot = "car"
    stage = Stage.SENSOR
    equation = "measured speed = scale speed"
    parameters = (Parameter("scale", "1", 0.3, 3.0, 1.05, neutral=1.0, meaning="measured speed over true speed"),)
    signature = "distance covered differs from the integral of the measured speed by one share; yaw rate likewise"
    source = "Borenstein and Feng, Measurement and Correction of Systematic Odometry Errors, IEEE T-RA 12, 1996"

    def measure(self, state: Named, parameters: Named) -> Named:  # noqa: D102
        return {**state, "speed": state["speed"] * parameters["scale"]}

    def restore(self, state: Named, parameters: Named) -> Named:  # noqa: D102
        return {**state, "speed": state["speed"] / parameters["scale"]}
