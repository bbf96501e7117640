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
from typing import final

import numpy as np

from safedpa.adaptation import AdaptationNode
from safedpa.arrays import FloatArray
from safedpa.bus import AbstractNode, StateMessage
from safedpa.dynamics import load_model
from safedpa.policy import PolicyNode
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety.defaults import settings_named
from safedpa.safety.settings import FilterSettings
from safedpa_lab.experiments.car_methods import METHODS, nodes_of
from safedpa_lab.experiments.car_scenes import car_scene
from safedpa_lab.experiments.changed_nominal import ChangedNominal
from safedpa_sim.closed_loop import drive
from safedpa_sim.robots.car_parameters import CAR_PARAMETERS
from safedpa_sim.robots.core import CarRobot
from safedpa_sim.robots.loads import load_named
from safedpa_sim.robots.scene import Scene

__all__ = ["Drive", "DriveOrder", "ExploringPolicyNode", "cut_at_contact", "open_scene", "recorded_drive"]


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
    """What the robot said in each tick, and what it towed then ("none", "box", ...)."""

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
    """One drive to record. ``events`` maps a tick to the load that is hitched then ("none": it is let go)."""

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
    """The drive up to the first contact: what pushes against a wall tells nothing of the robot's own dynamics."""
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
    """A policy whose nominal actions are changed at random, piecewise constant, so that a drive shows more of the dynamics."""

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
                _change_load(robot, load)
    return Drive((*messages, robot.state_message()), (*loads, load))


def _change_load(robot: CarRobot, load: str) -> None:
    towed = load_named(load)
    if towed is None:
        robot.unhitch()
    else:
        robot.hitch(towed)
