"""The shortest way to the goal around all hazards, for many robots: where it turns first, and how long it is.

Hazards are grown by a berth. Ways are made of straight lines between the corners of octagons around them, of which
those that cross no grown hazard make a graph; the way from a corner to all others is found once for each layout.

The teacher of the point robot's policy knows the wind, and drives at one speed along that way:

    wanted = (speed along the way - velocity) / time - (wind - drag velocity)         acceleration
    thrust = clip(wanted . heading / strongest),  turn = clip(gain angle from heading, or tail, to wanted / fastest)
"""

from __future__ import annotations

from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import BoolArray, Float32Array, FloatArray
from safedpa.safety.barriers.stopping import Motion
from safedpa_sim.point.layout import HAZARD_RADIUS

__all__ = ["BERTH", "RoutePlanner", "teacher_actions"]


_CRUISE: Final = 0.9
"""m/s; faster ones are stopped more often by the filter and reach fewer goals."""
_SECONDS: Final = 0.2
"""s in which the velocity shall be the wanted one."""
_GAIN: Final = 8.0
"""1/s of the turning."""


def teacher_actions(state: FloatArray, turn: FloatArray, motion: Motion) -> FloatArray:
    """Actions (robots, 2) in [-1, 1] for states (robots, 5) towards the way's first ``turn`` (robots, 2)."""
    apart = turn - state[:, :2]
    return _steered(state, np.arctan2(apart[:, 1], apart[:, 0]), np.full(len(state), _CRUISE), motion)


def _steered(state: FloatArray, way: FloatArray, speed: FloatArray, motion: Motion) -> FloatArray:
    """Actions (robots, 2) that bring states (robots, 5) to ``speed`` (robots,) [m/s] along ``way`` (robots,) [rad]."""
    yaw, vx, vy = state.T[2:]
    wanted_x = (speed * np.cos(way) - vx) / _SECONDS - motion.wind[0] + motion.drag * vx
    wanted_y = (speed * np.sin(way) - vy) / _SECONDS - motion.wind[1] + motion.drag * vy
    along = wanted_x * np.cos(yaw) + wanted_y * np.sin(yaw)
    across = wanted_y * np.cos(yaw) - wanted_x * np.sin(yaw)
    end = np.where(along < 0.0, -1.0, 1.0)
    turn = _GAIN * np.arctan2(end * across, end * along) / motion.fastest
    action: FloatArray = np.clip(np.stack((along / motion.strongest, turn), axis=1), -1.0, 1.0)
    return action


BERTH: Final = 0.1
"""m that a way keeps from a hazard's edge."""
_CORNER: Final = 0.12
"""m from a hazard's edge to its octagon's edges."""
_CORNERS: Final = 8
_LEAST: Final = 0.15
"""m from a hazard's middle: a robot that is nearer still finds a way out."""
_NEARER: Final = 0.01
"""m by which a robot within the berth may come nearer on its way."""
_FAR: Final = 1e6
"""m, where there is no way."""


@final
class RoutePlanner:
    """Ways of ``count`` robots. The graphs of their layouts are kept until the hazards lie elsewhere."""

    def __init__(self, count: int) -> None:
        corners = 8 * _CORNERS
        self._hazards = np.full((count, 8, 2), np.nan)
        self._goal = np.full((count, 2), np.nan)
        self._corners = np.zeros((count, corners, 2), np.float32)
        self._apart = np.zeros((count, corners, corners), np.float32)
        self._left = np.zeros((count, corners), np.float32)
        """m from each corner to the goal."""

    def first_turns(self, place: FloatArray, hazards: FloatArray, goal: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Where the ways from places (robots, 2) to goals (robots, 2) among hazards (robots, 8, 2) turn first, the
        goal itself where nothing is between, and their lengths (robots,) [m]; straight on where there is no way."""
        self._renew(hazards, goal)
        around, start, end = (np.asarray(part, np.float32) for part in (hazards, place, goal))
        own = np.sqrt(np.square(around - start[:, None]).sum(2).min(1))
        reach = np.clip(own - _NEARER, _LEAST, HAZARD_RADIUS + BERTH)
        first, length = end.copy(), np.sqrt(np.square(end - start).sum(1))
        which = np.flatnonzero(_crosses(start[:, None], end[:, None], around, reach)[:, 0])
        if len(which):
            first[which], length[which] = self._around(which, start[which], around[which], reach[which])
            none = which[length[which] >= _FAR]
            first[none], length[none] = end[none], np.sqrt(np.square(end - start).sum(1))[none] + 1.0
        return first.astype(np.float64), length.astype(np.float64)

    def _around(
        self, which: NDArray[np.intp], start: Float32Array, around: Float32Array, reach: Float32Array
    ) -> tuple[Float32Array, Float32Array]:
        """The first corners of the robots ``which``, and the lengths of their ways."""
        corners = self._corners[which]
        total = np.sqrt(np.square(corners - start[:, None]).sum(2)) + self._left[which]
        total[_crosses(start[:, None], corners, around, reach)] = _FAR
        best, robots = total.argmin(1), np.arange(len(which))
        return corners[robots, best], total[robots, best]

    def _renew(self, hazards: FloatArray, goal: FloatArray) -> None:
        """Graphs where hazards lie elsewhere, lengths where the goal does."""
        moved = np.flatnonzero(np.any(self._hazards != hazards, axis=(1, 2)))
        for index in moved:
            self._corners[index], self._apart[index] = _graph(hazards[index].astype(np.float32))
        self._goal[moved] = np.nan
        self._hazards[moved] = hazards[moved]
        which = np.flatnonzero(np.any(self._goal != goal, axis=1))
        if len(which):
            corners, end = self._corners[which], goal[which, None].astype(np.float32)
            reach = np.full(len(which), HAZARD_RADIUS + BERTH, np.float32)
            last = np.sqrt(np.square(corners - end).sum(2))
            last[_crosses(end, corners, hazards[which].astype(np.float32), reach)] = _FAR
            self._left[which] = (self._apart[which] + last[:, None]).min(axis=2)
            self._goal[which] = goal[which]


def _graph(hazards: Float32Array) -> tuple[Float32Array, Float32Array]:
    """Corners (64, 2) and the lengths (64, 64) [m] of the ways between them."""
    from scipy.sparse.csgraph import shortest_path

    angles = 2.0 * np.pi * np.arange(_CORNERS) / _CORNERS
    ring = (HAZARD_RADIUS + _CORNER) / np.cos(np.pi / _CORNERS) * np.stack((np.cos(angles), np.sin(angles)), axis=1)
    corners = (hazards[:, None] + ring).reshape(-1, 2).astype(np.float32)
    free = np.flatnonzero(np.sqrt(np.square(corners[:, None] - hazards).sum(2).min(1)) >= HAZARD_RADIUS + BERTH)
    some = corners[free]
    lengths = np.sqrt(np.square(some[:, None] - some).sum(2))
    reach = np.full(1, HAZARD_RADIUS + BERTH, np.float32)
    first, second = np.triu_indices(len(free), 1)
    crossed = _crosses(some[None, first], some[None, second], hazards[None], reach)[0]
    lengths[first[crossed], second[crossed]] = lengths[second[crossed], first[crossed]] = 0.0
    apart = np.full((len(corners), len(corners)), _FAR, np.float32)
    apart[np.ix_(free, free)] = np.minimum(shortest_path(lengths, method="D", directed=False), _FAR)
    return corners, apart


def _crosses(start: Float32Array, end: Float32Array, hazards: Float32Array, reach: Float32Array) -> BoolArray:
    """(robots, lines): whether the lines between start and end (robots, 1 or lines, 2) come nearer than ``reach``
    (robots,) to any of hazards (robots, 8, 2)."""
    along_x, along_y = (end - start)[..., 0], (end - start)[..., 1]
    size = np.maximum(along_x * along_x + along_y * along_y, 1e-9)
    crossed = np.zeros(size.shape, bool)
    for hazard in range(hazards.shape[1]):
        to_x = hazards[:, hazard, 0, None] - start[..., 0]
        to_y = hazards[:, hazard, 1, None] - start[..., 1]
        share = np.clip((to_x * along_x + to_y * along_y) / size, 0.0, 1.0)
        off_x, off_y = to_x - share * along_x, to_y - share * along_y
        crossed |= off_x * off_x + off_y * off_y < np.square(reach)[:, None]
    return crossed
