"""Round obstacles around a robot whose body is a capsule, stretched by its stopping distance."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, isfinite, sin
from typing import final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safedpa.errors import InputError
from safedpa.safety.barrier import AbstractBarrier
from safedpa.safety.braking import Braking
from safedpa.safety.towed_reach import TowedReach

__all__ = ["SMALLEST_DISTANCE", "Footprint", "ObstacleBarrier", "checked_footprint"]

Values = NDArray[np.float64]
Footprint = tuple[float, float, float]
"""(rear, front, radius) [m]: the body is the segment p - rear e .. p + front e, thickened by the radius."""

SMALLEST_DISTANCE = 1e-12
"""m; keeps the gradient finite when an obstacle's centre lies on the segment (then h < 0 anyway)."""


@final
class ObstacleBarrier(AbstractBarrier):
    """h_i = distance(c_i, S(x)) - (R_i + r + clearance), for obstacles with centre c_i and radius R_i [m].

    State x = (x, y, yaw, speed); e = (cos yaw, sin yaw), p = (x, y); the swept segment is
    S(x) = [p - (rear - min(D, 0)) e, p + (front + max(D, 0)) e], D = stopping distance at that speed: driving forward
    stretches the front end, reversing the rear end. Braking straight ahead moves both ends inward only, so that h never
    falls under the braking action (the docs page on safety has the proof). The gradient is analytic:
    with u, w the coordinates of c_i - p along and across the heading, t = u clipped to the segment, d the distance,

        d(h)/d(p) = -((u - t) e + w n) / d,   d(h)/d(yaw) = -t w / d,
        d(h)/d(speed) = -(u - t) D' / d at a stretched end, else 0.

    With something ``towed`` its hitch is the rear end, whose radius grows with the way driven backwards: h_i is also no
    more than distance(c_i, T(x)) - (R_i + r + growth + clearance), T(x) = what a reversing stop lets the rear end pass.

    ``obstacles`` (m, 3): x, y, radius. Raises InputError for a wrong shape, a number that is not finite or a negative
    length.
    """

    kind = "obstacle"
    reads = ("x", "y", "yaw", "speed")

    def __init__(
        self,
        obstacles: ArrayLike,
        footprint: Sequence[float],
        braking: Braking,
        clearance: float = 0.0,
        names: Sequence[str] | None = None,
        towed: TowedReach | None = None,
    ) -> None:
        table = np.asarray(obstacles, dtype=np.float64)
        if table.size == 0:
            table = table.reshape(0, 3)
        if table.ndim != 2 or table.shape[1] != 3:
            raise InputError(f"obstacles: got shape {table.shape}, wanted (obstacles, 3): x, y, radius in m")
        if not np.isfinite(table).all() or (table[:, 2] < 0.0).any():
            raise InputError(
                "obstacles: got NaN, infinity or a negative radius, wanted finite x, y and radius >= 0 in m"
            )
        self.rear, self.front, self.radius = checked_footprint(footprint)
        if not (isfinite(clearance) and clearance >= 0.0):
            raise InputError(f"clearance: got {clearance}, wanted a finite number >= 0 in m")
        self.braking, self.towed = braking, towed
        self.names = tuple(names) if names is not None else tuple(f"obstacle {i}" for i in range(len(table)))
        if len(self.names) != len(table):
            raise InputError(f"names of obstacles: got {len(self.names)}, wanted {len(table)}, one for each obstacle")
        self.centres = table[:, :2].T.copy()
        """(2, m) in m."""
        self.reach = table[:, 2] + (self.radius + clearance)
        """(m,) in m: what the centre's distance from the segment has to exceed."""
        self.centres.flags.writeable = self.reach.flags.writeable = False

    @property
    def body(self) -> tuple[float, float, Braking, TowedReach | None]:
        """Rear and front end [m], how it brakes and what it tows: what the swept segment follows from."""
        return self.rear, self.front, self.braking, self.towed

    def values(self, state: Values) -> Values:  # noqa: D102
        h = self._geometry(state)[0] - self.reach
        growth = self._growth(state)
        return h if growth <= 0.0 else np.minimum(h, self._geometry(state, -self.rear)[0] - self.reach - growth)

    def evaluate(self, state: Values) -> tuple[Values, Values]:  # noqa: D102
        h, gradient = self._sloped(state, self.front)
        growth = self._growth(state)
        if self.towed is None or growth <= 0.0:
            return h, gradient
        towed, slopes = self._sloped(state, -self.rear)
        x, y, _, speed = state.tolist()[:4]
        slopes[:, [0, 1, 3]] -= self.towed.slopes(x, y, speed)
        nearer = towed - growth < h
        return np.where(nearer, towed - growth, h), np.where(nearer[:, np.newaxis], slopes, gradient)

    def _growth(self, state: Values) -> float:
        x, y, _, speed = state.tolist()[:4]
        return 0.0 if self.towed is None else self.towed.growth(x, y, speed)

    def _sloped(self, state: Values, front: float) -> tuple[Values, Values]:
        """h and gradient of the swept segment from the rear end to ``front`` [m]."""
        distance, offset, nearest, low, high, turn = self._geometry(state, front)
        direction = offset / np.maximum(distance, SMALLEST_DISTANCE)
        direction[1] += distance == 0.0  # on the segment itself (0, 0) / 1e-12 is no direction: to the left is one
        speed = float(state[3])
        stretched = nearest == (high if speed >= 0.0 else low)
        if speed == 0.0:
            stretched |= nearest == low
        if front < self.front and speed >= 0.0:
            stretched[:] = False
        columns = np.zeros((len(state), len(distance)))  # transposed: its rows lie together and are quicker to fill
        columns[:2] = turn.T.dot(-direction)
        columns[2] = -nearest * direction[1]
        columns[3] = -self.braking.slope(speed) * direction[0] * stretched
        return distance - self.reach, columns.T

    def _geometry(
        self, state: Values, front: float | None = None
    ) -> tuple[Values, Values, Values, float, float, Values]:
        """Distances d (m,), offsets (u - t, w) (2, m), t (m,), its least and greatest value, turn to the heading.

        Of the whole swept segment, or of its part behind ``front`` [m], which no speed stretches forwards.
        """
        _, _, yaw, speed = state.tolist()[:4]
        c, s = cos(yaw), sin(yaw)
        stretch = self.braking.distance(speed)
        low = -self.rear + min(stretch, 0.0)
        high = self.front + max(stretch, 0.0) if front is None or front == self.front else front
        turn = np.array(((c, s), (-s, c)))
        offset = turn.dot(self.centres - state[:2, np.newaxis])
        nearest = np.minimum(np.maximum(offset[0], low), high)
        offset[0] -= nearest
        return np.hypot(offset[0], offset[1]), offset, nearest, low, high, turn


def checked_footprint(footprint: Sequence[float]) -> Footprint:
    """(rear, front, radius) as floats; raises InputError unless finite, radius >= 0 and rear + front >= 0."""
    if len(footprint) != 3:
        raise InputError(f"footprint: got {len(footprint)} numbers, wanted 3: rear, front, radius in m")
    rear, front, radius = (float(value) for value in footprint)
    if not (isfinite(rear) and isfinite(front) and isfinite(radius)) or radius < 0.0 or rear + front < 0.0:
        raise InputError(
            f"footprint: got {rear}, {front}, {radius}, wanted finite rear, front, radius in m, radius >= 0, "
            "front not behind rear"
        )
    return rear, front, radius
