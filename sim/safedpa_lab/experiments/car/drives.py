"""Recorded drives of the pymunk car for the car experiment: to calibrate margins, to measure predictions and latents.

Whatever model is measured on them later, they are driven in the same way, so that every model sees the same data.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field
from math import pi
from pathlib import Path
from typing import Any, final

import numpy as np

from safedpa.adaptation import AdaptationNode
from safedpa.arrays import FloatArray
from safedpa.bus import AbstractNode, StateMessage
from safedpa.dynamics import load_model
from safedpa.errors import InputError
from safedpa.policy import PolicyNode
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety import FilterSettings
from safedpa.safety.defaults import settings_named
from safedpa_lab.experiments.car.conditions import TICKS, ChangedNominal, car_scene
from safedpa_lab.experiments.car.methods import METHODS, nodes_of
from safedpa_sim.closed_loop import drive
from safedpa_sim.robots.car.loads import load_named
from safedpa_sim.robots.car.parameters import CAR_PARAMETERS
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene

_OPEN = 60.0
"""m from the middle to the walls of the open field, which no drive reaches."""
_GOALS = 5.0
"""m around the middle in which its goals lie."""
_HELD = (0.4, 1.5)
"""s; shortest and longest time that an exploration is held."""
_OWN = 0.35
"""Share of the explorations that replace the nominal action by any action within the bounds."""
_OFFSETS = ((-0.9, 0.6), (-0.25, 0.25))
"""m/s and rad by which the others change the nominal action."""


@dataclass(frozen=True)
class Drive:
    """State in each tick, and the load towed then ("none", "box", ...)."""

    messages: tuple[StateMessage, ...]
    loads: tuple[str, ...]

    @property
    def states(self) -> FloatArray:
        """Measured states (n + 1, states)."""
        return np.array([message.values for message in self.messages])

    @property
    def actions(self) -> FloatArray:
        """Actions in force (n, actions), row k between states k and k + 1."""
        return np.array([message.applied for message in self.messages[1:]])


@dataclass(frozen=True)
class DriveOrder:
    """One drive to record. ``events`` maps a tick to the load that is hitched then ("none": it is released)."""

    seed: int
    load: str
    ticks: int
    method: str = ""
    """Who drives in earnest: in a scene of the experiment, up to its goal, behind the method's own filter with the
    settings' margin. Empty: the goal seeker on an open field, without a filter."""
    folder: Path = Path()
    """Of the method's models."""
    settings: FilterSettings = field(default_factory=lambda: settings_named("car"))
    events: tuple[tuple[int, str], ...] = ()
    exploring: bool = True
    """Whether the nominal actions are changed at random."""


def recorded_drive(order: DriveOrder) -> Drive:
    """Drives and records; the same order gives the same drive, bit for bit."""
    if order.method:
        nodes = nodes_of(METHODS[order.method], order.folder, order.settings, None)
        return _recorded(CarRobot(car_scene(order.seed, order.load)), nodes, order)
    model = load_model("car")
    seeker = PolicyNode(model)
    policy = ExploringPolicyNode(seeker, order.seed) if order.exploring else seeker
    filtering = SafetyFilterNode(model, dataclasses.replace(order.settings, enabled=False))
    robot = CarRobot(open_scene(order.seed, order.load))
    return _recorded(robot, [AdaptationNode(model), policy, filtering], order)


def cut_at_contact(drive_: Drive) -> Drive:
    """The drive up to the first contact: a car that pushes against a wall shows nothing of its own dynamics."""
    counts = [message.collisions for message in drive_.messages]
    end = next((index for index, count in enumerate(counts) if count), len(counts))
    return Drive(drive_.messages[:end], drive_.loads[:end])


def open_scene(seed: int, load: str) -> Scene:
    """A wide field without obstacles, and goals to drive to in turn."""
    draw = np.random.default_rng([seed, 11])
    goals = tuple((float(x), float(y)) for x, y in draw.uniform(-_GOALS, _GOALS, (200, 2)))
    start = (float(draw.uniform(-2, 2)), float(draw.uniform(-2, 2)), float(draw.uniform(-pi, pi)))
    return Scene(seed, load_named(load), (-_OPEN, _OPEN, -_OPEN, _OPEN), (), start, goals)


@final
class ExploringPolicyNode(ChangedNominal):
    """A policy with random piecewise constant changes of its actions, so that a drive shows more of the dynamics."""

    def __init__(self, policy: AbstractNode, seed: int) -> None:
        super().__init__(policy)
        self._draw = np.random.default_rng([seed, 13])
        self._ends = -np.inf
        self._replace = False
        self._change: FloatArray = np.zeros(2)

    def changed(self, values: tuple[float, ...], state: StateMessage) -> tuple[float, ...]:  # noqa: D102
        if state.robot_time >= self._ends:
            self._explore(state.robot_time)
        nominal = self._change if self._replace else np.array(values) + self._change
        low, high = _bounds()
        return tuple(np.clip(nominal, low, high).tolist())

    def _explore(self, now: float) -> None:
        self._ends = now + self._draw.uniform(*_HELD)
        self._replace = bool(self._draw.random() < _OWN)
        low, high = _bounds() if self._replace else np.array(_OFFSETS).T
        self._change = self._draw.uniform(low, high)


def _bounds() -> tuple[FloatArray, FloatArray]:
    """Lowest and highest action that the pymunk car takes."""
    car = CAR_PARAMETERS
    return np.array((car.speed_low, -car.steer_limit)), np.array((car.speed_high, car.steer_limit))


def _recorded(robot: CarRobot, nodes: Sequence[AbstractNode], order: DriveOrder) -> Drive:
    messages, loads, load, events = [], [], order.load, dict(order.events)
    with closing(drive(robot, nodes, order.ticks)) as periods:
        for period in periods:
            messages.append(period.state)
            loads.append(load)
            if order.method and robot.goals_reached:
                break
            if period.state.tick + 1 in events:
                load = events[period.state.tick + 1]
                towed = load_named(load)
                if towed is None:
                    robot.unhitch()
                else:
                    robot.hitch(towed)
    return Drive((*messages, robot.state_message()), (*loads, load))


FIRST_SEEDS = {"margin": 5000, "fresh": 6000, "errors": 7000, "latent": 8000, "hitching": 9000, "paths": 9500}
"""First seed of the drives that calibrate margins, check their coverage, measure errors (and test the classifier of
latents), fit that classifier, change the load while driving, and show predicted paths. The table's episodes have seeds
from 0."""

HITCHED, LET_GO = 3, 5
"""Eighths of a hitching drive after which the load is hitched, and released."""


EARNEST = 4
"""Drives in earnest for every other recorded drive: they end at the goal, after a fifth of the time or so."""


def check_episode_seeds(first: int, episodes: int) -> None:
    """Raises InputError for episodes whose seeds are those of recorded drives."""
    if not 0 <= first <= FIRST_SEEDS["margin"] - episodes:
        raise InputError(
            f"first seed: got {first} with {episodes} episodes, wanted seeds from 0 and below "
            f"{FIRST_SEEDS['margin']}, where those of the recorded drives begin"
        )


def earnest_orders(
    loads: Sequence[str], each: int, purpose: str, method: str, folder: Path, settings: FilterSettings
) -> list[DriveOrder]:
    """A method in scenes of the experiment; ``purpose`` is a key of FIRST_SEEDS."""
    known: dict[str, Any] = {"method": method, "folder": folder, "settings": settings}
    return [DriveOrder(seed, load, TICKS, **known) for load in loads for seed in _seeds(purpose, EARNEST * each)]


def open_orders(loads: Sequence[str], each: int, ticks: int, purpose: str) -> list[DriveOrder]:
    """Exploring drives on an open field, one load each; ``purpose`` is a key of FIRST_SEEDS."""
    return [DriveOrder(seed, load, ticks) for load in loads for seed in _seeds(purpose, each)]


def path_orders(loads: Sequence[str], ticks: int) -> list[DriveOrder]:
    """The goal seeker on an open field, from the same start to the same goals with every load."""
    return [DriveOrder(FIRST_SEEDS["paths"], load, ticks, exploring=False) for load in loads]


def hitching_orders(loads: Sequence[str], each: int, ticks: int) -> list[DriveOrder]:
    """Exploring drives that begin without load; it is hitched while driving, and released later."""
    hitched, let_go = ticks * HITCHED // 8, ticks * LET_GO // 8
    return [
        DriveOrder(seed, "none", ticks, events=((hitched, load), (let_go, "none")))
        for load in loads
        if load != "none"
        for seed in _seeds("hitching", each)
    ]


def _seeds(purpose: str, count: int) -> range:
    return range(FIRST_SEEDS[purpose], FIRST_SEEDS[purpose] + count)
