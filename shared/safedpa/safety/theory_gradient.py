"""The largest gradient of the car's barriers, in the norm that the theory's bound asks for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from safedpa.safety.obstacle_barrier import checked_footprint
from safedpa.safety.settings import FilterSettings

__all__ = ["largest_gradients"]

Values = NDArray[np.float64]


def largest_gradients(settings: FilterSettings, footprint: Sequence[float], scale: Values) -> dict[str, float]:
    """By kind of barrier: sup |d(h)/d(v)|_1 over all states whose speed is within the settings' limits.

    ``scale`` (4,): s_along, s_across [m], s_yaw [rad], s_speed [m/s] of an increment v. For obstacle and field, with a
    unit vector (c, s), arm t and slope of the stopping distance D', the gradient is (c, s) in position, t s in yaw and
    D' c in speed (see ``ObstacleBarrier``), whatever the frame in which the position is taken, so that

        |d(h)/d(v)|_1 <= sqrt(s_along^2 + s_across^2) + sqrt((t s_yaw)^2 + (D' s_speed)^2).

    t is at most the longer of the swept segment's ends, D' its value at the greatest speed. Of the speed limits the
    gradient is 1: s_speed. Raises InputError for a footprint that is none.
    """
    rear, front, _ = checked_footprint(footprint)
    braking = settings.braking
    ends = [braking.distance(speed) for speed in (settings.speed_low, settings.speed_high)]
    arm = max(abs(-rear + min(ends[0], 0.0)), abs(front + max(ends[1], 0.0)), abs(rear), abs(front))
    slope = max(braking.slope(settings.speed_low), braking.slope(settings.speed_high))
    body = float(np.hypot(scale[0], scale[1]) + np.hypot(arm * scale[2], slope * scale[3]))
    return {"obstacle": body, "field": body, "speed": float(scale[3])}
