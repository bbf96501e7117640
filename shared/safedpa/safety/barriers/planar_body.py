"""The body of a planar robot, and its barriers against what sensors report: discs at rest, movers, hidden places.

While the robot brakes, its reference point moves by at most a vector d, and its heading turns by at most T. So the body
stays within each part swept along d, thickened by

    growth = (L + |d|) T        L the largest distance of a corner of the body from the reference point,

because a path of length |d| with a heading error of at most T deviates by at most |d| T, and a corner at distance L by
L T; the disc around each corner looks the same from all sides. Neither d nor T grows under braking, and the rest of the
path stays within the previous region: no h decreases.

Exact for convex parts: the distance to a convex polygon swept along d is that to the outline of their Minkowski sum,
whose facets are those of the polygon and two along d.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from math import hypot, inf, isfinite
from typing import Final, NamedTuple, final

import numpy as np
from numpy.typing import ArrayLike

from safedpa.equations import Given
from safedpa.errors import InputError
from safedpa.operations import Operations, Scalar
from safedpa.safety.barriers.equation import AbstractEquationBarrier
from safedpa.safety.barriers.stopping import stopping_distance

__all__ = ["IS_STATIONARY", "BodyPart", "PlanarBody", "SensedMovers", "SensedPoints", "VelocityFrame"]

IS_STATIONARY: Final = 0.1
"""m/s; a slower robot counts as stationary."""
_STANDS: Final = 1e-6
"""m; a shorter stopping distance has no direction."""
_NUMBERS, _FORM = 8, 8
"""Shared numbers, and numbers of the form, before those of the parts."""
_OUTSIDE: Final = -1e3
"""m; depth that no half-plane of a body has."""
_MOST_CORNERS: Final = 12


class VelocityFrame(IntEnum):
    """How the state describes the velocity."""

    UNKNOWN = 0
    """Not at all: anything up to the largest speed, in any direction."""
    HEADING = 1
    """One entry: the speed along the heading."""
    WORLD = 2
    """Two entries, in the frame of the position."""
    BODY = 3
    """Two entries, ahead and to the left."""


@final
@dataclass(frozen=True)
class BodyPart:
    """A convex part of a body: the hull of ``corners`` [m] in the body frame, thickened by ``radius`` [m].

    One corner is a disc, two are a capsule, more a polygon. Raises InputError for corners that are not finite.

    Example:

        >>> from safedpa.safety.barriers.planar_body import BodyPart
        >>> len(BodyPart(((-0.3, -0.2), (0.3, -0.2), (0.3, 0.2), (0.0, 0.0), (-0.3, 0.2))).hull)
        4
    """

    corners: tuple[tuple[float, float], ...]
    radius: float = 0.0

    def __post_init__(self) -> None:
        numbers = [entry for corner in self.corners for entry in corner]
        if not self.corners or len(numbers) != 2 * len(self.corners) or not all(map(isfinite, numbers)):
            raise InputError(f"body: got corners {self.corners}, wanted one or more of x and y in m, finite")
        if not (isfinite(self.radius) and self.radius >= 0.0):
            raise InputError(f"body: got a radius of {self.radius} m, wanted 0 or more")
        if len(self.hull) > _MOST_CORNERS:
            raise InputError(f"body: got a part with {len(self.hull)} corners, wanted {_MOST_CORNERS} at most")

    @property
    def hull(self) -> tuple[tuple[float, float], ...]:
        """The corners of the convex hull, counterclockwise."""
        rest = sorted(set(self.corners))
        if len(rest) < 3:
            return tuple(rest)
        lower, upper = _chain(rest), _chain(rest[::-1])
        return (*lower[:-1], *upper[:-1])

    def distance(self, x: float, y: float) -> float:
        """Returns the signed distance [m] of a point in the body frame from the part; negative inside.

        Example:

            >>> from safedpa.safety.barriers.planar_body import BodyPart
            >>> BodyPart(((-0.3, 0.0), (0.2, 0.0)), 0.1).distance(0.5, 0.0)
            0.2
        """
        hull = self.hull
        least, depth = inf, -inf
        for (x0, y0), (x1, y1) in zip(hull, hull[1:] + hull[:1], strict=True):
            way_x, way_y = x1 - x0, y1 - y0
            square = way_x * way_x + way_y * way_y
            share = 0.0 if square == 0.0 else min(max(((x - x0) * way_x + (y - y0) * way_y) / square, 0.0), 1.0)
            least = min(least, hypot(x - x0 - share * way_x, y - y0 - share * way_y))
            depth = max(depth, ((x - x0) * way_y - (y - y0) * way_x) / (square**0.5 or 1.0))
        return round((depth if len(hull) > 2 and depth < 0.0 else least) - self.radius, 12)

    @property
    def reach(self) -> float:
        """Largest distance [m] of a point of the part from the reference point."""
        return self.arm + self.radius

    @property
    def arm(self) -> float:
        """Largest distance [m] of a corner from the reference point."""
        return max(hypot(x, y) for x, y in self.corners)


@final
@dataclass(frozen=True)
class PlanarBody:
    """What the barriers of sensed surroundings need to know of a planar robot; lengths in m, speeds in m/s.

    Guaranteed braking under the backup: each second |v| decreases at least by min(``gain`` |v|, ``deceleration``),
    along the velocity, and a turn at ``turn_rate`` goes on by at most ``turning`` seconds of it. With ``track`` > 0
    this holds for each wheel of a differential drive instead. Raises InputError naming the field that is out of range.

    Example: an omnidirectional robot, 0.6 m by 0.4 m, with its velocity in its own frame.

        >>> from safedpa.safety.barriers.planar_body import BodyPart, PlanarBody
        >>> rectangle = BodyPart(((-0.3, -0.2), (0.3, -0.2), (0.3, 0.2), (-0.3, 0.2)))
        >>> body = PlanarBody(1.0, 4.0, 0.8, ("x", "y", "yaw"), ("forward", "left"), parts=(rectangle,))
        >>> body.world
        False
    """

    deceleration: float
    gain: float
    largest_speed: float
    pose: tuple[str, ...] = ("x", "y", "yaw")
    """Names of the states x, y and heading; x and y alone for a robot whose heading is not in its state."""
    velocity: tuple[str, ...] = ("speed",)
    """Names of the states of the velocity: one along the heading, two of a vector, or none."""
    world: bool = False
    """Whether a velocity of two entries is in the frame of the position; else it is ahead and to the left."""
    turn_rate: str = ""
    turning: float = 0.0
    """s"""
    track: float = 0.0
    parts: tuple[BodyPart, ...] = ()
    """Empty: the capsule of the state's ``footprint``."""
    clearance: float = 0.05
    creeping: float = 0.0
    """s; see ``SensedMovers``."""

    def __post_init__(self) -> None:
        for name, value, positive in (
            ("deceleration", self.deceleration, True),
            ("gain", self.gain, True),
            ("largest_speed", self.largest_speed, True),
            ("turning", self.turning, False),
            ("track", self.track, False),
            ("clearance", self.clearance, False),
            ("creeping", self.creeping, False),
        ):
            if not (isfinite(value) and value >= 0.0 and (value > 0.0 or not positive)):
                raise InputError(
                    f"planar body, {name}: got {value}, wanted {'more than 0' if positive else '0 or more'}"
                )
        if len(self.pose) not in (2, 3):
            raise InputError(f"planar body, pose: got {self.pose}, wanted the states x, y and heading, or x and y")
        if len(self.velocity) > 2:
            raise InputError(f"planar body, velocity: got {self.velocity}, wanted none, one or two states")
        if len(self.pose) == 2 and (len(self.velocity) == 1 or (len(self.velocity) == 2 and not self.world)):
            raise InputError("planar body, pose: got no heading, wanted one, which the velocity refers to")
        if self.track > 0.0 and not (len(self.velocity) == 1 and self.turn_rate):
            raise InputError(
                "planar body, track: got one without a speed along the heading and a turn rate, wanted both"
            )
        if self.turn_rate and not self.track and not self.turning:
            raise InputError("planar body, turning: got 0 with a turn rate, wanted the seconds in which a turn ends")

    @property
    def motion(self) -> VelocityFrame:
        """How the state describes the velocity."""
        moves = VelocityFrame.WORLD if self.world else VelocityFrame.BODY
        return (VelocityFrame.UNKNOWN, VelocityFrame.HEADING, moves)[len(self.velocity)]

    def form(self, states: Sequence[str], parts: Sequence[BodyPart]) -> tuple[int, ...]:
        """Returns the variant of the equations for a system with these states. Raises InputError for an unknown one."""
        index = {name: place for place, name in enumerate(states)}
        named = (*self.pose, *self.velocity, *([self.turn_rate] if self.turn_rate else []))
        unknown = [name for name in named if name not in index]
        if unknown:
            raise InputError(f"planar body: got the state '{unknown[0]}', wanted one of {', '.join(states)}")
        yaw = index[self.pose[2]] if len(self.pose) == 3 else -1
        speeds = [index[name] for name in self.velocity] + [-1, -1]
        turn = index[self.turn_rate] if self.turn_rate else -1
        own = (
            int(self.motion),
            index[self.pose[0]],
            index[self.pose[1]],
            yaw,
            *speeds[:2],
            turn,
            int(self.track > 0.0),
        )
        return (*own, *(len(part.hull) for part in parts))

    def parts_of(self, footprint: Sequence[float]) -> tuple[BodyPart, ...]:
        """Returns its parts, or the capsule of a footprint (3,) rear, front, radius [m].

        Without a heading, a disc around the reference point that contains them. Raises InputError if neither is known.
        """
        parts = self.parts
        if not parts:
            if len(footprint) != 3 or not all(map(isfinite, footprint)) or footprint[0] + footprint[1] < 0.0:
                raise InputError(f"footprint: got {tuple(footprint)}, wanted rear, front and radius in m")
            rear, front, radius = footprint
            parts = (BodyPart(((-rear, 0.0), (front, 0.0)), radius),)
        if len(self.pose) == 3:
            return parts
        return (BodyPart(((0.0, 0.0),), max(part.reach for part in parts)),)

    def shared(self, parts: Sequence[BodyPart]) -> tuple[float, ...]:
        """Returns the numbers that all discs have in common."""
        corner = max(self.deceleration / self.gain, IS_STATIONARY)
        turning, arm = self.track or self.turning, max(part.arm for part in parts)
        reach = max(part.reach for part in parts)
        own = (self.deceleration, self.gain, corner, turning, arm, self.largest_speed, self.creeping, reach)
        numbers: list[float] = []
        for part in parts:
            hull = part.hull
            numbers.append(part.radius)
            for (x, y), (next_x, next_y) in zip(hull, hull[1:] + hull[:1], strict=True):
                length = hypot(next_x - x, next_y - y) or 1.0
                numbers += [x, y, (next_y - y) / length, (x - next_x) / length]
        return (*own, *numbers)

    def seconds(self, speed: float) -> float:
        """Returns the time [s] until a robot at ``speed`` counts as stationary."""
        corner = max(self.deceleration / self.gain, IS_STATIONARY)
        slow = min(max(speed - IS_STATIONARY, 0.0), corner - IS_STATIONARY) / (self.gain * IS_STATIONARY)
        return slow + max(speed - corner, 0.0) / self.deceleration


def _chain(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Returns one half of the convex hull of sorted points."""
    found: list[tuple[float, float]] = []
    for point in points:
        while len(found) > 1:
            (ax, ay), (bx, by) = found[-2], found[-1]
            if (bx - ax) * (point[1] - ay) - (by - ay) * (point[0] - ax) > 0.0:
                break
            found.pop()
        found.append(point)
    return found


class _Sweep(NamedTuple):
    """How far the robot gets until it stands."""

    x: Scalar
    """d ahead and to the left of the heading [m]."""
    y: Scalar
    length: Scalar
    growth: Scalar
    size: Scalar
    """Speed [m/s]."""
    seconds: Scalar


def _sweep(given: Given, operations: Operations, cosine: Scalar, sine: Scalar) -> _Sweep:
    deceleration, gain, corner, turning, arm, largest, _, _ = given.shared[:_NUMBERS]
    motion, _, _, _, first, second, turn, wheels = given.form[:_FORM]

    def seconds(size: Scalar) -> Scalar:
        slow = operations.clip(size - IS_STATIONARY, 0.0, corner - IS_STATIONARY) / (gain * IS_STATIONARY)
        return slow + operations.maximum(size - corner, 0.0) / deceleration

    rate: Scalar = given.state[turn] if turn >= 0 else 0.0
    if motion == VelocityFrame.UNKNOWN:
        growth = stopping_distance(largest, deceleration, gain, operations)
        return _Sweep(0.0, 0.0, 0.0, growth, largest, seconds(largest))
    if motion == VelocityFrame.HEADING:
        speed = given.state[first]
        if wheels:
            aside = 0.5 * turning * rate
            left = stopping_distance(speed - aside, deceleration, gain, operations)
            right = stopping_distance(speed + aside, deceleration, gain, operations)
            way, turned = 0.5 * (left + right), operations.absolute(right - left) / turning
            size = operations.absolute(speed) + operations.absolute(aside)
        else:
            way = stopping_distance(speed, deceleration, gain, operations)
            size, turned = operations.absolute(speed), operations.absolute(rate) * turning
        length = operations.absolute(way)
        return _Sweep(way, 0.0, length, (arm + length) * turned, operations.absolute(speed), seconds(size))
    one, other = given.state[first], given.state[second]
    size = operations.hypot(one, other)
    length = stopping_distance(size, deceleration, gain, operations)
    share = operations.where(size * gain <= deceleration, 1.0 / gain, length / operations.maximum(size, 1e-9))
    turned = operations.absolute(rate) * turning
    if motion == VelocityFrame.WORLD:
        x, y = share * (cosine * one + sine * other), share * (cosine * other - sine * one)
        return _Sweep(x, y, length, arm * turned, size, seconds(size))
    return _Sweep(share * one, share * other, length, (arm + length) * turned, size, seconds(size))


def _to_edge(
    place: tuple[Scalar, Scalar], start: tuple[Scalar, Scalar], way: tuple[Scalar, Scalar], operations: Operations
) -> Scalar:
    """Returns the distance [m] from ``place`` to the segment from ``start`` along ``way``."""
    x, y = place[0] - start[0], place[1] - start[1]
    square = way[0] * way[0] + way[1] * way[1]
    share = operations.clip((x * way[0] + y * way[1]) / operations.maximum(square, 1e-12), 0.0, 1.0)
    return operations.hypot(x - share * way[0], y - share * way[1])


def _to_part(place: tuple[Scalar, Scalar], numbers: Sequence[Scalar], sweep: _Sweep, operations: Operations) -> Scalar:
    """Returns the signed distance [m] to one part swept along d; ``numbers``: x, y, normal of each corner."""
    corners = [tuple(numbers[at : at + 4]) for at in range(0, len(numbers), 4)]
    ways = (sweep.x, sweep.y)
    least = None
    for x, y, *_ in corners:
        away = _to_edge(place, (x, y), ways, operations)
        least = away if least is None else operations.minimum(least, away)
    if len(corners) == 1:
        return least
    depth: Scalar = _OUTSIDE
    edges = list(zip(corners, corners[1:] + corners[:1], strict=True))
    for (x, y, *_), (next_x, next_y, *_) in edges[: 1 if len(corners) == 2 else None]:
        edge = (next_x - x, next_y - y)
        for start in ((x, y), (x + sweep.x, y + sweep.y)):
            least = operations.minimum(least, _to_edge(place, start, edge, operations))
    for (x, y, nx, ny), _ in edges:
        ahead = operations.maximum(nx * sweep.x + ny * sweep.y, 0.0)
        depth = operations.maximum(depth, nx * (place[0] - x) + ny * (place[1] - y) - ahead)
    length = operations.maximum(sweep.length, _STANDS)
    across = (-sweep.y / length, sweep.x / length)
    here = across[0] * place[0] + across[1] * place[1]
    aside = [across[0] * x + across[1] * y for x, y, *_ in corners]
    high, low = aside[0], aside[0]
    for one in aside[1:]:
        high, low = operations.maximum(high, one), operations.minimum(low, one)
    lateral = operations.maximum(here - high, low - here)
    depth = operations.maximum(depth, operations.where(sweep.length > _STANDS, lateral, _OUTSIDE))
    return operations.where(depth < 0.0, depth, least)


def _room(given: Given, operations: Operations, x: Scalar, y: Scalar) -> tuple[Scalar, _Sweep, tuple[Scalar, Scalar]]:
    """Returns the distance [m] of a position from the swept body, the sweep, and the position in the body frame."""
    _, east, north, yaw, *_ = given.form[:_FORM]
    cosine, sine = (1.0, 0.0) if yaw < 0 else (operations.cos(given.state[yaw]), operations.sin(given.state[yaw]))
    sweep = _sweep(given, operations, cosine, sine)
    apart_x, apart_y = x - given.state[east], y - given.state[north]
    place = (cosine * apart_x + sine * apart_y, cosine * apart_y - sine * apart_x)
    room, at = None, _NUMBERS
    for count in given.form[_FORM:]:
        radius, numbers = given.shared[at], given.shared[at + 1 : at + 1 + 4 * count]
        one = _to_part(place, numbers, sweep, operations) - radius
        room = one if room is None else operations.minimum(room, one)
        at += 1 + 4 * count
    return room - sweep.growth, sweep, place


@final
class SensedPoints(AbstractEquationBarrier):
    """h_i = distance(c_i, swept body) - (R_i + clearance + growth), for discs at rest with centre c_i, radius R_i [m].

    ``discs`` (m, 3): x, y, radius. Raises InputError for a wrong shape, NaN, or a radius below 0.
    """

    kind = "obstacle"
    numbers = 3

    def __init__(self, discs: ArrayLike, body: PlanarBody, parts: Sequence[BodyPart], states: Sequence[str]) -> None:
        table = _checked(discs, 3)
        self.reads, self.form, self.shared = tuple(states), body.form(states, parts), body.shared(parts)
        self.names = tuple(f"point {index}" for index in range(len(table)))
        self.each = tuple((x, y, size + body.clearance) for x, y, size in table.tolist())

    @staticmethod
    def equation(given: Given, operations: Operations) -> Sequence[Scalar]:
        """Returns h of a disc: x, y and required distance [m]."""
        x, y, reach = given.each
        return (_room(given, operations, x, y)[0] - reach,)


@final
class SensedMovers(AbstractEquationBarrier):
    """h_i = distance(c_i, swept body) - (R_i + clearance + w_i a + growth) - w_i T, discs (c_i, R_i) of speeds w_i.

    T is the time until the robot counts as stationary, a one period, for which nothing is observed. While h_i >= 0, the
    robot stands before anything not faster than w_i can reach it: passive safety. For a hidden disc (``hidden``) behind
    the robot, w_i T counts as 0: someone who approaches from behind sees the robot. With ``creeping`` > 0 [s], h_i of a
    hidden disc is at least creeping (0.1 m/s - |v|), so the robot may creep on and observe.

    ``discs`` (m, 4): x, y, R [m], w [m/s]. Raises InputError for a wrong shape, NaN, or a length or speed below 0.
    """

    kind = "mover"
    at_once = True
    numbers = 5

    def __init__(
        self,
        discs: ArrayLike,
        hidden: Sequence[bool],
        body: PlanarBody,
        parts: Sequence[BodyPart],
        states: Sequence[str],
        period: float = 0.0,
    ) -> None:
        table = _checked(discs, 4)
        if len(hidden) != len(table):
            raise InputError(f"discs: got {len(table)} and {len(hidden)} flags, wanted one for each")
        self.reads, self.form, self.shared = tuple(states), body.form(states, parts), body.shared(parts)
        self.names = tuple(f"disc {index}" for index in range(len(table)))
        self.each = tuple(
            (x, y, size + body.clearance + speed * period, speed, 0.0 if unseen else speed)
            for (x, y, size, speed), unseen in zip(table.tolist(), hidden, strict=True)
        )

    @staticmethod
    def equation(given: Given, operations: Operations) -> Sequence[Scalar]:
        """Returns h of a disc: x, y, required distance [m], its speed, and the one that counts behind [m/s]."""
        x, y, reach, fastest, behind_fastest = given.each
        creeping, reach_of_body = given.shared[6], given.shared[7]
        room, sweep, place = _room(given, operations, x, y)
        behind = place[0] * sweep.x + place[1] * sweep.y + reach_of_body * sweep.length
        coming = operations.where(behind < 0.0, behind_fastest, fastest)
        kept = room - reach - coming * sweep.seconds
        slow = creeping * (IS_STATIONARY - sweep.size)
        unseen = fastest - behind_fastest
        return (operations.where(creeping * unseen > 0.0, operations.maximum(kept, slow), kept),)


def _checked(discs: ArrayLike, width: int) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    table = np.asarray(discs, dtype=np.float64)
    table = table.reshape(0, width) if table.size == 0 else table
    if table.ndim != 2 or table.shape[1] != width or not np.isfinite(table).all() or (table[:, 2:] < 0.0).any():
        raise InputError(f"discs: got shape {table.shape}, wanted (discs, {width}), finite, no length or speed below 0")
    return table
