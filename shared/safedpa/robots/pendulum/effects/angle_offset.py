"""An angle sensor that is not centred."""

from __future__ import annotations

from typing import final

from safedpa.effects.effect import Named, SensorEffect, Stage
from safedpa.effects.parameter import Parameter

__all__ = ["AngleOffset"]


@final
class AngleOffset(SensorEffect):
    """measured angle = true angle + angle."""

    name = "angle_offset"
    robot = "pendulum"
    stage = Stage.SENSOR
    equation = "measured angle = angle + offset"
    parameters = (Parameter("offset", "rad", -1.0, 1.0, 0.03),)
    signature = "rate residual in proportion to the cosine of the angle, also at rest: the balance is not at 0"
    source = (
        "Siciliano et al., Robotics: Modelling, Planning and Control, 2009, section 2.11 (joint offsets in calibration)"
    )
    mirrored = ("offset",)

    def measure(self, state: Named, parameters: Named) -> Named:  # noqa: D102
        return {**state, "angle": state["angle"] + parameters["offset"]}

    def restore(self, state: Named, parameters: Named) -> Named:  # noqa: D102
        return {**state, "angle": state["angle"] - parameters["offset"]}
