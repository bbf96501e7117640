"""Wheels that slip outwards in curves."""

from __future__ import annotations

from typing import final

from safedpa.effects.effect import Context, Named, RateEffect, Stage
from safedpa.effects.parameter import Parameter

__all__ = ["WheelSlip"]


@final
class WheelSlip(RateEffect):
    """The robot moves outwards with s = compliance speed turn_rate: d(x)/dt += s sin(yaw), d(y)/dt -= s cos(yaw)."""

    name = "wheel_slip"
    robot = "differential_drive"
    stage = Stage.SLIP
    equation = "sideways = compliance speed turn_rate, outwards"
    parameters = (Parameter("compliance", "s", 0.0, 2.0, 0.1, meaning="sideways speed over sideways acceleration"),)
    signature = "curves end farther outside than they should, the more the faster and the tighter they are"
    source = "Siegwart, Nourbakhsh, Scaramuzza, Autonomous Mobile Robots, 2nd ed., section 3.2 (sliding constraint)"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        state, operations = context.state, context.operations
        sideways = parameters["compliance"] * state["speed"] * state["turn_rate"]
        return {
            **rates,
            "x": rates["x"] + sideways * operations.sin(state["yaw"]),
            "y": rates["y"] - sideways * operations.cos(state["yaw"]),
        }
