"""Drives on which margins are calibrated and counted: each shipped robot and model behind the filter of the bus.

A drive is one scene, one load or wind, one start: what is redrawn from drive to drive, and what makes drives, not
steps, exchangeable.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final

import numpy as np

from safedpa.adaptation import AdaptationNode
from safedpa.arrays import FloatArray
from safedpa.bus import AbstractNode
from safedpa.calibration.from_drives import barrier_residuals
from safedpa.dynamics import load_model
from safedpa.policy import PolicyNode
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety.defaults import settings_named
from safedpa.safety.margins.calibration import MarginCalibration
from safedpa.systems.robots import robot_named
from safedpa_lab.experiments.common.drives import LOADS, counted, driven_with_latents
from safedpa_sim.closed_loop import Robot
from safedpa_sim.differential_drive.stand_in import WORLDS
from safedpa_sim.robots.car.parameters import THROTTLE_CAR
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene
from safedpa_sim.robots.pendulum.robot import TASKS, PendulumRobot
from safedpa_sim.robots.pendulum.world import wind_towards
from safedpa_sim.robots.point_robot import PointRobot, force_towards
from safedpa_sim.robots.stand_in_robot import StandInRobot

_MOST_WIND: Final = 5.0
"""m/s"""
_MOST_FORCE: Final = 0.008
"""N"""
_STARTS: Final = (-0.6, 0.6)
"""rad; from there the corridor can be kept in every wind that is drawn."""


def _car(seed: int, period: float = 0.05) -> Robot:
    return CarRobot(Scene.random(seed, LOADS[seed % len(LOADS)]), period)


def _bare_car(seed: int, period: float = 0.05) -> Robot:
    """Without a load, as the measured model and its own margin know it: one is found by diagnosis."""
    return CarRobot(Scene.random(seed, "none"), period)


def _throttle_car(seed: int) -> Robot:
    return CarRobot(Scene.random(seed), parameters=THROTTLE_CAR)


def _pendulum(seed: int, period: float = 0.01) -> Robot:
    """Balancing and swinging up in turn.

    Balancing begins all over the corridor, not only in its middle as the task does: a service that is started again
    finds the pendulum near an edge in a wind that it does not know, and there the first errors are the largest.
    """
    speed, direction = _drawn(seed, _MOST_WIND)
    task = replace(TASKS["balance"], starts=_STARTS) if seed % 2 else TASKS["swing"]
    return PendulumRobot(task, wind_towards(speed, direction), seed, period=period)


def _point(seed: int) -> Robot:
    newton, direction = _drawn(seed, _MOST_FORCE)
    return PointRobot(force_towards(newton, direction), seed)


def _wheels(seed: int, period: float = 0.05) -> Robot:
    """Every world in turn."""
    world = WORLDS[list(WORLDS)[seed % len(WORLDS)]]
    return StandInRobot(robot_named("differential_drive"), period, seed, world)


def _drawn(seed: int, most: float) -> tuple[float, float]:
    """A strength and a direction [degrees]."""
    draw = np.random.default_rng([seed, 77])
    return float(draw.uniform(0.0, most)), float(draw.uniform(0.0, 360.0))


@dataclass(frozen=True)
class Driver:
    """A model that ships, the settings of its filter, the robot that it drives and for how long."""

    model: str
    settings: str
    robot: Callable[..., Robot]
    seconds: float
    controller: str | None = None
    """None: as the model allows."""
    period: float = 0.0
    """s; 0: the model's own."""

    def at(self, rate: int) -> Driver:
        """The same with so many decisions a second."""
        return replace(self, robot=partial(self.robot, period=1.0 / rate), period=1.0 / rate)


_BASES: Final[dict[str, tuple[Driver, tuple[int, ...]]]] = {
    "car": (Driver("car", "car", _car, 20.0), (10, 5)),
    "car_measured": (Driver("car_measured", "car", _bare_car, 20.0), (10, 5)),
    "car_learned": (Driver("car_learned", "car", _car, 20.0), ()),
    "car_throttle": (Driver("dart_car", "car_throttle", _throttle_car, 20.0), ()),
    "pendulum": (Driver("pendulum", "pendulum", _pendulum, 6.0), (50, 25)),
    "pendulum_learned": (Driver("pendulum_learned", "pendulum", _pendulum, 6.0), ()),
    "point": (Driver("point_wind", "point", _point, 10.0), ()),
    "point_learned": (Driver("point_learned", "point", _point, 10.0, "goal_seeker"), ()),
    "differential_drive": (Driver("differential_drive", "differential_drive", _wheels, 20.0, "straight"), (10, 5)),
}
"""Each with the slower rates [Hz] for which a margin ships too."""
DRIVERS: Final = {
    f"{name}_{rate}_hz" if rate else name: driver.at(rate) if rate else driver
    for name, (driver, rates) in _BASES.items()
    for rate in (0, *rates)
}
"""By name of the margin that ships."""


@dataclass(frozen=True)
class DriveOrder:
    """One drive to be made; ``margin`` is what the filter has, None: that of its settings."""

    driver: str
    seed: int
    margin: MarginCalibration | None
    kind: str = "conformal"
    """Which of the margins, as in the settings."""
    seconds: float = 0.0
    """0: as the driver has it."""


@dataclass(frozen=True)
class DriveResult:
    """What became of a drive."""

    seed: int
    heights: dict[str, FloatArray]
    """By kind of barrier (steps, 4): the least h as it was predicted, and as it was measured."""
    goals: int
    collisions: int
    ticks: int
    statuses: dict[str, int]
    least_h: float


def driven(order: DriveOrder) -> DriveResult:
    """Makes one drive in lockstep through the real nodes; the same order gives the same result, bit for bit."""
    driver = DRIVERS[order.driver]
    model = load_model(driver.model)
    settings = replace(settings_named(driver.settings), margin=order.kind)
    robot: Any = driver.robot(order.seed)
    policy = PolicyNode(model, controller=driver.controller)
    nodes: list[AbstractNode] = [AdaptationNode(model), policy, SafetyFilterNode(model, settings, order.margin)]
    count = round((order.seconds or driver.seconds) / (driver.period or model.period))
    ticks, along = driven_with_latents(robot, nodes, count)
    heights, outcome = barrier_residuals(model, settings, along), counted(robot, ticks)
    return DriveResult(
        order.seed, heights, outcome.goals, outcome.collisions, len(ticks), dict(outcome.statuses), outcome.least_h
    )
