"""Shortest routes to the goal around all hazards, in batches: the first turn and the length of each route.

Hazards are inflated by ``BERTH``. A route consists of straight lines between the corners of octagons around the
hazards; the lines that cross no inflated hazard form a visibility graph, whose shortest paths are computed once per
layout.

The teacher of the point robot's policy knows the wind and drives along the route at constant speed:

    wanted = (speed along the way - velocity) / time - (wind - drag velocity)         acceleration
    thrust = clip(wanted . heading / strongest),  turn = clip(gain angle from heading, or tail, to wanted / fastest)

It may drive backwards: the tail is used when the wanted acceleration points backwards.
"""

from __future__ import annotations

from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import BoolArray, Float32Array, FloatArray
from safedpa.safety.barriers.stopping import Motion
from safedpa_sim.point.layout import HAZARD_RADIUS

_CRUISE: Final = 0.9
"""m/s; at a higher speed the filter intervenes more often and fewer goals are reached."""
_SECONDS: Final = 0.2
"""s; time constant of the velocity control."""
_GAIN: Final = 8.0
"""1/s; gain of the heading control."""


def teacher_actions(state: FloatArray, turn: FloatArray, motion: Motion) -> FloatArray:
    """Returns the teacher's actions (robots, 2) in [-1, 1] for states (robots, 5) and first turns (robots, 2)."""
    apart = turn - state[:, :2]
    return _steered(state, np.arctan2(apart[:, 1], apart[:, 0]), np.full(len(state), _CRUISE), motion)


def _steered(state: FloatArray, way: FloatArray, speed: FloatArray, motion: Motion) -> FloatArray:
    """Returns actions (robots, 2) that track ``speed`` (robots,) [m/s] in direction ``way`` (robots,) [rad]."""
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
"""m; distance of a route from a hazard's edge."""
_CORNER: Final = 0.12
"""m; distance of an octagon's edges from the hazard's edge, larger than ``BERTH`` so that routes along it are free."""
_CORNERS: Final = 8
_LEAST: Final = 0.15
"""m; lower bound of a hazard's inflated radius for a robot that is inside it, so that the robot finds a route out."""
_NEARER: Final = 0.01
"""m by which a robot inside the berth may approach the hazard further."""
_FAR: Final = 1e6
"""m; length that stands for no route."""


@final
class RoutePlanner:
    """Plans routes for ``count`` robots; the graph of a layout is cached until its hazards change."""

    def __init__(self, count: int) -> None:
        corners = 8 * _CORNERS
        self._hazards = np.full((count, 8, 2), np.nan)
        self._goal = np.full((count, 2), np.nan)
        self._corners = np.zeros((count, corners, 2), np.float32)
        self._apart = np.zeros((count, corners, corners), np.float32)
        self._left = np.zeros((count, corners), np.float32)
        """Route length [m] from each corner to the goal."""

    def first_turns(self, position: FloatArray, hazards: FloatArray, goal: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns the first turns (robots, 2) and the lengths (robots,) [m] of the routes.

        Routes lead from positions (robots, 2) to goals (robots, 2) among hazards (robots, 8, 2). The first turn is the
        goal itself if the straight line is free, or if there is no route.
        """
        self._update(hazards, goal)
        around, start, end = (np.asarray(part, np.float32) for part in (hazards, position, goal))
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
        """Returns the first corners and the route lengths of the robots ``which``."""
        corners = self._corners[which]
        total = np.sqrt(np.square(corners - start[:, None]).sum(2)) + self._left[which]
        total[_crosses(start[:, None], corners, around, reach)] = _FAR
        best, robots = total.argmin(1), np.arange(len(which))
        return corners[robots, best], total[robots, best]

    def _update(self, hazards: FloatArray, goal: FloatArray) -> None:
        """Recomputes graphs for changed hazards, and lengths for changed goals."""
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
    """Returns corners (64, 2) and the lengths (64, 64) [m] of the shortest paths between them."""
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
    """Returns whether lines between start and end (robots, 1 or lines, 2) come closer than ``reach`` (robots,) to any
    of hazards (robots, 8, 2); shape (robots, lines)."""
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
