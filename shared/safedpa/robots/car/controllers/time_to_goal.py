"""The time to go to the goal from any pose, with turning circle and reversing: a value function on a grid.

A planner with a horizon of one or two seconds needs a terminal cost. T(x, y, yaw) solves Bellman's equation

    T(pose) = min over manoeuvres m of  seconds(m) w(pose) + T(pose after m),     T = 0 at the goal,

on a grid of poses, for arcs of one heading step to the left, straight and to the right, forwards and backwards.
``TimeToGoMap`` updates T from tick to tick as the perceived surroundings change.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil, floor
from typing import final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.policy.grid_route import PlanningGrid, grid_distances
from safedpa.robots.car.controllers.route_cost import Clearances, VisibleObstacles

HEADINGS = 16
"""Number of headings of the pose grid, evenly spaced, the first along x."""
ANGLES: FloatArray = np.arange(HEADINGS, dtype=np.float64) * (2.0 * np.pi / HEADINGS)
"""rad."""
_THROUGH = 8.0
"""Cost factor inside obstacles; finite, so that a planner that came too close still knows the way to leave."""
_GRAZING = 1.0
"""Additional cost factor at contact with an obstacle, decreasing to 0 at ``_BERTH``."""
_BERTH = 0.3
"""m"""
_SPEEDS = (1.5, 0.4)
"""m/s forwards and backwards, until ``drive_at`` is called."""
_SETTLED = 0.02
"""s; T has converged when a sweep changes it by less."""


@final
class TimeToGo:
    """T [s], initialised with the distance of a disc and refined by ``relax``; multilinear between grid poses.

    The capsule ``footprint`` (rear, front, radius) must keep ``room`` to obstacles (m, 3) and to the field's edges, all
    in m; ``turning`` is the radius of the tightest arc [m]. The speeds are set by ``drive_at``.
    """

    def __init__(
        self,
        goal: Sequence[float],
        obstacles: FloatArray,
        field: Sequence[float],
        footprint: Sequence[float],
        room: float,
        turning: float = 0.92,
        cell: float = 0.2,
    ) -> None:
        grid = PlanningGrid(field, cell)
        yaw, x, y = np.meshgrid(ANGLES, grid.x, grid.y, indexing="ij")
        rear, front, radius = footprint
        free = clearance((x, y, yaw), (np.array(-rear), np.array(front)), obstacles, field) - radius - room
        weight = np.where(free < 0.0, _THROUGH, 1.0 + _GRAZING * np.clip(1.0 - free / _BERTH, 0.0, 1.0))
        self._begin(grid, goal, weight, turning, cell)

    @classmethod
    def weighed(cls, grid: PlanningGrid, goal: Sequence[float], weight: FloatArray, turning: float = 0.92) -> TimeToGo:
        """Returns T with the given cost factors ``weight`` (HEADINGS, nx, ny) >= 1 at the poses of ``grid``."""
        made = cls.__new__(cls)
        made._begin(grid, goal, weight, turning, float(grid.cell.max()))
        return made

    def _begin(
        self, grid: PlanningGrid, goal: Sequence[float], weight: FloatArray, turning: float, cell: float
    ) -> None:
        self._grid, angles = grid, ANGLES
        ways = grid_distances(grid, goal, weight.min(axis=0)) / _SPEEDS[0]
        self._times = np.repeat(ways[None].astype(np.float32), HEADINGS, axis=0)
        self._arrived = ways < 1.5 * cell / _SPEEDS[0]
        moves = _manoeuvres(turning)
        self._turned = (np.arange(HEADINGS) + [[turn] for _, _, turn, _ in moves]) % HEADINGS
        self._weight = weight.astype(np.float32)
        self._lengths = np.array([length for *_, length in moves])
        self.drive_at(*_SPEEDS)
        along, across = (np.array([move[index] for move in moves])[:, None] for index in (0, 1))
        self._across = shifts(grid, 0, along * np.cos(angles) - across * np.sin(angles))
        self._along = shifts(grid, 1, along * np.sin(angles) + across * np.cos(angles)).swapaxes(-1, -2)

    def reweigh(self, weight: FloatArray) -> None:
        """Sets other cost factors ``weight`` (HEADINGS, nx, ny) and keeps T as the initial value for ``relax``."""
        self._weight = weight.astype(np.float32)
        self.drive_at(*self._speeds)

    def drive_at(self, forwards: float, backwards: float) -> None:
        """Sets the attainable speeds, > 0 [m/s]; a load may reduce the reverse speed considerably."""
        self._speeds = forwards, backwards
        speeds = np.where(self._lengths > 0.0, forwards, -backwards)
        self._seconds = (self._lengths / speeds).astype(np.float32)[:, None, None, None] * self._weight
        self.settled = False

    def relax(self, sweeps: int) -> None:
        """Runs Bellman sweeps over all poses at once, unless T has converged."""
        for _ in range(0 if self.settled else sweeps):
            after = self._across @ self._times[self._turned] @ self._along  # (manoeuvres, headings, nx, ny)
            after += self._seconds
            better = after.min(axis=0)
            better[:, self._arrived] = self._times[:, self._arrived]
            self.settled = bool(np.abs(better - self._times).max() < _SETTLED)
            self._times = better

    def __call__(self, x: FloatArray, y: FloatArray, yaw: FloatArray) -> FloatArray:
        """Returns T at poses of any one shape; outside the field that of the nearest position inside."""
        i, s = self._grid.shares(x, 0)
        j, t = self._grid.shares(y, 1)
        turn = np.mod(yaw * (HEADINGS / (2.0 * np.pi)), HEADINGS)
        k = turn.astype(np.intp)
        r = turn - k
        found = np.zeros(np.shape(x))
        for heading, share in ((k % HEADINGS, 1.0 - r), ((k + 1) % HEADINGS, r)):
            low = self._times[heading, i, j] * (1.0 - s) + self._times[heading, i + 1, j] * s
            high = self._times[heading, i, j + 1] * (1.0 - s) + self._times[heading, i + 1, j + 1] * s
            found += share * (low * (1.0 - t) + high * t)
        return found


def clearance(
    pose: tuple[FloatArray, FloatArray, FloatArray],
    ends: tuple[FloatArray, FloatArray],
    obstacles: FloatArray,
    field: Sequence[float],
) -> FloatArray:
    """Returns the distance [m] from the segment p + t e, t between ``ends``, to the nearest obstacle or wall.

    Negative beyond it. Pose (x, y, yaw) of any one shape, e = (cos yaw, sin yaw), obstacles (m, 3), field (4,).
    """
    x, y, yaw = pose
    cosine, sine = np.cos(yaw), np.sin(yaw)
    west, east, south, north = field
    room = np.full(x.shape, np.inf)
    for end in ends:
        end_x, end_y = x + end * cosine, y + end * sine
        for wall in (end_x - west, east - end_x, end_y - south, north - end_y):
            np.minimum(room, wall, out=room)
    for ox, oy, radius in obstacles.tolist():
        along, across = (ox - x) * cosine + (oy - y) * sine, (oy - y) * cosine - (ox - x) * sine
        beyond = along - np.clip(along, *ends)
        np.minimum(room, np.hypot(beyond, across) - radius, out=room)
    return room


def shifts(grid: PlanningGrid, axis: int, distance: FloatArray) -> NDArray[np.float32]:
    """Returns matrices (..., n, n) that shift a table along an axis by a distance (...) [m], interpolated linearly."""
    lines = grid.x if axis == 0 else grid.y
    low, share = grid.shares(lines + distance[..., None], axis)
    matrix = np.zeros((*low.shape, len(lines)), np.float32)
    np.put_along_axis(matrix, low[..., None], 1.0 - share[..., None], axis=-1)
    np.put_along_axis(matrix, low[..., None] + 1, share[..., None], axis=-1)
    return matrix


def _manoeuvres(turning: float) -> list[tuple[float, float, int, float]]:
    """Returns (along [m], across [m], heading steps, signed length [m]) of the six arcs."""
    angle = 2.0 * np.pi / HEADINGS
    length = turning * angle
    found: list[tuple[float, float, int, float]] = []
    for side in (-1, 0, 1):
        along = turning * float(np.sin(angle)) if side else length
        across = side * turning * (1.0 - float(np.cos(angle)))
        found += [(along, across, side, length), (-along, across, -side, -length)]
    return found


_CELL = 0.2
"""m"""
_BEYOND = 2.0
"""m; margin of the map around robot and goal."""
_INSIDE = 0.6
"""m; closer to the edge a new map is created."""
_FARTHEST = 7.0
"""m; a goal farther away is replaced by a point at this distance towards it."""
_AT_FIRST = 12
"""Sweeps of a new map."""
_SWEEPS = 4
"""Sweeps of an existing map per tick."""


@final
class TimeToGoMap:
    """T [s] (``TimeToGo``) on a map around the car at ``position`` and its ``goal``, both (x, y) [m]."""

    def __init__(
        self,
        position: tuple[float, float],
        goal: tuple[float, float],
        footprint: tuple[float, float, float],
        room: VisibleObstacles,
        speeds: tuple[float, float],
    ) -> None:
        self.goal = goal
        apart = np.array(goal) - position
        towards = np.array(position) + apart * min(1.0, _FARTHEST / max(float(np.hypot(*apart)), 1e-6))
        low, high = np.minimum(position, towards) - _BEYOND, np.maximum(position, towards) + _BEYOND
        self._low, self._high = np.array([floor(value) for value in low]), np.array([ceil(value) for value in high])
        grid = self._grid = PlanningGrid((self._low[0], self._high[0], self._low[1], self._high[1]), _CELL)
        rear, front, _ = footprint
        at = np.array((-rear, 0.5 * (front - rear), front))[:, np.newaxis]
        self._across = shifts(grid, 0, at * np.cos(ANGLES)).astype(np.float64)
        self._along = shifts(grid, 1, at * np.sin(ANGLES)).swapaxes(-1, -2).astype(np.float64)
        self._x, self._y = np.meshgrid(grid.x, grid.y, indexing="ij")
        self._rest: FloatArray = room.to_rest(self._x, self._y)
        self._moves: FloatArray = room.to_moves(self._x, self._y)
        self.time = TimeToGo.weighed(grid, tuple(towards.tolist()), self._prices(room))
        self.drive_at(*speeds)
        self.time.relax(_AT_FIRST)

    def holds(self, position: tuple[float, float], goal: tuple[float, float]) -> bool:
        """Returns whether the map is for ``goal`` and contains ``position``."""
        inside = (np.array(position) > self._low + _INSIDE).all() and (np.array(position) < self._high - _INSIDE).all()
        return goal == self.goal and bool(inside)

    def drive_at(self, forwards: float, backwards: float) -> None:
        """Sets the attainable speeds, > 0 [m/s]."""
        self.speeds = forwards, backwards
        self.time.drive_at(forwards, backwards)

    def take(self, room: VisibleObstacles, *, moves: bool) -> None:
        """Updates stationary obstacles, or else those that may move; alternating bounds the time per tick."""
        if moves:
            self._moves = room.to_moves(self._x, self._y)
        else:
            self._rest = room.to_rest(self._x, self._y)
        self.time.reweigh(self._prices(room))

    def refine(self) -> None:
        """Runs a few more sweeps."""
        self.time.relax(_SWEEPS)

    def _prices(self, room: VisibleObstacles) -> FloatArray:
        """Returns cost factors (headings, nx, ny) of the body at the grid poses, by its rear, centre and front end."""
        rest = (self._across @ self._rest @ self._along).min(axis=0)
        moves = (self._across[1:] @ self._moves @ self._along[1:]).min(axis=0)
        return room.price(Clearances(rest, moves))
