"""Does what the car tows stay free while an adversary reverses it at the nearest obstacle? Random scenes, every load.

The adversary requests full reverse in every tick, with the wheels turned so that the rear end comes nearer to the
nearest obstacle or wall; half of the drives begin with some seconds forwards to the goal, and some go forwards again
for a moment now and then, so that the load is folded up before it is pushed. Everything else is the shipped loop.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Any, ClassVar, final

import numpy as np

from safedpa.adaptation import AdaptationNode
from safedpa.bus import NOMINAL, AbstractNode, Inputs, NominalMessage, Outputs, StateMessage
from safedpa.dynamics import load_model
from safedpa.robots.car.controllers.goal_seeker import GoalSeeker
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety.defaults import margin_for, settings_named
from safedpa_sim.closed_loop import drive
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene

TOWED = ("box", "chair", "large_chair")
_PERIOD = 0.05
_REVERSE = -0.6
_STEER = 0.34
_STYLES = ("reverse", "forwards_first", "rocking")


@dataclass(frozen=True)
class ReversingDrive:
    """One drive: scene by load and seed."""

    load: str
    seed: int
    seconds: float = 20.0
    model: str = "car"


@dataclass(frozen=True)
class ReversingOutcome:
    """What became of a drive."""

    load: str
    seed: int
    style: str
    collisions: int
    reversed_metres: float
    """Way driven backwards, all in all: an adversary that gets nowhere proves nothing."""
    least_h: float
    """Smallest barrier value that was measured, m."""
    statuses: dict[str, int]


@final
@dataclass
class ReversingNode(AbstractNode):
    """The policy's place, taken by the adversary. ``style``: ``reverse``, ``forwards_first`` or ``rocking``."""

    style: str
    seed: int
    name: ClassVar[str] = "policy"
    inputs: ClassVar[tuple[Any, ...]] = ()
    outputs: ClassVar[tuple[Any, ...]] = (NOMINAL,)
    share: ClassVar[float] = 0.2
    lingers: ClassVar[bool] = False
    _seeker: GoalSeeker = field(default_factory=GoalSeeker)
    _forward_until: float = 0.0
    _next_change: float = 0.0

    def __post_init__(self) -> None:
        self._draw = np.random.default_rng([self.seed, 2])
        if self.style == "forwards_first":
            self._forward_until = self._next_change = float(self._draw.uniform(1.0, 6.0))

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:  # noqa: D102
        del robot, inputs
        now = state.robot_time
        if self.style == "rocking" and now >= self._next_change:
            self._forward_until = now + float(self._draw.uniform(0.2, 1.5))
            self._next_change = self._forward_until + float(self._draw.uniform(0.3, 3.0))
        forward = now < self._forward_until
        values = (
            self._seeker.nominal_action(now, state.values, state.goal)
            if forward
            else (_REVERSE, _towards_nearest(state))
        )
        message = NominalMessage(
            epoch=state.epoch,
            tick=state.tick,
            robot_time=now,
            publish_time=time.time(),
            values=values,
            controller=f"adversary:{self.style}",
        )
        return {NOMINAL: message}


def run_reversing_drive(reversing: ReversingDrive) -> ReversingOutcome:
    """Drives once; the same drive gives the same outcome, bit for bit."""
    model = load_model(reversing.model)
    style = _STYLES[reversing.seed % len(_STYLES)]
    adversary = ReversingNode(style, reversing.seed)
    nodes = [AdaptationNode(model), adversary, SafetyFilterNode(model, settings_named("car"), margin_for(model))]
    robot = CarRobot(Scene.random(reversing.seed, reversing.load), _PERIOD)
    statuses: Counter[str] = Counter()
    least, back = math.inf, 0.0
    for tick in drive(robot, nodes, round(reversing.seconds / _PERIOD)):
        statuses[tick.verdict.status] += 1
        least = min(least, tick.verdict.h_now)
        back -= min(tick.state.values[3], 0.0) * _PERIOD
    return ReversingOutcome(reversing.load, reversing.seed, style, len(robot.collisions), back, least, dict(statuses))


def _towards_nearest(state: StateMessage) -> float:
    """Steer [rad] that swings the rear end towards what is nearest to it: reversing, the rear goes where it points."""
    x, y, yaw, _ = state.values
    west, east, south, north = state.field
    places = [(ox, oy, math.hypot(ox - x, oy - y) - radius) for ox, oy, radius in state.obstacles]
    places += [(west, y, x - west), (east, y, east - x), (x, south, y - south), (x, north, north - y)]
    near_x, near_y, _ = min(places, key=lambda place: place[2])
    aside = math.cos(yaw) * (near_y - y) - math.sin(yaw) * (near_x - x)
    return math.copysign(_STEER, aside)
