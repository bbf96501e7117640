"""Nodes in place of the product's: other projects' brakes that look at the scan alone, and perfect perception.

The brakes are made from their documentation, with its default parameters; each passes the nominal action on, slowed
down. None knows the model of the car, what moves, or what it does not see.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from math import ceil, cos, inf, isfinite, sin, tan
from typing import Protocol, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.bus import (
    ACTION,
    NOMINAL,
    SCAN,
    SURROUNDINGS,
    VERDICT,
    AbstractNode,
    ActionMessage,
    Inputs,
    Message,
    NominalMessage,
    Outputs,
    ScanMessage,
    StateMessage,
    SurroundingsMessage,
    VerdictMessage,
)
from safedpa.perception import PerceptionNode, PerceptionSettings
from safedpa.perception.odometry import OdometryBuffer
from safedpa.perception.scan import ScanRays
from safedpa_lab.experiments.common.drives import stamp
from safedpa_sim.robots.car.scene import Scene
from safedpa_sim.sensing.shapes import Outline, Point

_TIME_OUT = 1.0
"""s"""
_WHEELBASE = 0.32
"""m; from the wheels' angle to the turning rate that the monitor knows."""


@final
class ScanPoints:
    """The points of each source's newest scan in the body frame, moved by the robot's own way since."""

    def __init__(self) -> None:
        self._odometry = OdometryBuffer()
        self._newest: dict[str, ScanMessage] = {}

    def hear(self, scan: ScanMessage) -> None:
        """Takes a scan."""
        self._newest[scan.source] = scan

    def points(self, state: StateMessage) -> FloatArray | None:
        """Points (n, 2) [m] at ``state``, called once in each tick; None if a source has no scan that can be placed."""
        x, y, yaw = state.values[:3]
        self._odometry.add(state.robot_time, (x, y, yaw))
        ends = []
        for source in state.sources:
            scan = self._newest.get(source)
            pose = None if scan is None else self._odometry.at(scan.robot_time)
            if scan is None or pose is None or state.robot_time - scan.robot_time > _TIME_OUT:
                return None
            ends.append(ScanRays(scan, pose, state, open_air=False).ends)
        apart = np.vstack([np.empty((0, 2)), *ends]) - (x, y)
        return np.column_stack(
            [cos(yaw) * apart[:, 0] + sin(yaw) * apart[:, 1], cos(yaw) * apart[:, 1] - sin(yaw) * apart[:, 0]]
        )


class _Brake(AbstractNode):
    """Stops without a scan, as a source that times out does; else passes a share of the nominal speed on."""

    name = "safety_filter"
    inputs = (NOMINAL,)
    outputs = (ACTION, VERDICT)
    listens = (SCAN,)
    share = 0.5

    def __init__(self) -> None:
        self._scans = ScanPoints()

    def hear(self, robot: str, message: Message) -> None:
        assert isinstance(message, ScanMessage)
        self._scans.hear(message)

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:
        nominal = inputs[NOMINAL]
        values = nominal.values if isinstance(nominal, NominalMessage) else (0.0, 0.0)
        points = self._scans.points(state)
        share = 0.0 if points is None else self.share_of(points, state, values)
        action = (share * values[0], values[1])
        status = "passed" if share == 1.0 else "corrected"
        known = {**stamp(state), "publish_time": 0.0}
        verdict = VerdictMessage(
            **known, status=status, sentence="", action=action, nominal=values, slack=0.0, active=(), h_now=0.0,
            h_next=0.0, margin=0.0, solver="", microseconds=0.0,
        )  # fmt: skip
        return {ACTION: ActionMessage(**known, values=action), VERDICT: verdict}

    @abstractmethod
    def share_of(self, points: FloatArray, state: StateMessage, nominal: tuple[float, ...]) -> float:
        """The share of the nominal speed that is let through, 0 to 1, of ``points`` (n, 2) [m] in the car's frame."""


@final
class NoFilter(_Brake):
    """Hands every nominal action on."""

    def share_of(self, points: FloatArray, state: StateMessage, nominal: tuple[float, ...]) -> float:  # noqa: D102
        del points, state, nominal
        return 1.0


@final
class CollisionMonitor(_Brake):
    """nav2's collision monitor, one polygon of the action ``approach`` around the footprint.

    The footprint is moved with the nominal speed and turning rate in steps of ``simulation_time_step`` 0.1 s; t is the
    first time at which ``min_points`` 6 points lie within it. Both are scaled by t / ``time_before_collision`` where
    that is below 1. Defaults of nav2_bringup's ``nav2_params.yaml``: 1.2 s; ``patience`` tunes it.
    Source: Nav2 documentation, Collision Monitor (docs.nav2.org), and its node's ``processApproach``.
    """

    def __init__(self, patience: float = 1.2, min_points: int = 6) -> None:
        super().__init__()
        self._patience, self._least = patience, min_points

    def share_of(self, points: FloatArray, state: StateMessage, nominal: tuple[float, ...]) -> float:  # noqa: D102
        rear, front, radius = state.footprint
        speed, turning = nominal[0], nominal[0] * tan(nominal[1]) / _WHEELBASE
        for step in range(round(self._patience / 0.1) + 1):
            seconds = 0.1 * step
            angle = turning * seconds
            reach = speed * seconds
            bent = angle / 2.0
            chord = reach if abs(bent) < 1e-9 else reach * sin(bent) / bent
            apart = points - (chord * cos(bent), chord * sin(bent))
            along = cos(angle) * apart[:, 0] + sin(angle) * apart[:, 1]
            across = cos(angle) * apart[:, 1] - sin(angle) * apart[:, 0]
            within = np.hypot(along - np.clip(along, -rear, front), across) < radius
            if int(within.sum()) >= self._least:
                return min(seconds / self._patience, 1.0)
        return 1.0


@final
class TimeToCollision(_Brake):
    """The automatic emergency brake of the F1TENTH course: stops where the least r / max(-dr/dt, 0) is too small.

    r is a ray's length beyond the car's own outline, dr/dt = -v cos(angle) for the speed v of now.
    Source: f1tenth_gym_ros course, lab 2, Automatic Emergency Braking.
    """

    def __init__(self, least: float = 0.8) -> None:
        super().__init__()
        self._least = least

    def share_of(self, points: FloatArray, state: StateMessage, nominal: tuple[float, ...]) -> float:  # noqa: D102
        rear, front, radius = state.footprint
        length = np.hypot(points[:, 0], points[:, 1])
        ahead = points[:, 0] / np.maximum(length, 1e-9)
        closing = state.values[3] * ahead
        alongside = np.abs(points[:, 1]) < radius
        edge = np.where(closing > 0.0, (front if state.values[3] > 0.0 else rear) + radius, 0.0)
        left = np.where(alongside, np.maximum(np.abs(points[:, 0]) - edge, 0.0), inf)
        with np.errstate(divide="ignore", invalid="ignore"):
            seconds = np.where((closing > 0.0) & alongside, left / closing, inf)
        least = float(seconds.min()) if len(seconds) else inf
        same_way = nominal[0] * state.values[3] > 0.0
        return 0.0 if isfinite(least) and least < self._least and same_way else 1.0


_APART = 0.1
"""m between the points of an edge: between two of them a car's body gets up to 7 mm nearer to it."""
_RADIUS = 0.01
"""m of each."""


class Disc(Protocol):
    """Someone, or a part of something, that moves."""

    @property
    def position(self) -> Point:
        """x, y [m] now."""

    @property
    def radius(self) -> float:
        """m"""


@final
class ReportsEverything(AbstractNode):
    """Publishes with each state the true scene and the positions of all people; nothing is hidden.

    No one's next step is known: anyone who may move may do so at the speed that perception reckons with.
    """

    name = "perception"
    inputs = ()
    outputs = (SURROUNDINGS,)
    share = 0.0

    def __init__(
        self, scene: Scene | Outline, people: Sequence[Disc], settings: PerceptionSettings | None = None
    ) -> None:
        self._people, self._settings = people, settings or PerceptionSettings()
        outline = scene if isinstance(scene, Outline) else Outline(scene.obstacles, scene.polygons, (scene.field,))
        self._points = np.vstack([outline.discs, *(edge_points(edge, _APART, _RADIUS) for edge in outline.edges)])

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:  # noqa: D102
        del robot, inputs
        here = np.array(state.values[:2])
        away = np.hypot(*(self._points[:, :2] - here).T) - self._points[:, 2]
        order = np.argsort(away)
        near = self._points[order[away[order] < self._settings.reach]]
        message = SurroundingsMessage(
            **stamp(state),
            points=tuple(map(tuple, near.tolist())),
            movers=tuple((*one.position, one.radius, 0.0, 0.0, self._settings.fastest) for one in self._people),
            hidden=(),
            ages=(0.0,) * len(state.sources),
        )
        return {SURROUNDINGS: message}


@final
class ReportsAllButWhoHides(AbstractNode):
    """Publishes the true scene, the positions of all people, and the places hidden from the laser: what the promise
    about who hides costs, with nothing lost to noise, age and tracks."""

    name = "perception"
    inputs = ()
    outputs = (SURROUNDINGS,)
    listens = (SCAN,)
    share = 0.0

    def __init__(self, scene: Scene, people: Sequence[Disc], settings: PerceptionSettings) -> None:
        self._seen, self._reported = PerceptionNode(settings), ReportsEverything(scene, people, settings)

    def hear(self, robot: str, message: Message) -> None:  # noqa: D102
        self._seen.hear(robot, message)

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:  # noqa: D102
        seen = self._seen.step(robot, state, inputs)
        reported = self._reported.step(robot, state, inputs)[SURROUNDINGS]
        if not seen or not isinstance(reported, SurroundingsMessage):
            return seen
        message = seen[SURROUNDINGS]
        assert isinstance(message, SurroundingsMessage)
        return {SURROUNDINGS: replace(message, points=reported.points, movers=reported.movers)}


def edge_points(edge: FloatArray, apart: float, radius: float) -> FloatArray:
    """Discs (n, 3) of a ``radius`` [m] from one end of an edge x, y, x, y [m] to the other, ``apart`` [m] at most."""
    start, end = edge[:2], edge[2:]
    count = max(ceil(float(np.hypot(*(end - start))) / apart), 1) + 1
    places = start + np.linspace(0.0, 1.0, count)[:, np.newaxis] * (end - start)
    return np.column_stack([places, np.full(count, radius)])
