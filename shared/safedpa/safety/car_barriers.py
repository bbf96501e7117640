"""All barriers of a car, from what it perceives in one tick."""

from __future__ import annotations

from collections.abc import Sequence

from numpy.typing import ArrayLike

from safedpa.safety.barrier import AbstractBarrier
from safedpa.safety.field_barrier import FieldBarrier
from safedpa.safety.obstacle_barrier import ObstacleBarrier
from safedpa.safety.settings import FilterSettings
from safedpa.safety.speed_barrier import SpeedBarrier
from safedpa.safety.towed_reach import TowedReach

__all__ = ["car_barriers"]


def car_barriers(
    settings: FilterSettings,
    footprint: Sequence[float],
    obstacles: ArrayLike,
    field: Sequence[float] | None = None,
    towed: TowedReach | None = None,
) -> list[AbstractBarrier]:
    """Obstacles (m, 3), field (4,) if there is one, and speed, for state (x, y, yaw, speed) and footprint (3,).

    ``towed``: what hangs at the footprint's rear end, if anything.

    Raises InputError for a wrong shape or a number that is not finite.
    """
    braking, clearance = settings.braking, settings.clearance
    barriers: list[AbstractBarrier] = [ObstacleBarrier(obstacles, footprint, braking, clearance, towed=towed)]
    if field is not None:
        barriers.append(FieldBarrier(field, footprint, braking, clearance, towed))
    return [*barriers, SpeedBarrier(settings.speed_low, settings.speed_high)]
