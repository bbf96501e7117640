"""The car's barriers: obstacles and walls around a body extended by its stopping distance, and speed limits.

Each is one equation. ``barriers_around`` draws random ones to calibrate margins from logs, ``largest_gradients`` bounds
their gradients.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike

from safedpa.arrays import FloatArray
from safedpa.bus import StateMessage
from safedpa.equations import Given
from safedpa.errors import InputError
from safedpa.operations import FLOATS, Operations, Scalar
from safedpa.robots.car.barriers.body import (
    TrailerEnvelope,
    body_of,
    grad_bound,
    hitch_of,
    to_segment,
)
from safedpa.robots.car.system import CAR
from safedpa.safety.barriers.base import AbstractBarrier
from safedpa.safety.barriers.equation import AbstractEquationBarrier
from safedpa.safety.barriers.limits import SpeedBarrier
from safedpa.safety.barriers.stopping import Braking
from safedpa.safety.settings import FilterSettings

Footprint = tuple[float, float, float]
"""(rear, front, radius) [m]: the body is the segment p - rear e .. p + front e, thickened by the radius."""

_STATES = ("x", "y", "yaw", "speed")


@final
class ObstacleBarrier(AbstractEquationBarrier):
    """h_i = distance(c_i, S(x)) - (R_i + r + clearance), for obstacles with centre c_i and radius R_i [m].

    State x = (x, y, yaw, speed); e = (cos yaw, sin yaw), p = (x, y); the swept segment is
    S(x) = [p - (rear - min(D, 0)) e, p + (front + max(D, 0)) e], D = stopping distance at that speed (``Braking``).

    With a load (``towed``) the rear end is the hitch, where the radius grows with the distance driven backwards: h_i is
    also at most distance(c_i, T(x)) - (R_i + r + growth + clearance), T(x) the path of the rear end in a reversing
    stop.

    ``obstacles`` (m, 3): x, y, radius. Raises InputError for a wrong shape, a value that is not finite or a negative
    length.
    """

    kind = "obstacle"
    reads = _STATES
    numbers = 3
    grad_bound = staticmethod(grad_bound)

    def __init__(
        self,
        obstacles: ArrayLike,
        footprint: Sequence[float],
        braking: Braking,
        clearance: float = 0.0,
        names: Sequence[str] | None = None,
        towed: TrailerEnvelope | None = None,
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
        rear, front, radius = checked_footprint(footprint)
        room = radius + _checked_clearance(clearance)
        self.names = tuple(names) if names is not None else tuple(f"obstacle {i}" for i in range(len(table)))
        if len(self.names) != len(table):
            raise InputError(f"names of obstacles: got {len(self.names)}, wanted {len(table)}, one for each obstacle")
        self.shared = _shared(rear, front, braking, towed)
        rows: Any = table.tolist()
        self.each = tuple([(x, y, size + room) for x, y, size in rows])

    @staticmethod
    def equation(given: Given, operations: Operations) -> Sequence[Scalar]:
        """Returns h of an obstacle: x, y and required distance [m]."""
        x, y, reach = given.each
        body = body_of(given, operations)
        h = to_segment(body, given, body.rear, body.front, (x, y), operations) - reach
        hitch = hitch_of(body, given, operations)
        if hitch is None:
            return (h,)
        end, growth = hitch
        towed = to_segment(body, given, body.rear, end, (x, y), operations) - reach - growth
        return (operations.minimum(h, towed),)


@final
class FieldBarrier(AbstractEquationBarrier):
    """h = b - n . end - (r + clearance), for both ends of the swept segment and each of four walls n . p <= b.

    ``field`` = lowest x, highest x, lowest y, highest y [m]; state, footprint and extended ends as in ObstacleBarrier.
    There are eight barriers, because the segment lies within a half plane exactly when both of its ends do.

    With a load (``towed``) the radius at the rear end is larger by its growth along the whole path of that end in a
    reversing stop; the closer end of this path counts. Raises InputError when a side is not finite or the field is
    empty.
    """

    kind = "field"
    reads = _STATES
    numbers = 4
    grad_bound = staticmethod(grad_bound)
    names = tuple(
        f"{wall} wall, {end} end" for end in ("front", "rear") for wall in ("left", "right", "lower", "upper")
    )

    def __init__(
        self,
        field: Sequence[float],
        footprint: Sequence[float],
        braking: Braking,
        clearance: float = 0.0,
        towed: TrailerEnvelope | None = None,
    ) -> None:
        sides = tuple(float(side) for side in field)
        if len(sides) != 4 or not all(isfinite(side) for side in sides) or sides[0] >= sides[1] or sides[2] >= sides[3]:
            raise InputError(f"field: got {sides}, wanted lowest x < highest x, lowest y < highest y, finite, in m")
        rear, front, radius = checked_footprint(footprint)
        room = radius + _checked_clearance(clearance)
        self.shared = _shared(rear, front, braking, towed)
        self.each = ((sides[0] + room, sides[1] - room, sides[2] + room, sides[3] - room),)

    @staticmethod
    def equation(given: Given, operations: Operations) -> Sequence[Scalar]:
        """Returns h of both ends for the four walls, which are already moved inwards by the required distance."""
        body = body_of(given, operations)
        h = [*_within(body.front, body, given), *_within(body.rear, body, given)]
        hitch = hitch_of(body, given, operations)
        if hitch is None:
            return h
        end, growth = hitch
        folds = growth > 0.0
        towed = zip(h[4:], _within(end, body, given), strict=True)
        lower = [(swept, operations.minimum(swept, still) - growth) for swept, still in towed]
        return [*h[:4], *(operations.where(folds, room, swept) for swept, room in lower)]


def car_barriers(
    settings: FilterSettings,
    footprint: Sequence[float],
    obstacles: ArrayLike,
    field: Sequence[float] | None = None,
    towed: TrailerEnvelope | None = None,
) -> list[AbstractBarrier]:
    """Returns the barriers of obstacles (m, 3), field (4,) if given, and speed, for state (x, y, yaw, speed).

    ``footprint`` (3,) is rear, front, radius [m]; ``towed`` the load at its rear end, if any. Raises InputError for a
    wrong shape or a value that is not finite.
    """
    braking, clearance = braking_of(settings), settings.barrier("clearance")
    barriers: list[AbstractBarrier] = [ObstacleBarrier(obstacles, footprint, braking, clearance, towed=towed)]
    if field is not None:
        barriers.append(FieldBarrier(field, footprint, braking, clearance, towed))
    return [*barriers, SpeedBarrier(settings.barrier("speed_low"), settings.barrier("speed_high"))]


def with_towed_load(parts: Sequence[AbstractEquationBarrier], towed: TrailerEnvelope) -> list[AbstractEquationBarrier]:
    """Returns the barriers of a car with a load, with the load's envelope updated."""
    numbers = towed.numbers
    shared = (*parts[0].shared[: -len(numbers)], *numbers)
    return [part.with_shared(shared) if isinstance(part, ObstacleBarrier | FieldBarrier) else part for part in parts]


def braking_of(settings: FilterSettings) -> Braking:
    """Returns the guaranteed braking of the settings."""
    return Braking(settings.barrier("braking_deceleration"), settings.barrier("braking_gain"))


def swept_capsule(state: StateMessage, settings: FilterSettings) -> tuple[float, float, float] | None:
    """Returns rear and front end of the swept segment along the heading, and its radius [m]; None if unknown."""
    if len(state.footprint) != 3 or len(state.values) != len(_STATES) or not all(map(isfinite, state.values)):
        return None
    rear, front, radius = state.footprint
    braking = braking_of(settings)
    body = body_of(Given(state.values, (rear, front, braking.deceleration, braking.gain), ()), FLOATS)
    return body.rear, body.front, radius


def checked_footprint(footprint: Sequence[float]) -> Footprint:
    """Returns (rear, front, radius) as floats; raises InputError unless finite, radius >= 0 and rear + front >= 0."""
    if len(footprint) != 3:
        raise InputError(f"footprint: got {len(footprint)} numbers, wanted 3: rear, front, radius in m")
    rear, front, radius = (float(value) for value in footprint)
    if not (isfinite(rear) and isfinite(front) and isfinite(radius)) or radius < 0.0 or rear + front < 0.0:
        raise InputError(
            f"footprint: got {rear}, {front}, {radius}, wanted finite rear, front, radius in m, radius >= 0, "
            "front not behind rear"
        )
    return rear, front, radius


def _within(reach: Scalar, body: Any, given: Given) -> list[Scalar]:
    """Returns the distances of the point ``reach`` [m] ahead along the heading to the four walls, positive inside."""
    low_x, high_x, low_y, high_y = given.each
    x, y = given.state[0] + reach * body.cosine, given.state[1] + reach * body.sine
    return [x - low_x, high_x - x, y - low_y, high_y - y]


def _shared(rear: float, front: float, braking: Braking, towed: TrailerEnvelope | None) -> tuple[float, ...]:
    """Returns the shared parameters of ``body_of`` and ``hitch_of``."""
    own = (rear, front, braking.deceleration, braking.gain)
    return own if towed is None else (*own, *towed.numbers)


def _checked_clearance(clearance: float) -> float:
    if not (isfinite(clearance) and clearance >= 0.0):
        raise InputError(f"clearance: got {clearance}, wanted a finite number >= 0 in m")
    return clearance


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


SMALL_CAR = (0.08, 0.40, 0.12)
"""m; footprint of the 1:10 car: extent behind and ahead of the rear axle, and radius."""
_AROUND = (0.5, 2.5)
"""m; range of the obstacles' distances."""
_RADII = (0.2, 0.35)
"""m"""
_OBSTACLES = 3
_ROOM = 4.0
"""m; largest distance of a wall."""


def barriers_around(
    state: FloatArray, settings: FilterSettings, footprint: tuple[float, ...], draw: np.random.Generator
) -> list[AbstractBarrier]:
    """Draws obstacles and four walls around a state; ``footprint`` (3,) or empty for ``SMALL_CAR``."""
    assert len(state) == len(CAR.state)
    distance, angle = draw.uniform(*_AROUND, _OBSTACLES), draw.uniform(-np.pi, np.pi, _OBSTACLES)
    x, y = state[0] + distance * np.cos(angle), state[1] + distance * np.sin(angle)
    obstacles: Any = np.column_stack([x, y, draw.uniform(*_RADII, _OBSTACLES)])
    low, high = draw.uniform(0.5, _ROOM, 2), draw.uniform(0.5, _ROOM, 2)
    field = (state[0] - low[0], state[0] + high[0], state[1] - low[1], state[1] + high[1])
    return car_barriers(settings, footprint if len(footprint) == 3 else SMALL_CAR, obstacles, field)
