"""Attack: whole drives of the simulated robots, behind the real nodes, with a hostile policy."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, final

import numpy as np

from safedpa.bus import AbstractNode, StateMessage
from safedpa.dynamics import load_model
from safedpa.safety.defaults import settings_named
from safedpa.safety.prediction.delay_estimator import STATED_DELAY
from safedpa_lab.experiments.adversary.attack import AbstractAttack, Result, Row, notice_of
from safedpa_lab.experiments.common.drives import (
    LOADS,
    PERIOD,
    FunctionPolicyNode,
    Outcome,
    counted,
    shipped_nodes,
    statuses_of,
)
from safedpa_lab.experiments.driving.delayed_drives import DelayedDrives, Lateness, delayed_drives, margin_with_delay
from safedpa_lab.experiments.driving.long_drives import LongDrive, LongOutcome, long_summary, run_long_drive
from safedpa_lab.experiments.driving.reversing_drives import TOWED, ReversingDrive, run_reversing_drive
from safedpa_sim.closed_loop import Tick, drive
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene
from safedpa_sim.robots.pendulum.robot import PendulumRobot, task_named
from safedpa_sim.robots.pendulum.world import wind_towards

NominalPolicy = Callable[[StateMessage, np.random.Generator], tuple[float, ...]]

_SPEED: Final = (-0.6, 2.0)
_STEER: Final = 0.34
_THRUST: Final = 0.05
_TURN: Final = 4.0
_TORQUE: Final = 10.0
_LEG: Final = 1.0
"""s between two changes of mind."""


def _hostile_node(nominal_policy: NominalPolicy, seed: int) -> AbstractNode:
    """Publishes ``nominal_policy(state, random)`` in every tick."""

    def nominal_action(state: StateMessage) -> tuple[float, ...]:
        return nominal_policy(state, np.random.default_rng([seed, 5, int(state.robot_time / _LEG)]))

    return FunctionPolicyNode(nominal_action, "adversary")


def at_nearest(state: StateMessage, random: np.random.Generator) -> tuple[float, ...]:
    """A car at full speed at the nearest thing that is not behind it, or at the nearest of all."""
    x, y, yaw, _ = state.values
    heading = math.cos(yaw), math.sin(yaw)
    ahead = [at for at in _places(state) if heading[0] * (at[0] - x) + heading[1] * (at[1] - y) > 0.0]
    near = _nearest(ahead if ahead and random.uniform() < 0.7 else _places(state), x, y)
    bearing = math.atan2(near[1] - y, near[0] - x) - yaw
    return _SPEED[1], math.copysign(_STEER, math.sin(bearing))


def rocking(state: StateMessage, random: np.random.Generator) -> tuple[float, ...]:
    """A car from one end of its actuators to the other, now forwards, now backwards, as chance has it."""
    del state
    return float(random.choice(_SPEED)), float(random.choice((-_STEER, _STEER)))


def thrusting(state: StateMessage, random: np.random.Generator) -> tuple[float, ...]:
    """A point robot with full thrust at the nearest hazard, nose or tail first."""
    x, y, yaw = state.values[:3]
    near = _nearest(list(state.obstacles), x, y)
    bearing = math.atan2(near[1] - y, near[0] - x) - yaw
    ahead = math.cos(bearing) >= 0.0
    turn = math.sin(bearing) if ahead else -math.sin(bearing)
    return (_THRUST if ahead else -_THRUST), float(np.clip(_TURN * turn, -_TURN, _TURN)) * random.choice((1.0, 0.2))


def falling(state: StateMessage, random: np.random.Generator) -> tuple[float, ...]:
    """A pendulum with full torque out of its corridor, or now and then the other way with all of its swing."""
    low, high = state.corridor[:2]
    outwards = 1.0 if state.values[0] > 0.5 * (low + high) else -1.0
    return (_TORQUE * outwards * float(random.choice((1.0, 1.0, -1.0))),)


def hostile_driver(seed: int) -> AbstractNode:
    """A policy node that drives the car at the nearest obstacle."""
    return _hostile_node(at_nearest, seed)


def _places(state: StateMessage) -> list[tuple[float, ...]]:
    x, y = state.values[:2]
    west, east, south, north = state.field
    walls = [(west, y, 0.0), (east, y, 0.0), (x, south, 0.0), (x, north, 0.0)]
    return [*state.obstacles, *walls]


def _nearest(places: Sequence[tuple[float, ...]], x: float, y: float) -> tuple[float, ...]:
    return min(places, key=lambda place: math.hypot(place[0] - x, place[1] - y) - place[2])


_LOADS: Final = {"forward": LOADS, "any direction": LOADS, "killed": LOADS, "reversing": TOWED}
_FULL: Final = (50, 20.0)
"""Drives of each kind and load, and seconds of each."""
_SMALL: Final = (1, 3.0)


@final
@dataclass(frozen=True)
class Driven:
    """The result of one drive."""

    kind: str
    load: str
    seed: int
    outcome: Outcome | None
    missing: str = ""
    """Why the drive could not be made."""


Run = Callable[[str, int, float], Outcome]
"""Drives with a load, a seed and for so many seconds."""


@final
class Drives(AbstractAttack):
    """Collisions under a hostile policy: every load forwards and in any direction, processes killed; other robots."""

    name = "drives"
    sentence = "whole drives of car, pendulum and point robot with a policy that wants to hit something"

    def pieces(self, seed: int, small: bool) -> Sequence[Any]:  # noqa: D102
        count, seconds = _SMALL if small else _FULL
        return [
            (kind, load, 1000 * seed + number, seconds)
            for kind in KINDS
            for load in _LOADS.get(kind, ("none",))
            for number in range(count)
        ]

    def work(self, piece: Any) -> Driven:  # noqa: D102
        kind, load, seed, seconds = piece
        try:
            return Driven(kind, load, seed, KINDS[kind](load, seed, seconds))
        except ImportError as error:
            return Driven(kind, load, seed, None, f"{kind} robot: {error}")

    def reported(self, answers: Sequence[Any]) -> Result:  # noqa: D102
        rows: list[Row] = []
        made = [(each, each.outcome) for each in answers if each.outcome is not None]
        for kind in dict.fromkeys(driven.kind for driven in answers):
            rows += _rows(kind, [outcome for each, outcome in made if each.kind == kind])
        worst = [
            {"fault": "collision", "kind": each.kind, "load": each.load, "seed": each.seed, "count": outcome.collisions}
            for each, outcome in made
            if outcome.collisions
        ]
        return Result(rows, worst + [{"fault": each.missing} for each in answers if each.missing][:1])


def _rows(kind: str, driven: Sequence[Outcome]) -> list[Row]:
    notice = notice_of(statuses_of(each.statuses for each in driven))
    hit = sum(each.collisions > 0 for each in driven)
    return [
        Row(f"{kind}: drives with a collision ({notice})", hit, len(driven), most=0),
        Row(f"{kind}: least reported h", min((each.least_h for each in driven), default=0.0), len(driven), unit="m"),
    ]


def _car(nominal_policy: NominalPolicy, killed: bool = False) -> Run:
    def run(load: str, seed: int, seconds: float) -> Outcome:
        robot, ticks = CarRobot(Scene.random(seed, load), PERIOD), round(seconds / PERIOD)
        legs = _legs(robot, nominal_policy, seed, ticks)
        return counted(robot, legs if killed else drive(robot, _nodes("car", nominal_policy, seed), ticks))

    return run


def _legs(robot: CarRobot, nominal_policy: NominalPolicy, seed: int, ticks: int) -> Iterator[Tick]:
    """All processes are killed repeatedly and restart without memory; the watchdog brakes in between."""
    random, left = np.random.default_rng([seed, 6]), ticks
    while left > 0:
        leg = min(left, int(random.integers(5, 60)))
        yield from drive(robot, _nodes("car", nominal_policy, seed), leg)
        for _ in range(int(random.integers(1, 20))):
            robot.advance()
        left -= leg


def _point(load: str, seed: int, seconds: float) -> Outcome:
    from safedpa_sim.robots.point_robot import PointRobot, force_towards

    del load
    random = np.random.default_rng([seed, 7])
    robot = PointRobot(force_towards(float(random.uniform(0.0, 0.01)), float(random.uniform(0.0, 360.0))), seed)
    return counted(robot, drive(robot, _nodes("point", thrusting, seed), round(seconds / robot.period)))


def _pendulum(load: str, seed: int, seconds: float) -> Outcome:
    """Its ticks are short: a quarter of the time are as many."""
    del load
    random = np.random.default_rng([seed, 10])
    wind = wind_towards(float(random.uniform(0.0, 4.0)), float(random.uniform(0.0, 360.0)))
    robot = PendulumRobot(task_named("balance"), wind, seed)
    return counted(robot, drive(robot, _nodes("pendulum", falling, seed), round(0.25 * seconds / robot.period)))


def _nodes(name: str, nominal_policy: NominalPolicy, seed: int) -> list[AbstractNode]:
    return shipped_nodes(load_model(name), settings_named(name), _hostile_node(nominal_policy, seed))


KINDS: Final[Mapping[str, Run]] = {
    "forward": _car(at_nearest),
    "any direction": _car(rocking),
    "killed": _car(at_nearest, killed=True),
    "reversing": lambda load, seed, seconds: run_reversing_drive(ReversingDrive(load, seed, seconds))[0],
    "pendulum": _pendulum,
    "point": _point,
}


_CASES: Final = (
    *(Lateness(seconds) for seconds in (0.1, 0.2, 0.3, 0.4)),
    Lateness(0.2, reported="clock"),
    *(Lateness(seconds, reported="none") for seconds in (0.0, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4)),
)
_SMALL_CASES: Final = (Lateness(0.2), Lateness(0.15, reported="none"))
_HEAVIER: Final = 2.0
"""Factor of the mass of the load in the drives that are on time, but heavier than the filter knows."""
_LATE_FULL: Final = (40, 12.0)
"""Drives of each case, and seconds of each."""
_LATE_SMALL: Final = (1, 3.0)


@final
class LateDrives(AbstractAttack):
    """Collisions and what the verdicts are. A model that knows the delay has a margin that was measured so.

    The policy drives at the nearest obstacle. Beyond the stated delay a collision counts once a verdict has reported
    the delay and its command could act.
    """

    name = "late"
    sentence = "hostile drives whose commands arrive late, known and unknown"

    def pieces(self, seed: int, small: bool) -> Sequence[Any]:  # noqa: D102
        cases = [(case, 1.0) for case in (_SMALL_CASES if small else _CASES)]
        return [(*each, seed, small) for each in (*cases, (Lateness(0.0, reported="none"), _HEAVIER))]

    def work(self, piece: Any) -> tuple[DelayedDrives, float]:  # noqa: D102
        case, heavier, seed, small = piece
        count, seconds = _LATE_SMALL if small else _LATE_FULL
        margin = margin_with_delay(case) if case.reported == "model" and not small else None
        policy = hostile_driver if heavier == 1.0 else None
        found = delayed_drives(case, count, 1000 * seed, seconds, margin=margin, policy=policy, heavier=heavier)
        return found, heavier

    def reported(self, answers: Sequence[Any]) -> Result:  # noqa: D102
        return Result(
            [
                row
                for found, heavier in answers
                for row in (_late_rows(found) if heavier == 1.0 else _heavier_rows(found, heavier))
            ]
        )


def _heavier_rows(found: DelayedDrives, heavier: float) -> list[Row]:
    """The car's own policy, since a hostile one hardly lets it move."""
    ticks, name = sum(found.statuses.values()), f"load {heavier:g} times as heavy, on time"
    return [
        Row(f"{name}: verdicts that mention a delay", found.reported, ticks, most=0),
        Row(f"{name}: drives with a collision", found.collided, found.drives, most=0),
    ]


def _late_rows(found: DelayedDrives) -> list[Row]:
    """With a known delay, more actions have to be corrected than relaxed: otherwise the condition came too late."""
    late, statuses = found.lateness, found.statuses
    who = {"model": "known to the model", "clock": "reported by the clock", "none": "known to no one"}[late.reported]
    name, ticks, notice = f"{1000 * late.seconds:.0f} ms, {who}", sum(statuses.values()), notice_of(statuses)
    beyond = sum(statuses[status] for status in ("relaxed", "violated", "fallback"))
    asked = None if late.reported == "none" else 0
    promised = late.reported != "none" or late.seconds <= STATED_DELAY
    return [
        Row(f"{name}: drives with a collision ({notice})", found.collided, found.drives, most=0 if promised else None),
        Row(
            f"{name}: drives with a collision after the delay was reported", found.collided_after, found.drives, most=0
        ),
        Row(f"{name}: relaxed and worse beyond corrected", max(0, beyond - statuses["corrected"]), ticks, most=asked),
        Row(f"{name}: goals", found.goals, found.drives),
        Row(f"{name}: least h", found.least_h, found.drives, unit="m"),
    ]


_STANDING_FULL: Final = (25, 120.0)
"""Drives of each load, and seconds of each."""
_STANDING_SMALL: Final = (1, 4.0)
_LATENESS: Final = (0.0, 0.006)
"""s from sense to act: as in lockstep, and as a robot in real time reports it."""
_MOST_IS_STATIONARY: Final = 2
_GOALS: Final = 6.0
"""A minute, in the mean."""
_POINT: Final = "point"


@final
class Standing(AbstractAttack):
    """Stops of ten seconds and more, by position, and whether the verdicts report them."""

    name = "standing"
    sentence = "two minutes of driving with every load: long stops, whether they are reported, and goals"

    def pieces(self, seed: int, small: bool) -> Sequence[Any]:  # noqa: D102
        count, seconds = _STANDING_SMALL if small else _STANDING_FULL
        return [
            LongDrive(load, 1000 * seed + number, seconds, until_action=_LATENESS[number % len(_LATENESS)])
            for load in LOADS
            for number in range(count)
        ] + [LongDrive(_POINT, 1000 * seed + number, seconds, driver=_POINT) for number in range(count)]

    def work(self, piece: Any) -> LongOutcome:  # noqa: D102
        return run_long_drive(piece)

    def reported(self, answers: Sequence[Any]) -> Result:  # noqa: D102
        found = long_summary(answer for answer in answers if answer.load != _POINT)
        point = long_summary(answer for answer in answers if answer.load == _POINT)
        drives = found["drives"]
        rows = [
            Row("drives with a stand of 10 s and more", found["stands"], drives, most=_MOST_IS_STATIONARY),
            Row("of these, not reported", found["untold"], found["stands"], most=0),
            Row("drives with less than 1 m in any 20 s", found["crawls"], drives, most=_MOST_IS_STATIONARY),
            Row("goals a minute", found["goals_a_minute"], drives, least=_GOALS),
            Row("collisions", found["collisions"], drives, most=0),
            Row("point robot: drives with a stand of 10 s and more", point["stands"], point["drives"], most=0),
            Row("point robot: drives with less than 1 m in any 20 s", point["crawls"], point["drives"]),
            Row("point robot: goals a minute", point["goals_a_minute"], point["drives"]),
            Row("point robot: hazards entered", point["collisions"], point["drives"], most=0),
        ]
        longest = sorted(answers, key=lambda each: -each.longest_stand)[:5]
        worst = [
            {"fault": "stand", "load": each.load, "seed": each.seed, "seconds": each.longest_stand} for each in longest
        ]
        return Result(rows, [*worst, *found["standstills"], *point["standstills"]])
