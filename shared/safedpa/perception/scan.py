"""One scan in world coordinates: end points of its rays, and the visible range in each direction."""

from __future__ import annotations

from math import cos, pi, sin
from typing import NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import BoolArray, FloatArray
from safedpa.bus.messages.messages import ScanMessage, StateMessage
from safedpa.errors import MessageError
from safedpa.perception.odometry import Pose
from safedpa.perception.zones import Zone, zone_entry_distance

__all__ = ["BEHIND", "ScanRays", "check_scan", "hitch_position", "within_body"]


_MAX_RAYS = 1080
_MAX_LEVEL = 8
"""Level of the neighbour tables: up to 2^8 rays to either side."""
BEHIND = 0.15
"""m; a cell is seen through if its middle is so far in front of the end of the rays (noise, and its corner)."""


def check_scan(scan: ScanMessage) -> None:
    """Raises MessageError for an invalid scan."""
    rays = len(scan.ranges)
    if len(scan.mount) != 3:
        raise MessageError(f"scan of {scan.source}: got a mount of {len(scan.mount)} numbers, wanted x, y, yaw")
    if not 2 <= rays <= _MAX_RAYS:
        raise MessageError(f"scan of {scan.source}: got {rays} rays, wanted 2 to {_MAX_RAYS}; send fewer of them")
    if len(scan.free) not in (0, rays):
        raise MessageError(f"scan of {scan.source}: got {len(scan.free)} free lengths, wanted {rays}, as many as rays")
    if not 1e-4 <= abs(scan.angle_step) * rays <= 2.0 * pi + 1e-6:
        raise MessageError(f"scan of {scan.source}: got rays {scan.angle_step:g} rad apart, wanted one turn at most")
    if not 0.0 <= scan.nearest < scan.farthest:
        raise MessageError(f"scan of {scan.source}: got ranges {scan.nearest:g} to {scan.farthest:g} m")


class _Bearings(NamedTuple):
    """Positions relative to the sensor."""

    distance: FloatArray
    """Distance from the sensor, m."""
    turn: FloatArray
    """Angle after the first ray, rad, from 0 to a full turn."""
    ray: NDArray[np.int64]
    """Index of the nearest ray."""
    in_view: BoolArray
    """Whether the position is within the field of view."""


@final
class ScanRays:
    """The rays of one scan from a sensor at (``x``, ``y``) [m].

    With ``open_air``, a ray without a return has seen free space up to the range of the sensor; otherwise up to its
    ``free`` length. A ray that ends on the robot itself (see ``within_body``) sees nothing there or behind it. A ray
    that ends in an ``ignored`` zone hits nothing, and sees only up to the point where it enters the zone.
    """

    def __init__(
        self, scan: ScanMessage, pose: Pose, state: StateMessage, *, open_air: bool, ignored: tuple[Zone, ...] = ()
    ) -> None:
        ranges = np.array(scan.ranges)
        free_space = np.array(scan.free) if scan.free else np.zeros(len(ranges))
        first, step = scan.first_angle, scan.angle_step
        if step < 0.0:  # order the rays counterclockwise
            free_space = free_space[::-1]
            ranges, first, step = ranges[::-1], first + step * (len(ranges) - 1), -step
        x, y, yaw = pose
        ahead, aside, turned = scan.mount
        self.time, self.source = scan.robot_time, scan.source
        """Time of the scan [s], and its source."""
        self.x, self.y = x + ahead * cos(yaw) - aside * sin(yaw), y + ahead * sin(yaw) + aside * cos(yaw)
        self._first, self._step = yaw + turned + first, step
        angles = self._first + step * np.arange(len(ranges))
        ends = np.column_stack([self.x + ranges * np.cos(angles), self.y + ranges * np.sin(angles)])
        returned = (ranges >= scan.nearest) & (ranges < scan.farthest)
        own = returned & within_body(ends, pose, state)
        into = zone_entry_distance(ignored, pose, (self.x, self.y), ends) if ignored else np.full(len(ends), np.inf)
        self.ends: FloatArray = ends[returned & ~own & (into == np.inf)]
        """Hit points (points, 2) [m] that are not on the robot itself."""
        empty = ranges >= scan.farthest
        free = np.minimum(ranges, np.where(into > 0.0, into + BEHIND, 0.0))
        unmet = np.full(len(ranges), scan.farthest) if open_air else np.clip(free_space, 0.0, scan.farthest)
        self._sight = np.where(returned & ~own, free, np.where(empty, unmet, 0.0))
        self.measured_share = float((returned | empty).mean())
        """Share of the rays with a valid measurement."""
        self._around = 2.0 * pi - step * len(ranges) < 0.5 * step
        self._least = np.array(self._neighbours(np.minimum)[1:])
        self._most = np.array(self._neighbours(np.maximum))
        self._known: tuple[FloatArray, FloatArray, _Bearings] | None = None

    def _neighbours(self, of_two: np.ufunc) -> list[FloatArray]:
        """Range of each ray, and for each level the minimum or maximum over 2^level rays to either side."""
        rows = [self._sight]
        for level in range(_MAX_LEVEL + 1):
            shift = 1 if level == 0 else 2 ** (level - 1)
            known = rows[-1]
            sides = [_roll(known, shift), _roll(known, -shift)]
            if not self._around:
                sides[0][:shift] = 0.0
                sides[1][len(known) - shift :] = 0.0
            rows.append(of_two(known, of_two(*sides)))
        return rows

    def sight(self, x: FloatArray, y: FloatArray, width: float) -> tuple[FloatArray, FloatArray]:
        """Distance of positions (x, y) [m], and the range that all rays within ``width`` of them reach."""
        distance, _, ray, in_view = self._bearings(x, y)
        aside = np.maximum(width / np.maximum(distance, width) / self._step, 1.0)
        level = np.minimum(np.ceil(np.log2(aside)).astype(np.int64), _MAX_LEVEL)
        return distance, np.where(in_view, _lookup(self._least, level, ray), 0.0)

    def farthest_past(self, x: FloatArray, y: FloatArray, width: float) -> FloatArray:
        """Longest range of a ray that passes positions (x, y) [m] within ``width``; 0 without such a ray."""
        distance, turn, ray, in_view = self._bearings(x, y)
        within = np.arcsin(np.minimum(width / np.maximum(distance, 1e-9), 1.0)) / self._step
        spare = within - np.abs(turn / self._step - np.rint(turn / self._step))
        level = np.where(spare >= 1.0, np.floor(np.log2(np.maximum(spare, 1.0))) + 1.0, 0.0).astype(np.int64)
        found = _lookup(self._most, np.minimum(level, _MAX_LEVEL + 1), ray)
        return np.where(in_view & (spare >= 0.0), found, 0.0)

    def _bearings(self, x: FloatArray, y: FloatArray) -> _Bearings:
        """Bearings of positions (x, y) [m]; cached for the same array objects."""
        if self._known is None or self._known[0] is not x or self._known[1] is not y:
            apart_x, apart_y = x - self.x, y - self.y
            turn = _within_a_turn(np.arctan2(apart_y, apart_x) - self._first)
            ray, count = np.rint(turn / self._step).astype(np.int64), len(self._sight)
            in_view = np.ones(np.shape(turn), dtype=bool) if self._around else ray < count
            nearest = ray % count if self._around else np.minimum(ray, count - 1)
            self._known = x, y, _Bearings(np.hypot(apart_x, apart_y), turn, nearest, in_view)
        return self._known[2]


def _roll(row: FloatArray, shift: int) -> FloatArray:
    """``np.roll`` of one row, ten times as fast."""
    place = -shift % len(row)
    return np.concatenate((row[place:], row[:place]))


def _lookup(table: FloatArray, row: NDArray[np.int64], column: NDArray[np.int64]) -> FloatArray:
    """table[row, column], three times as fast."""
    found: FloatArray = table.ravel().take(row * table.shape[1] + column)
    return found


def _within_a_turn(angles: FloatArray) -> FloatArray:
    """``np.mod`` of ``angles`` [rad] by a full turn, bitwise equal; avoids the division, which is ten times slower."""
    turn = 2.0 * pi
    if not (angles.min(initial=0.0) >= -turn and angles.max(initial=0.0) < 2.0 * turn):
        return np.mod(angles, turn)
    return np.where(angles < 0.0, angles + turn, np.where(angles >= turn, angles - turn, angles))


def within_body(places: FloatArray, pose: Pose, state: StateMessage, beyond: float = 0.03) -> BoolArray:
    """Which of ``places`` (n, 2) [m] are inside the footprint of the robot at ``pose``, or of its trailer."""
    if len(state.footprint) != 3:
        return np.zeros(len(places), dtype=bool)
    rear, front, radius = state.footprint
    x, y, yaw = pose
    apart = places - np.array((x, y))
    along = apart[:, 0] * cos(yaw) + apart[:, 1] * sin(yaw)
    across = apart[:, 1] * cos(yaw) - apart[:, 0] * sin(yaw)
    inside: BoolArray = np.hypot(along - np.clip(along, -rear, front), across) < radius + beyond
    if len(state.towed) == 3:
        inside |= np.hypot(along + rear, across) < state.towed[2] + beyond
    return inside


def hitch_position(pose: Pose, state: StateMessage) -> FloatArray:
    """Position (2,) [m] of the hitch at ``pose``: the rear end of the line of the footprint."""
    x, y, yaw = pose
    return np.array((x - state.footprint[0] * cos(yaw), y - state.footprint[0] * sin(yaw)))
