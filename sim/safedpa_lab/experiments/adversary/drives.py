"""Attack: whole drives of the simulated robots, behind the real nodes, with a hostile policy."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, final

import numpy as np

from safedpa.adaptation import AdaptationNode
from safedpa.bus import AbstractNode
from safedpa.dynamics import load_model
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety.defaults import margin_for, settings_named
from safedpa_lab.experiments.adversary.attack import AbstractAttack, Result, Row
from safedpa_lab.experiments.adversary.hostile import (
    HostileNode,
    NominalPolicy,
    at_nearest,
    falling,
    rocking,
    thrusting,
)
from safedpa_lab.experiments.reversing_drives import TOWED, ReversingDrive, run_reversing_drive
from safedpa_sim.closed_loop import Tick, drive
from safedpa_sim.robots.core import CarRobot
from safedpa_sim.robots.pendulum_robot import PendulumRobot
from safedpa_sim.robots.pendulum_task import task_named
from safedpa_sim.robots.pendulum_world import wind_towards
from safedpa_sim.robots.scene import Scene

__all__ = ["KINDS", "Driven", "Drives"]

_PERIOD: Final = 0.05
_EVERY: Final = ("none", "box", "chair", "large_chair")
_LOADS: Final = {"forward": _EVERY, "any direction": _EVERY, "killed": _EVERY, "reversing": TOWED}
_FULL: Final = (50, 20.0)
"""Drives of each kind and load, and seconds of each."""
_SMALL: Final = (1, 3.0)


@final
@dataclass(frozen=True)
class Driven:
    """What became of one drive."""

    kind: str
    load: str
    seed: int
    collisions: int
    least_h: float
    statuses: Mapping[str, int]
    missing: str = ""
    """Why the drive could not be made."""


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
        return KINDS[kind](kind, load, seed, seconds)

    def reported(self, answers: Sequence[Any]) -> Result:  # noqa: D102
        rows: list[Row] = []
        for kind in dict.fromkeys(driven.kind for driven in answers):
            rows += _rows(kind, [driven for driven in answers if driven.kind == kind and not driven.missing])
        worst = [
            {"fault": "collision", "kind": each.kind, "load": each.load, "seed": each.seed, "count": each.collisions}
            for each in answers
            if each.collisions
        ]
        return Result(rows, worst + [{"fault": each.missing} for each in answers if each.missing][:1])


def _rows(kind: str, driven: Sequence[Driven]) -> list[Row]:
    statuses: Counter[str] = Counter()
    for each in driven:
        statuses.update(each.statuses)
    seen = max(1, sum(statuses.values()))
    notice = ", ".join(f"{status} {100 * count / seen:.1f} %" for status, count in sorted(statuses.items()))
    hit = sum(each.collisions > 0 for each in driven)
    return [
        Row(f"{kind}: drives with a collision ({notice})", hit, len(driven), most=0),
        Row(f"{kind}: least h told", min((each.least_h for each in driven), default=0.0), len(driven), unit="m"),
    ]


def _car(nominal_policy: NominalPolicy, killed: bool = False) -> Callable[[str, str, int, float], Driven]:
    def run(kind: str, load: str, seed: int, seconds: float) -> Driven:
        robot = CarRobot(Scene.random(seed, load), _PERIOD)
        ticks = round(seconds / _PERIOD)
        reported = (
            _legs(robot, nominal_policy, seed, ticks)
            if killed
            else drive(robot, _nodes("car", nominal_policy, seed), ticks)
        )
        return _driven(kind, load, seed, robot, reported)

    return run


def _legs(robot: CarRobot, nominal_policy: NominalPolicy, seed: int, ticks: int) -> Iterator[Tick]:
    """All processes are killed again and again, and begin again with nothing remembered; the watchdog brakes between."""
    random, left = np.random.default_rng([seed, 6]), ticks
    while left > 0:
        leg = min(left, int(random.integers(5, 60)))
        yield from drive(robot, _nodes("car", nominal_policy, seed), leg)
        for _ in range(int(random.integers(1, 20))):
            robot.advance()
        left -= leg


def _point(kind: str, load: str, seed: int, seconds: float) -> Driven:
    try:
        from safedpa_sim.robots.point_robot import PointRobot, force_towards

        random = np.random.default_rng([seed, 7])
        wind = force_towards(float(random.uniform(0.0, 0.01)), float(random.uniform(0.0, 360.0)))
        robot = PointRobot(wind, seed)
    except ImportError as error:
        return Driven(kind, load, seed, 0, 0.0, {}, f"point robot: {error}")
    ticks = round(seconds / robot.period)
    return _driven(kind, load, seed, robot, drive(robot, _nodes("point", thrusting, seed), ticks))


def _reversing(kind: str, load: str, seed: int, seconds: float) -> Driven:
    found = run_reversing_drive(ReversingDrive(load, seed, seconds))
    return Driven(kind, load, seed, found.collisions, found.least_h, found.statuses)


def _pendulum(kind: str, load: str, seed: int, seconds: float) -> Driven:
    random = np.random.default_rng([seed, 10])
    wind = wind_towards(float(random.uniform(0.0, 4.0)), float(random.uniform(0.0, 360.0)))
    robot = PendulumRobot(task_named("balance"), wind, seed)
    ticks = round(0.25 * seconds / robot.period)  # its ticks are short: a quarter of the time are as many
    return _driven(kind, load, seed, robot, drive(robot, _nodes("pendulum", falling, seed), ticks))


def _nodes(name: str, nominal_policy: NominalPolicy, seed: int) -> list[AbstractNode]:
    model = load_model(name)
    return [
        AdaptationNode(model),
        HostileNode(nominal_policy, seed),
        SafetyFilterNode(model, settings_named(name), margin_for(model)),
    ]


def _driven(kind: str, load: str, seed: int, robot: Any, reported: Iterator[Tick]) -> Driven:
    statuses: Counter[str] = Counter()
    least = float("inf")
    for tick in reported:
        statuses[tick.verdict.status] += 1
        least = min(least, tick.verdict.h_now)
    return Driven(kind, load, seed, len(robot.collisions), least, dict(statuses))


KINDS: Final[Mapping[str, Callable[[str, str, int, float], Driven]]] = {
    "forward": _car(at_nearest),
    "any direction": _car(rocking),
    "killed": _car(at_nearest, killed=True),
    "reversing": _reversing,
    "pendulum": _pendulum,
    "point": _point,
}
"""By name: ``run(kind, load, seed, seconds)``."""
