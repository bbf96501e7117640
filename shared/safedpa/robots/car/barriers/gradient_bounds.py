"""The largest gradients of the car's barriers, in the norm of the theoretical bound."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.equations import Given
from safedpa.operations import FLOATS
from safedpa.robots.car.barriers.obstacles import ObstacleBarrier, braking_of
from safedpa.safety.settings import FilterSettings


def largest_gradients(settings: FilterSettings, footprint: Sequence[float], scale: FloatArray) -> dict[str, float]:
    """Returns sup |d(h)/d(v)|_1 by kind of barrier, over all states with a speed within the settings' limits.

    ``scale`` (4,) holds s_along, s_across [m], s_yaw [rad], s_speed [m/s] of an increment v. For obstacle and field,
    with a unit vector (c, s), arm t and derivative of the stopping distance D', the gradient is (c, s) in position, t s
    in yaw and D' c in speed, in any frame of the position, so that

        |d(h)/d(v)|_1 <= sqrt(s_along^2 + s_across^2) + sqrt((t s_yaw)^2 + (D' s_speed)^2).

    t and D' are at most the values of ``ObstacleBarrier.grad_bound`` at the ends of the speed's range. The gradient of
    the speed limits is s_speed. Raises InputError for an invalid footprint.
    """
    shared = ObstacleBarrier((), footprint, braking_of(settings)).shared
    speeds = settings.barrier("speed_low"), settings.barrier("speed_high"), 0.0
    bounds = [ObstacleBarrier.grad_bound(Given((0.0, 0.0, 0.0, speed), shared, ()), FLOATS) for speed in speeds]
    _, _, arm, slope = np.max(bounds, axis=0).tolist()
    body = float(np.hypot(scale[0], scale[1]) + np.hypot(arm * scale[2], slope * scale[3]))
    return {"obstacle": body, "field": body, "speed": float(scale[3])}
