"""Does what the car tows stay free while an adversary reverses it at the nearest obstacle? Random scenes, every load.

The adversary requests full reverse in every tick, with the wheels turned so that the rear end comes nearer to the
nearest obstacle or wall; half of the drives begin with some seconds forwards to the goal, and some go forwards again
for a moment now and then, so that the load is folded up before it is pushed. Everything else is the shipped loop.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from safedpa.bus import StateMessage
from safedpa.dynamics import load_model
from safedpa.robots.car.controllers.goal_seeker import GoalSeeker
from safedpa.safety.defaults import settings_named
from safedpa_lab.experiments.common.drives import PERIOD, FunctionPolicyNode, Outcome, counted, shipped_nodes
from safedpa_sim.closed_loop import drive
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene

TOWED = ("box", "chair", "large_chair")
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


class _Adversary:
    """``style``: ``reverse``, ``forwards_first`` or ``rocking``."""

    def __init__(self, style: str, seed: int) -> None:
        self._style, self._seeker = style, GoalSeeker()
        self._draw = np.random.default_rng([seed, 2])
        self._forward_until = self._next_change = 0.0
        if style == "forwards_first":
            self._forward_until = self._next_change = float(self._draw.uniform(1.0, 6.0))

    def nominal_action(self, state: StateMessage) -> tuple[float, ...]:
        now = state.robot_time
        if self._style == "rocking" and now >= self._next_change:
            self._forward_until = now + float(self._draw.uniform(0.2, 1.5))
            self._next_change = self._forward_until + float(self._draw.uniform(0.3, 3.0))
        if now < self._forward_until:
            return self._seeker.nominal_action(now, state.values, state.goal)
        return _REVERSE, _towards_nearest(state)


def run_reversing_drive(reversing: ReversingDrive) -> tuple[Outcome, float]:
    """Drives once; the same drive gives the same outcome, bit for bit.

    Also returns the way driven backwards [m]: an adversary that gets nowhere proves nothing.
    """
    style = _STYLES[reversing.seed % len(_STYLES)]
    policy = FunctionPolicyNode(_Adversary(style, reversing.seed).nominal_action, f"adversary:{style}")
    nodes = shipped_nodes(load_model(reversing.model), settings_named("car"), policy)
    robot = CarRobot(Scene.random(reversing.seed, reversing.load), PERIOD)
    ticks = list(drive(robot, nodes, round(reversing.seconds / PERIOD)))
    return counted(robot, ticks), -sum(min(tick.state.values[3], 0.0) * PERIOD for tick in ticks)


def _towards_nearest(state: StateMessage) -> float:
    """Steer [rad] that swings the rear end towards what is nearest to it: reversing, the rear goes where it points."""
    x, y, yaw, _ = state.values
    west, east, south, north = state.field
    places = [(ox, oy, math.hypot(ox - x, oy - y) - radius) for ox, oy, radius in state.obstacles]
    places += [(west, y, x - west), (east, y, east - x), (x, south, y - south), (x, north, north - y)]
    near_x, near_y, _ = min(places, key=lambda place: place[2])
    aside = math.cos(yaw) * (near_y - y) - math.sin(yaw) * (near_x - x)
    return math.copysign(_STEER, aside)
