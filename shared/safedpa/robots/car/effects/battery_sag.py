"""A drive that weakens as the battery empties."""

from __future__ import annotations

from typing import final

from safedpa.effects.effect import Context, Named, RateEffect, Stage
from safedpa.effects.parameter import Parameter

__all__ = ["BatterySag"]


@final
class BatterySag(RateEffect):
    """Drive acceleration = that with a full battery times exp(-rate time), time since the start of the run.

    It applies to a throttle and to a speed servo: both deliver less than commanded.
    """

    name = "battery_sag"
    robot = "car"
    stage = Stage.SUPPLY
    equation = "drive acceleration *= exp(-rate time)"
    parameters = (Parameter("rate", "1/s", 0.0, 0.1, 0.002),)
    signature = "acceleration residual against the drive that grows with the time since the start"
    timed = True
    source = "Plett, Battery Management Systems, vol. 1, 2015, ch. 2 (voltage under load falls with charge)"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        strength = context.operations.exp(-parameters["rate"] * context.time)
        return {**rates, "speed": rates["speed"] * strength}
