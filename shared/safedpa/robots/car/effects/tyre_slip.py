"""Rear tyres that slip sideways in curves."""

from __future__ import annotations

from typing import final

from safedpa.effects.effect import Context, Named, RateEffect, Stage
from safedpa.effects.parameter import Parameter

__all__ = ["TyreSlip"]


@final
class TyreSlip(RateEffect):
    """Direction of travel = yaw - atan(compliance lateral acceleration), lateral acceleration = speed d(yaw)/dt.

    The rear tyres need a slip angle for their side force. The heading is not changed (see understeer).
    """

    name = "tyre_slip"
    robot = "car"
    stage = Stage.SLIP
    equation = "direction of travel = yaw - atan(compliance speed d(yaw)/dt)"
    parameters = (
        Parameter("compliance", "s2/m", 0.0, 0.5, 0.02, meaning="slip angle of the rear axle per lateral acceleration"),
    )
    signature = "position residual across the car, outwards, growing with the cube of speed; none in the yaw rate"
    source = "Rajamani, Vehicle Dynamics and Control, 2nd ed., section 2.3 (slip angle of the rear tyres)"

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        operations = context.operations
        slip = operations.atan(parameters["compliance"] * context.state["speed"] * rates["yaw"])
        cosine, sine = operations.cos(slip), operations.sin(slip)
        return {
            **rates,
            "x": rates["x"] * cosine + rates["y"] * sine,
            "y": rates["y"] * cosine - rates["x"] * sine,
        }
