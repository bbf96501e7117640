"""The car's barriers for many robots at once: the equations of ``ObstacleBarrier``, ``FieldBarrier``, ``SpeedBarrier``.

Rows of every robot: its obstacles, the eight of the field if there is one, the two of the speed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safedpa.errors import InputError
from safedpa.safety.barrier import AbstractBarrier
from safedpa.safety.car_barriers import car_barriers
from safedpa.safety.field_barrier import NORMALS
from safedpa.safety.obstacle_barrier import SMALLEST_DISTANCE
from safedpa.safety.settings import FilterSettings

__all__ = ["ManyScenes"]

Values = NDArray[np.float64]


@final
@dataclass(frozen=True, eq=False)
class ManyScenes:
    """What surrounds each robot: ``obstacles`` (robots, m, 3), ``footprint`` (robots, 3), ``field`` (robots, 4)."""

    settings: FilterSettings
    obstacles: Values
    footprint: Values
    field: Values | None

    @classmethod
    def of(
        cls,
        settings: FilterSettings,
        robots: int,
        obstacles: ArrayLike,
        footprint: ArrayLike,
        field: ArrayLike | None,
    ) -> ManyScenes:
        """Footprint and field may be one for all. Raises InputError for a wrong shape or numbers that are none."""
        table = np.asarray(obstacles, dtype=np.float64)
        if table.ndim != 3 or table.shape[0] != robots or table.shape[2] != 3:
            raise InputError(f"obstacles: got shape {table.shape}, wanted ({robots}, obstacles, 3): x, y, radius in m")
        bodies = _for_each("footprint", footprint, robots, 3)
        walls = None if field is None else _for_each("field", field, robots, 4)
        if not np.isfinite(table).all() or (table[..., 2] < 0.0).any():
            raise InputError("obstacles: got NaN, infinity or a negative radius, wanted finite x, y and radius >= 0")
        if (bodies[:, 2] < 0.0).any() or (bodies[:, 0] + bodies[:, 1] < 0.0).any():
            raise InputError("footprint: got a negative radius, or a front behind the rear; wanted rear, front, radius")
        if walls is not None and ((walls[:, 0] >= walls[:, 1]) | (walls[:, 2] >= walls[:, 3])).any():
            raise InputError("field: got an empty one, wanted lowest x < highest x, lowest y < highest y")
        return cls(settings, table, bodies, walls)

    @property
    def kinds(self) -> tuple[str, ...]:
        """(rows,)."""
        obstacles = int(self.obstacles.shape[1])
        return ("obstacle",) * obstacles + ("field",) * (0 if self.field is None else 8) + ("speed",) * 2

    def only(self, which: NDArray[np.intp]) -> ManyScenes:
        """Those of the robots of these indices."""
        walls = None if self.field is None else self.field[which]
        return ManyScenes(self.settings, self.obstacles[which], self.footprint[which], walls)

    def one(self, robot: int) -> list[AbstractBarrier]:
        """The same barriers of one robot, for the filter of one robot."""
        walls = None if self.field is None else self.field[robot].tolist()
        return car_barriers(self.settings, self.footprint[robot].tolist(), self.obstacles[robot], walls)

    def values(self, state: Values) -> Values:
        """h (robots, rows) at states (robots, 4)."""
        pose = _Pose(self, state)
        reach = self.obstacles[..., 2] + (self.footprint[:, 2:3] + self.settings.clearance)
        parts = [pose.distance - reach, *self._heights(pose)]
        speed = state[:, 3:4]
        return np.concatenate([*parts, self.settings.speed_high - speed, speed - self.settings.speed_low], axis=1)

    def gradient(self, state: Values) -> Values:
        """d(h)/d(state) (robots, rows, 4) at states (robots, 4)."""
        pose = _Pose(self, state)
        slopes = np.zeros((len(state), len(self.kinds), 4))
        count = self.obstacles.shape[1]
        pose.obstacle_slopes(slopes[:, :count])
        if self.field is not None:
            pose.field_slopes(slopes[:, count : count + 8])
        slopes[:, -2:, 3] = -1.0, 1.0
        return slopes

    def _heights(self, pose: _Pose) -> list[Values]:
        if self.field is None:
            return []
        room = self.footprint[:, 2] + self.settings.clearance
        low_x, high_x, low_y, high_y = self.field.T
        heights = []
        for reach in (pose.front, pose.rear):
            end_x, end_y = pose.x + reach * pose.cosine, pose.y + reach * pose.sine
            heights += [
                end_x - (low_x + room),
                (high_x - room) - end_x,
                end_y - (low_y + room),
                (high_y - room) - end_y,
            ]
        return [np.stack(heights, axis=1)]


class _Pose:
    """The geometry of many robots: heading, stretched ends, and where the obstacles are seen from them."""

    def __init__(self, scenes: ManyScenes, state: Values) -> None:
        self.x, self.y, yaw, speed = state.T
        self.cosine, self.sine = np.cos(yaw), np.sin(yaw)
        braking = scenes.settings.braking
        corner, size = braking.deceleration / braking.gain, np.abs(speed)
        far = corner / braking.gain + (size * size - corner * corner) / (2.0 * braking.deceleration)
        stretch = np.where(size <= corner, speed / braking.gain, np.copysign(far, speed))
        self.speed, self.slope = speed, np.maximum(1.0 / braking.gain, size / braking.deceleration)
        self.rear = -scenes.footprint[:, 0] + np.minimum(stretch, 0.0)
        self.front = scenes.footprint[:, 1] + np.maximum(stretch, 0.0)
        apart_x = scenes.obstacles[..., 0] - self.x[:, np.newaxis]
        apart_y = scenes.obstacles[..., 1] - self.y[:, np.newaxis]
        cosine, sine = self.cosine[:, np.newaxis], self.sine[:, np.newaxis]
        along, self.across = cosine * apart_x + sine * apart_y, cosine * apart_y - sine * apart_x
        self.nearest = np.minimum(np.maximum(along, self.rear[:, np.newaxis]), self.front[:, np.newaxis])
        self.along = along - self.nearest
        self.distance = np.hypot(self.along, self.across)

    def obstacle_slopes(self, slopes: Values) -> None:
        """Writes d(h)/d(state) (robots, m, 4)."""
        size = np.maximum(self.distance, SMALLEST_DISTANCE)
        ahead, aside = self.along / size, self.across / size + (self.distance == 0.0)
        cosine, sine = self.cosine[:, np.newaxis], self.sine[:, np.newaxis]
        front, rear = (self.nearest == end[:, np.newaxis] for end in (self.front, self.rear))
        speed = self.speed[:, np.newaxis]
        stretched = ((speed >= 0.0) & front) | ((speed <= 0.0) & rear)
        slopes[..., 0] = sine * aside - cosine * ahead
        slopes[..., 1] = -sine * ahead - cosine * aside
        slopes[..., 2] = -self.nearest * aside
        slopes[..., 3] = -self.slope[:, np.newaxis] * ahead * stretched

    def field_slopes(self, slopes: Values) -> None:
        """Writes d(h)/d(state) (robots, 8, 4)."""
        slopes[..., :2] = NORMALS.T
        forwards, backwards = self.slope * (self.speed >= 0.0), self.slope * (self.speed <= 0.0)
        for first, reach, change in ((0, self.front, forwards), (4, self.rear, backwards)):
            turn_x, turn_y = -reach * self.sine, reach * self.cosine
            slopes[:, first : first + 4, 2] = np.stack([turn_x, -turn_x, turn_y, -turn_y], axis=1)
            grow_x, grow_y = change * self.cosine, change * self.sine
            slopes[:, first : first + 4, 3] = np.stack([grow_x, -grow_x, grow_y, -grow_y], axis=1)


def _for_each(what: str, numbers: ArrayLike, robots: int, count: int) -> Values:
    table = np.asarray(numbers, dtype=np.float64)
    if table.shape not in ((count,), (robots, count)) or not np.isfinite(table).all():
        raise InputError(f"{what}: got shape {table.shape}, wanted ({count},) or ({robots}, {count}), finite, in m")
    return np.broadcast_to(table, (robots, count))
