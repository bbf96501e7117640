"""Ground or medium that moves and carries the car along."""

from __future__ import annotations

from typing import final

from safedpa.effects.effect import Context, Named, RateEffect, Stage
from safedpa.effects.parameter import Parameter

__all__ = ["CrosswindDrift"]


@final
class CrosswindDrift(RateEffect):
    """d(x)/dt grows by vx, d(y)/dt by vy, independent of the car's motion."""

    name = "crosswind_drift"
    robot = "car"
    stage = Stage.DRIFT
    equation = "d(x)/dt += vx, d(y)/dt += vy"
    parameters = (
        Parameter("vx", "m/s", -2.0, 2.0, 0.1, meaning="along the world's x"),
        Parameter("vy", "m/s", -2.0, 2.0, 0.1, meaning="along the world's y"),
    )
    signature = "position residual of one velocity in the world, the same for every heading and speed, also at rest"
    source = "Fossen, Handbook of Marine Craft Hydrodynamics and Motion Control, 2011, ch. 8 (currents)"
    mirrored = ("vy",)

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        return {**rates, "x": rates["x"] + parameters["vx"], "y": rates["y"] + parameters["vy"]}
