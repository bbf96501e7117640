"""The car's barriers for a batch of cars, from arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from safedpa.arrays import FloatArray
from safedpa.errors import InputError
from safedpa.robots.car.barriers.obstacles import FieldBarrier, ObstacleBarrier, braking_of, car_barriers
from safedpa.safety.barriers.base import AbstractBarrier
from safedpa.safety.barriers.equation import AbstractEquationBarrier, pattern_of
from safedpa.safety.barriers.limits import SpeedBarrier
from safedpa.safety.batch.barriers import CompiledBatchBarriers
from safedpa.safety.settings import FilterSettings

_BODY, _ROOM = (0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 1.0)


def barriers_of_cars(
    settings: FilterSettings, obstacles: ArrayLike, footprint: ArrayLike, field: ArrayLike | None = None
) -> CompiledBatchBarriers:
    """Builds ``car_barriers`` for a batch: ``obstacles`` (cars, m, 3), padded with far-away ones if a car has fewer.

    ``footprint`` (3,) or (cars, 3) and ``field`` (4,) or (cars, 4) may be shared by all cars. Raises InputError for a
    wrong shape or values that are not finite.
    """
    table = np.asarray(obstacles, dtype=np.float64)
    if table.ndim != 3 or table.shape[2] != 3:
        raise InputError(f"obstacles: got shape {table.shape}, wanted (robots, obstacles, 3): x, y, radius in m")
    cars = len(table)
    bodies = _for_each("footprint", footprint, cars, 3)
    walls = None if field is None else _for_each("field", field, cars, 4)
    _check(table, bodies, walls)
    braking, clearance = braking_of(settings), settings.barrier("clearance")
    room = bodies[:, 2:3] + clearance
    body = [bodies[:, :1], bodies[:, 1:2], *(np.full((cars, 1), n) for n in (braking.deceleration, braking.gain))]
    limits = [np.full((cars, 1), limit) for limit in (settings.barrier("speed_low"), settings.barrier("speed_high"))]
    parts: list[AbstractEquationBarrier] = [ObstacleBarrier((), _BODY, braking)]
    shared, each = [body], [[table[..., 0], table[..., 1], table[..., 2] + room]]
    if walls is not None:
        parts.append(FieldBarrier(_ROOM, _BODY, braking))
        shared.append(body)
        each.append([walls[:, index : index + 1] + sign * room for index, sign in enumerate((1.0, -1.0, 1.0, -1.0))])
    parts.append(SpeedBarrier(settings.barrier("speed_low"), settings.barrier("speed_high")))

    def one(car: int) -> list[AbstractBarrier]:
        own = None if walls is None else walls[car].tolist()
        return car_barriers(settings, bodies[car].tolist(), table[car], own)

    kinds = ["obstacle"] * table.shape[1] + [part.kind for part in parts[1:] for _ in part.names]
    pattern, reads = pattern_of(parts), ObstacleBarrier.reads
    return CompiledBatchBarriers(pattern, kinds, len(reads), [*shared, []], [*each, limits], one, cars, reads)


def _check(table: FloatArray, bodies: FloatArray, walls: FloatArray | None) -> None:
    if not np.isfinite(table).all() or (table[..., 2] < 0.0).any():
        raise InputError("obstacles: got NaN, infinity or a negative radius, wanted finite x, y and radius >= 0")
    if (bodies[:, 2] < 0.0).any() or (bodies[:, 0] + bodies[:, 1] < 0.0).any():
        raise InputError("footprint: got a negative radius, or a front behind the rear; wanted rear, front, radius")
    if walls is not None and ((walls[:, 0] >= walls[:, 1]) | (walls[:, 2] >= walls[:, 3])).any():
        raise InputError("field: got an empty one, wanted lowest x < highest x, lowest y < highest y")


def _for_each(what: str, numbers: ArrayLike, cars: int, count: int) -> Any:
    table = np.asarray(numbers, dtype=np.float64)
    if table.shape not in ((count,), (cars, count)) or not np.isfinite(table).all():
        raise InputError(f"{what}: got shape {table.shape}, wanted ({count},) or ({cars}, {count}), finite, in m")
    return np.broadcast_to(table, (cars, count))
