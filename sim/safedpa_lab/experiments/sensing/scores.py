"""By how much perception overestimates h, at each tick of a drive.

The filter takes an action where h of the reported scene keeps the margin epsilon at the state x^ that it predicts for
the next tick. The promise is about the true scene, at the state x that comes. For each kind of thing that is there

    e_k = min over reported discs i of h_i(x^[k+1])  -  min over true things j of h_j(x[k+1]),

h in metres, the filter's own barriers of tick k. e_k <= epsilon implies the promise of tick k, since

    min_j h_j(x[k+1]) = min_i h_i(x^[k+1]) - e_k >= epsilon - e_k >= 0,

and h_j >= 0 of a true thing is what is promised: the car stands before the thing can be where the car is. So e_k holds
whatever comes between: noise, age, lost rays, cells, who was seen too late, odometry, and the error of the model.

- ``obstacle``: j are all places of pillars, boxes and walls, h that of what is at rest; i are the reported points and
  the reported movers, as if they were at rest.
- ``mover``: j are the people whom a ray of the scan that was looked at last hit, at their places p when it was
  measured, wider by their top speed w times its age a: wherever each may have gone since, h_j with R = r + w a. So e_k
  counts the worst possible motion, not the actual one. i are reported movers and hidden places.
- ``stood``: the same of people who have stood where they were first seen for as long as perception takes to believe
  it: they are reported as at rest, and nothing is promised about them until they walk. They get no margin.
- ``hidden``: the same of people whom no ray hit, h with what no one sees behind the car, or towards whom it creeps.
  Who has to walk around something is as far away as his shortest way there is long (``WaysAround``).
- ``model``: j are the reported discs themselves: what of ``mover`` and ``hidden`` is the error of the model.

A tick counts for a kind if a true thing of it is near, h_j < ``NEAR``, and the car moves in x[k+1]: below
``IS_STATIONARY`` it keeps every promise. Reported distances count as ``NEAR`` at most then.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import ceil, cos, gcd, hypot, inf, sin
from typing import Any, Final, NamedTuple, final

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from safedpa.arrays import BoolArray, FloatArray, IndexArray
from safedpa.bus import ActionMessage, ReceivedMessage, ScanMessage, StateMessage, SurroundingsMessage
from safedpa.equations import Given
from safedpa.operations import NUMPY
from safedpa.perception import PerceptionSettings
from safedpa.perception.odometry import Pose
from safedpa.perception.scan import within_body
from safedpa.robots.car.barriers.body import TrailerEnvelope
from safedpa.robots.car.barriers.moving_obstacles import MovingObstacleBarrier
from safedpa.robots.car.barriers.obstacles import ObstacleBarrier, braking_of
from safedpa.robots.car.barriers.reverse_odometer import ReverseOdometer
from safedpa.robots.car.dynamics.limits import IS_STATIONARY
from safedpa.robots.car.scenes.sensed import reversal_braking
from safedpa.safety.settings import FilterSettings
from safedpa_lab.experiments.sensing.nodes import edge_points
from safedpa_sim.closed_loop import Tick
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene
from safedpa_sim.sensing import Person
from safedpa_sim.sensing.shapes import Outline, Point, cast, clearances_at

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


NEAR: Final = {"obstacle": 0.5, "mover": 1.0, "hidden": 1.0, "model": 0.5, "stood": 1.0}
"""By kind, m of h: farther from the boundary no margin has to cover anything."""
_RETAINED_FROM: Final = 1.5
"""m of h, below which steps are counted at all."""
_FAR: Final = 1e3
_APART: Final = 0.02
"""m between the points of an edge: between two of them nothing gets nearer by more than 1 mm."""
_HIT: Final = 0.1
"""m that a ray's end lies off someone's outline at most, five deviations of its noise."""
_WALKS: Final = 0.1
"""m from where someone was first seen, beyond which he walks: a cell."""
_RETAINED: Final = 40
"""Ticks whose people are remembered: 2 s."""


class Score(NamedTuple):
    """One kind of thing at one tick; h in m."""

    kind: str
    time: float
    """s"""
    hoped: float
    """Least h of the reported scene, at the predicted state."""
    true: float
    """Least h of the true scene, at the actual next state."""
    speed: float
    """m/s"""
    who: int
    """Number of the person with the least h; -1: of none."""
    seen_for: float
    """s for which a person has been seen without interruption; 0 if hidden."""
    apart: tuple[float, float, float]
    """m from the true body, on the side of the car, to the discs reported as points, movers and hidden places; below
    0 within one, 1000 where there is none. Of people the place where they were when they were measured."""
    grown: float
    """m by which moving discs are reported larger because of the age of the measurement."""


@dataclass(frozen=True)
class _Then:
    """The true scene of a tick; positions in the true frame."""

    time: float
    pose: Pose
    people: FloatArray
    """(people, 2) m"""


@final
class Scores:
    """Of one drive: ``hear`` each message of a tick, then ``after`` with the tick, once the robot has lived through it.

    ``sensing``: what perception reckons with.
    """

    def __init__(
        self, robot: Misjudges, people: Sequence[Person], settings: FilterSettings, sensing: PerceptionSettings
    ) -> None:
        scene = robot.car.scene
        self._robot, self._people, self._settings = robot, people, settings
        self._fastest, self._still_after = sensing.fastest, sensing.still_after
        self._radii = np.array([person.radius for person in people])
        outline = Outline(scene.obstacles, scene.polygons, (scene.field,))
        self._rest = np.vstack([outline.discs, *(edge_points(edge, _APART, 0.0) for edge in outline.edges)])
        self._ways = WaysAround(scene, min(self._radii)) if len(people) else None
        self._way = ReverseOdometer()
        self._past: deque[_Then] = deque(maxlen=_RETAINED)
        self._scans: dict[float, ScanMessage] = {}
        self._reported: SurroundingsMessage | None = None
        self._since = np.full(len(people), inf)
        """s; when each was seen first without a break."""
        self._first = np.zeros((len(people), 2))
        """(people, 2) m; where that was."""
        self._walked = np.zeros(len(people), dtype=bool)
        """People who have left it."""
        self._looked = -inf
        self._seen = np.zeros(len(people), dtype=bool)
        self.found: list[Score] = []
        self._remember(robot.state_message())

    def hear(self, item: ReceivedMessage) -> None:
        """Takes up what the laser and perception tell."""
        if isinstance(item.message, ScanMessage):
            self._scans[item.message.robot_time] = item.message
        elif isinstance(item.message, SurroundingsMessage):
            self._reported = item.message

    def after(self, tick: Tick) -> None:
        """Compares the reported and predicted scene of a tick with the true one after it."""
        state, reported, came = tick.state, self._reported, self._robot.state_message()
        self._way.follow(state)
        if reported is not None and reported.tick == state.tick and not reported.problems and reported.ages[0] >= 0.0:
            self._look(state, reported.ages[0])
            if tick.verdict.predicted and came.applied_by == "filter" and abs(came.values[3]) >= IS_STATIONARY:
                self._score(state, reported, tick.verdict.predicted[0], came)
        self._remember(came)

    def _remember(self, state: StateMessage) -> None:
        places = np.array([person.position for person in self._people]).reshape(-1, 2)
        self._past.append(_Then(state.robot_time, self._robot.true_pose, places))

    def _then(self, time: float) -> _Then:
        """The last tick at ``time`` [s] or before."""
        return next((one for one in reversed(self._past) if one.time <= time + 1e-9), self._past[0])

    def _look(self, state: StateMessage, age: float) -> None:
        """People seen in the newest processed scan."""
        time = state.robot_time - age
        scan = next((one for moment, one in self._scans.items() if abs(moment - time) < 1e-6), None)
        if scan is None or time == self._looked:
            return
        then = self._then(time)
        self._seen = np.array(
            [
                _hit(scan, then.pose, state, (*place, radius))
                for place, radius in zip(then.people, self._radii, strict=True)
            ],
            dtype=bool,
        )
        again = self._seen & (self._since == inf)
        self._first[again] = then.people[again]
        self._since = np.where(self._seen, np.minimum(self._since, time), inf)
        self._walked = self._seen & (self._walked | (np.hypot(*(then.people - self._first).T) > _WALKS))
        self._looked = time
        self._scans = {moment: one for moment, one in self._scans.items() if moment > time}

    def _score(
        self, state: StateMessage, reported: SurroundingsMessage, hoped: tuple[float, ...], came: StateMessage
    ) -> None:
        towed = self._way.reach(state)
        bodies = _Bodies(self._settings, state, towed)
        tables = ((reported.points, 3), (reported.movers, 6), (reported.hidden, 4))
        points, movers, places = (np.array(rows, dtype=np.float64).reshape(-1, width) for rows, width in tables)
        discs = np.vstack([movers[:, [0, 1, 2, 5]], places])
        unseen = np.arange(len(discs)) >= len(movers)
        reported_h = _least(bodies.moving(discs, unseen, hoped))
        self._add("model", reported_h, _least(bodies.moving(discs, unseen, came.values)), came)
        rest = np.column_stack([self._robot.in_reported_frame(self._rest[:, :2]), self._rest[:, 2]])
        at_rest = bodies.resting(rest, came.values)
        reported_rest = _least(bodies.resting(np.vstack([points, movers[:, :3]]), hoped))
        nearest = int(np.argmin(at_rest))
        here = _facing(rest[nearest], came.values)
        apart = tuple(_to(table, here) for table in (points, movers, places))
        self._add("obstacle", reported_rest, float(at_rest[nearest]), came, apart=apart)
        if not len(self._people):
            return
        then = self._then(state.robot_time - reported.ages[0])
        grown = self._radii + self._fastest * (state.robot_time - then.time)
        people = np.column_stack(
            [self._robot.in_reported_frame(then.people), grown, np.full(len(grown), self._fastest)]
        )
        h = bodies.moving(people, ~self._seen, came.values)
        for who in np.flatnonzero(~self._seen & (h < _RETAINED_FROM)).tolist():
            h[who] = self._around(bodies, people[who], then.people[who], came.values, float(h[who]))
        stood = self._seen & ~self._walked & (state.robot_time - self._since >= self._still_after)
        for kind, wanted in (("mover", self._seen & ~stood), ("hidden", ~self._seen), ("stood", stood)):
            if (one := _nearest(h, wanted)) is not None:
                here = _facing((*people[one, :2], self._radii[one]), came.values)
                apart = tuple(_to(table, here) for table in (points, movers, places))
                self._add(kind, reported_h, float(h[one]), came, one, apart, float(grown[one] - self._radii[one]))

    def _around(
        self, bodies: _Bodies, person: FloatArray, place: FloatArray, values: tuple[float, ...], straight: float
    ) -> float:
        """h of a person who walks around objects at rest: the disc shrinks by the length of the detour."""
        assert self._ways is not None
        cells = self._robot.in_reported_frame(self._ways.places)
        there = np.column_stack([cells, np.full(len(cells), person[2]), np.zeros(len(cells))])
        touches = bodies.moving(there, np.zeros(len(cells), dtype=bool), values) <= 0.0
        direct = max(float(bodies.moving(np.array([[*person[:3], 0.0]]), np.array([False]), values)[0]), 0.0)
        way = self._ways.to((float(place[0]), float(place[1])), touches, direct + _RETAINED_FROM - straight + 0.1)
        smaller = np.array([[*person[:2], person[2] - max(way - direct, 0.0), person[3]]])
        return float(bodies.moving(smaller, np.array([True]), values)[0])

    def _add(
        self,
        kind: str,
        hoped: float,
        true: float,
        came: StateMessage,
        who: int = -1,
        apart: tuple[float, ...] = (_FAR, _FAR, _FAR),
        grown: float = 0.0,
    ) -> None:
        if true >= _RETAINED_FROM:
            return
        since = float(self._since[who]) if who >= 0 else inf
        seen_for = came.robot_time - since if since < inf else 0.0
        here, time = (apart[0], apart[1], apart[2]), came.robot_time
        self.found.append(Score(kind, time, min(hoped, _FAR), true, came.values[3], who, seen_for, here, grown))


@final
class _Bodies:
    """The filter's barriers of one tick over arrays of discs, without picking those that matter."""

    def __init__(self, settings: FilterSettings, state: StateMessage, towed: TrailerEnvelope | None) -> None:
        rear, front, radius = state.footprint
        body, braking, self._clearance = (rear, front, radius), braking_of(settings), settings.barrier("clearance")
        own, counter = settings.barrier("own_radius"), reversal_braking(settings)
        known: dict[str, Any] = {"towed": towed, "creeps": settings.barrier("creeping"), "own_radius": own}
        moving = MovingObstacleBarrier((), (), body, braking, counter, self._clearance, state.period, **known)
        self._moving = moving.shared
        self._resting = ObstacleBarrier((), body, braking, self._clearance, towed=towed).shared
        self._radius, self._period = radius, state.period
        self._thick = radius if towed is None else min(own or radius, radius)

    def moving(self, discs: FloatArray, unseen: BoolArray, state: Sequence[float]) -> FloatArray:
        """h (n,) of discs x, y, R, w (n, 4) that may move, of which some are ``unseen`` (n,)."""
        x, y, radius, fastest = discs.T
        each = (x, y, radius + self._thick + self._clearance + fastest * self._period, fastest)
        given = Given(tuple(state), self._moving, (*each, np.where(unseen, 0.0, fastest)))
        return np.asarray(MovingObstacleBarrier.equation(given, NUMPY)[0])

    def resting(self, discs: FloatArray, state: Sequence[float]) -> FloatArray:
        """h (n,) of discs x, y, R (n, 3) at rest."""
        x, y, radius = discs.T
        given = Given(tuple(state), self._resting, (x, y, radius + self._radius + self._clearance))
        return np.asarray(ObstacleBarrier.equation(given, NUMPY)[0])


def _least(h: FloatArray) -> float:
    return float(h.min()) if len(h) else _FAR


def _nearest(h: FloatArray, wanted: BoolArray) -> int | None:
    """Index of the least h (n,) among ``wanted`` (n,); None if there is none."""
    return int(np.argmin(np.where(wanted, h, inf))) if wanted.any() else None


def _facing(disc: Sequence[float], state: Sequence[float]) -> FloatArray:
    """(2,) m; the place of a disc x, y, R that is nearest to the car's middle."""
    middle = np.array((disc[0], disc[1]))
    way = np.array(state[:2]) - middle
    found: FloatArray = middle + disc[2] * way / max(float(np.hypot(*way)), 1e-9)
    return found


def _to(discs: FloatArray, place: FloatArray) -> float:
    """m from a place to the nearest of discs x, y, R, ...; below 0 within one."""
    return _least(np.hypot(*(discs[:, :2] - place).T) - discs[:, 2])


def _hit(scan: ScanMessage, pose: Pose, state: StateMessage, disc: tuple[float, float, float]) -> bool:
    """Whether a ray of a scan that was measured at ``pose`` ends on someone, and not on what is the robot's own."""
    x, y, yaw = pose
    ahead, aside, turned = scan.mount
    here = np.array((x, y)) + placed(np.array([[ahead, aside]]), yaw)[0]
    angles = yaw + turned + scan.first_angle + scan.angle_step * np.arange(len(scan.ranges), dtype=np.float64)
    ranges = np.array(scan.ranges)
    away = cast(Outline((disc,)), float(here[0]), float(here[1]), angles)
    on_him = (ranges >= scan.nearest) & (np.abs(ranges - away) < _HIT)
    ends = here + ranges[on_him, np.newaxis] * np.column_stack([np.cos(angles[on_him]), np.sin(angles[on_him])])
    return bool((~within_body(ends, pose, state)).any())
