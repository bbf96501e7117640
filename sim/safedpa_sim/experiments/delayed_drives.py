"""Drives of a car whose commands arrive late: does the filter that knows the delay, or does not, keep it safe?

Each drive is the pymunk car in lockstep with the real nodes of adaptation, policy and safety filter, in a scene drawn
from its seed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from safedpa.adaptation import AdaptationNode
from safedpa.dynamics import PhysicsModel, Setting, load_model
from safedpa.effects import effect
from safedpa.errors import InputError
from safedpa.policy import PolicyNode
from safedpa.safety.node import SafetyFilterNode
from safedpa.safety.shipped import margin_for, settings_named
from safedpa_sim.closed_loop import drive
from safedpa_sim.robots.core import CarRobot
from safedpa_sim.robots.late_commands import LateCommands
from safedpa_sim.robots.scene import Scene

__all__ = ["CHANNELS", "DelayedDrives", "delayed_drives", "model_with_delay"]

CHANNELS = ("both", "drive", "steer")
"""Which commands arrive late."""
_EFFECTS = {"both": "actuator_delay", "drive": "drive_delay", "steer": "steering_delay"}
_PERIOD = 0.05
"""s"""


@dataclass
class DelayedDrives:
    """What became of some drives under one delay."""

    seconds: float
    """By which the commands were late."""
    known: bool
    """Whether the services' model had the delay."""
    drives: int = 0
    collided: int = 0
    """Drives with a collision."""
    collisions: int = 0
    goals: int = 0
    least_h: float = float("inf")
    """Smallest barrier value that was measured, m."""
    statuses: Counter[str] = field(default_factory=Counter)
    """Verdicts by status."""


def model_with_delay(model: PhysicsModel, seconds: float, channel: str = "both") -> PhysicsModel:
    """The model with the delay among its effects, known exactly; raises InputError for no such channel."""
    if channel not in CHANNELS:
        raise InputError(f"channel: got {channel!r}, wanted one of {', '.join(CHANNELS)}")
    return model.with_effect(effect("car", _EFFECTS[channel]), {"seconds": Setting(seconds)})


def delayed_drives(
    delay_seconds: float,
    known: bool,
    drives: int,
    seed: int,
    seconds: float = 12.0,
    *,
    channel: str = "both",
    loads: Sequence[str] = ("none",),
    model: str = "car",
    on_drive: Callable[[int, int], None] = lambda _done, _all: None,
) -> DelayedDrives:
    """Drives scene ``seed``, ``seed`` + 1, ... for ``seconds`` each, with ``loads`` in turn, one after the other.

    The same arguments give the same outcome, bit for bit.
    """
    found = DelayedDrives(delay_seconds, known)
    for index in range(drives):
        _add_drive(found, model, channel, loads[index % len(loads)], seed + index, seconds)
        on_drive(index + 1, drives)
    return found


def _add_drive(found: DelayedDrives, name: str, channel: str, load: str, seed: int, seconds: float) -> None:
    model = load_model(name)
    if found.known and found.seconds > 0.0:
        model = model_with_delay(model, found.seconds, channel)
    late = LateCommands(
        found.seconds if channel in ("both", "drive") else 0.0, found.seconds if channel in ("both", "steer") else 0.0
    )
    nodes = [
        AdaptationNode(model),
        PolicyNode(model),
        SafetyFilterNode(model, settings_named("car"), margin_for(model)),
    ]
    robot = CarRobot(Scene.random(seed, load), _PERIOD, late=late)
    for tick in drive(robot, nodes, round(seconds / _PERIOD)):
        found.statuses[tick.verdict.status] += 1
        found.least_h = min(found.least_h, tick.verdict.h_now)
    found.drives += 1
    found.collided += bool(robot.collisions)
    found.collisions += len(robot.collisions)
    found.goals += robot.goals_reached
