"""Nodes of the sensing experiments: a policy that searches a way around obstacles, and a sensor with scale errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import ceil, cos, gcd, hypot, sin
from typing import Final, final

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from safedpa.arrays import BoolArray, FloatArray, IndexArray
from safedpa.bus import ActionMessage, ScanMessage, StateMessage
from safedpa.perception.odometry import Pose
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene
from safedpa_sim.sensing.shapes import Outline, Point, clearances_at

_CELL: Final = 0.05
"""m"""
_STEPS: Final = tuple(
    (i, j) for i in range(-2, 3) for j in range(-2, 3) if (i or j) and gcd(i, j) == 1 and max(abs(i), abs(j)) <= 2
)
"""Sixteen directions: a way along them is up to 1.0275 times as long as the straight one."""
_LONGER: Final = 1.0275


@final
class WaysAround:
    """The places of a scene in which the middle of someone of ``radius`` [m] can be, and the ways between them.

    A cell is open if someone thinner by a cell has room in it, so that no way is found closed that is not.
    """

    def __init__(self, scene: Scene, radius: float) -> None:
        low_x, high_x, low_y, high_y = scene.field
        columns, rows = ceil((high_x - low_x) / _CELL), ceil((high_y - low_y) / _CELL)
        i, j = np.meshgrid(np.arange(columns), np.arange(rows), indexing="ij")
        self.places: FloatArray = np.column_stack(
            [low_x + (i.ravel() + 0.5) * _CELL, low_y + (j.ravel() + 0.5) * _CELL]
        )
        """(cells, 2) m; the cells' middles."""
        outline = Outline(scene.obstacles, scene.polygons, (scene.field,))
        open_cells = (clearances_at(outline, self.places) > radius - _CELL).reshape(columns, rows)
        starts, ends, lengths = list[IndexArray](), list[IndexArray](), list[FloatArray]()
        number = np.arange(columns * rows).reshape(columns, rows)
        for right, up in _STEPS:
            here = np.s_[max(-right, 0) : columns - max(right, 0), max(-up, 0) : rows - max(up, 0)]
            there = np.s_[max(right, 0) : columns - max(-right, 0), max(up, 0) : rows - max(-up, 0)]
            both = open_cells[here] & open_cells[there]
            starts.append(number[here][both])
            ends.append(number[there][both])
            lengths.append(np.full(int(both.sum()), _CELL * hypot(right, up)))
        table = np.concatenate(lengths), (np.concatenate(starts), np.concatenate(ends))
        self._graph = csr_array(table, shape=(columns * rows, columns * rows))
        self._open = open_cells.ravel()

    def to(self, place: Point, wanted: BoolArray, longest: float) -> float:
        """m that no one's way from ``place`` to any of the ``wanted`` (cells,) falls short of; ``longest`` [m] where
        there is none as short as that.

        A straight path between any two positions is reported shorter as well, by up to 3 % and 7 cm.
        """
        away = np.where(self._open, np.hypot(*(self.places - np.array(place)).T), np.inf)
        start = int(np.argmin(away))
        if not np.isfinite(away[start]):
            return 0.0
        found = dijkstra(self._graph, indices=start, limit=_LONGER * (longest + 2.0 * _CELL))[wanted]
        shortest = float(found.min()) if len(found) else float("inf")
        return min(max(shortest / _LONGER - float(away[start]) - _CELL / 2**0.5, 0.0), longest)


@final
class Misjudges:
    """Scales each metre and m/s by ``1 + stretch``, and each radian by ``1 + turning``.

    Its frame is the true one at first. Goals are given in the frame that it believes in, as by someone who points there
    from where it is. What its laser measures is true.
    """

    def __init__(self, car: CarRobot, stretch: float, turning: float) -> None:
        self.car = car
        self._stretch, self._turning = 1.0 + stretch, 1.0 + turning
        x, y, yaw, _ = car.values
        self._true: Pose = (x, y, yaw)
        self._reported: Pose = (x, y, yaw)

    @property
    def true_pose(self) -> Pose:
        """Where it is: x, y [m], yaw [rad]."""
        x, y, yaw, _ = self.car.values
        return x, y, yaw

    @property
    def reported_pose(self) -> Pose:
        """Where it believes to be."""
        now = self.true_pose
        if now != self._true:
            (x, y, yaw), (before_x, before_y, before_yaw) = now, self._true
            aside = self._reported[2] - before_yaw
            way_x, way_y = self._stretch * (x - before_x), self._stretch * (y - before_y)
            self._reported = (
                self._reported[0] + way_x * cos(aside) - way_y * sin(aside),
                self._reported[1] + way_x * sin(aside) + way_y * cos(aside),
                self._reported[2] + self._turning * (yaw - before_yaw),
            )
            self._true = now
        return self._reported

    def in_reported_frame(self, places: FloatArray) -> FloatArray:
        """(n, 2) m; where true ``places`` (n, 2) [m] lie in the frame that it believes in, as seen from it now."""
        reported, true = self.reported_pose, self.true_pose
        believed: FloatArray = placed(places - np.array(true[:2]), reported[2] - true[2]) + np.array(reported[:2])
        return believed

    def state_message(self) -> StateMessage:
        """State k as reported; the pose of a load is for pictures only, and left out."""
        message = self.car.state_message()
        goal = self.in_reported_frame(np.array([message.goal]))[0]
        values = (*self.reported_pose, self._stretch * message.values[3])
        return replace(message, values=values, goal=tuple(goal.tolist()), load_pose=())

    def scans(self) -> Sequence[ScanMessage]:
        """What the car's sensors have to tell."""
        return self.car.scans()

    def receive(self, message: ActionMessage) -> str | None:
        """Accepts an action, or says why not."""
        return self.car.receive(message)

    def advance(self) -> None:
        """Lives through one period."""
        self.car.advance()


def placed(places: FloatArray, angle: float) -> FloatArray:
    """(n, 2) ``places`` turned by ``angle`` [rad] around the origin."""
    cosine, sine = cos(angle), sin(angle)
    turned: FloatArray = places @ np.array([[cosine, sine], [-sine, cosine]])
    return turned
