"""The simulated pendulum as a robot, independent of the bus: tasks, state messages, watchdog and violations."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import degrees, pi, radians, sin
from typing import Any, Final, final

import numpy as np

from safedpa.bus.messages.messages import StateMessage
from safedpa.errors import InputError, did_you_mean
from safedpa_sim.robots.guard import ActionGuard
from safedpa_sim.robots.pendulum.world import PENDULUM_PARAMETERS, PendulumParameters, PendulumWorld
from safedpa_sim.robots.robot import SimulatedRobot

STIFFNESS = 200.0
"""N m/rad of the watchdog, typical of a position-controlled drive: a wind of 4 m/s moves it by one degree."""
DAMPING = 12.0
"""N m s/rad of the watchdog; nearly critical together with the hinge's friction."""
_GRAVITY = 9.81
"""m/s2."""

_CLOSE, _SLOW = radians(5.0), 1.0
"""rad and rad/s; tolerances at the goal."""
_HELD_SECONDS = 0.5
"""The goal counts as reached after this time within the tolerances."""


@final
@dataclass(frozen=True)
class Violation:
    """A departure from the corridor."""

    time: float
    """s since the robot's start."""
    what: str
    """``lower edge`` or ``upper edge``."""
    angle: float
    """rad; the farthest angle in the period of the departure."""

    def __str__(self) -> str:
        return f"{self.what} at t={self.time:.2f} s, {degrees(self.angle):.1f} degrees"


@final
class PendulumRobot(SimulatedRobot):
    """A pendulum in a wind.

    When a swing ends, the pendulum is put to its next start angle. One tick is skipped there, so that the two states
    are not taken for consecutive ones. Raises InputError for a period or a wind out of range.
    """

    def __init__(
        self,
        task: PendulumTask,
        wind: tuple[float, float] = (0.0, 0.0),
        seed: int = 0,
        parameters: PendulumParameters = PENDULUM_PARAMETERS,
        period: float = 0.01,
        lockstep: bool = True,
        epoch: int = 1,
        wall_clock: Callable[[], float] = time.time,
    ) -> None:
        if not 0.0 < period <= 0.1:
            raise InputError(f"period: got {period} s, wanted more than 0 and at most 0.1 s")
        if not max(abs(wind[0]), abs(wind[1])) <= 50.0:
            raise InputError(f"wind: got {wind} m/s, wanted at most 50 m/s")
        self.task, self.seed = task, seed
        self._starts = task.drawn_starts(seed)
        self.world = PendulumWorld(next(self._starts), wind, parameters)
        limit = self.world.parameters.torque
        self._collisions: list[Violation] = []
        self._held, self._outside = 0, False
        self._hold: float | None = None
        super().__init__(ActionGuard(epoch, (-limit,), (limit,)), period, lockstep, wall_clock)

    @property
    def values(self) -> tuple[float, float]:
        """Angle [rad], turns counted, and rate [rad/s] now."""
        return self.world.angle, self.world.rate

    @property
    def about(self) -> dict[str, Any]:
        """Seed, task, wind and hidden parameters."""
        body = self.world.parameters
        hidden = {"payload": body.payload, "dry_friction": body.dry_friction}
        return {"seed": self.seed, "task": self.task.name, "wind": list(self.world.wind), **hidden}

    @property
    def at_rest(self) -> bool:
        """Always True: a pendulum without a filter does not come to rest within its corridor."""
        return True

    @property
    def collisions(self) -> list[Violation]:
        """Every departure from the corridor so far."""
        return self._collisions

    def state_message(self) -> StateMessage:
        """Returns state k with corridor and goal."""
        return self._state(goal=(self.task.goal,), corridor=self.task.corridor)

    def _simulate_period(self) -> None:
        if self._applied_by != "watchdog":
            self._hold = None
        self._watch(*self.world.advance(self._applied[0], self.period))
        if self._arrived():
            self._restart()

    def _watchdog_action(self) -> tuple[float]:
        """Returns -weight - stiffness (angle - hold) - damping rate; hold is the angle when the last torque ended.

        It compensates the pendulum's own weight but not the wind: an unknown 3.5 N m moves it by one degree.
        """
        if self._hold is None:
            self._hold = self.world.angle
        body = self.world.parameters
        weight = body.mass * _GRAVITY * body.length * sin(self.world.angle)
        pull = STIFFNESS * (self.world.angle - self._hold) + DAMPING * self.world.rate
        return (min(max(-weight - pull, -body.torque), body.torque),)

    def _watch(self, lowest: float, highest: float) -> None:
        """Counts a departure from the corridor once, until the pendulum is back."""
        low, high = self.task.corridor
        outside = lowest < low or highest > high
        if outside and not self._outside:
            edge, angle = ("lower edge", lowest) if lowest < low else ("upper edge", highest)
            self._collisions.append(Violation(self.tick * self.period, edge, angle))
        self._outside = outside

    def _arrived(self) -> bool:
        there = abs(self.world.angle - self.task.goal) < _CLOSE and abs(self.world.rate) < _SLOW
        self._held = self._held + 1 if there else 0
        return self.task.ends and self._held >= round(_HELD_SECONDS / self.period)

    def _restart(self) -> None:
        self.goals_reached += 1
        self._held, self._outside, self._hold = 0, False, None
        self.tick += 1
        self.world.put(next(self._starts))
        self._applied, self._applied_by = (0.0,), "none"


@dataclass(frozen=True)
class PendulumTask:
    """A task; angles in rad, not wrapped."""

    name: str
    corridor: tuple[float, float]
    """Lowest and highest permitted angle."""
    starts: tuple[float, float]
    """Range from which the start angle is drawn; the pendulum starts at rest."""
    goal: float
    ends: bool
    """Whether a new swing begins after the goal is reached."""

    def drawn_starts(self, seed: int) -> Iterator[float]:
        """Yields the start angles of a seed."""
        random = np.random.default_rng([seed, 31])
        while True:
            yield float(random.uniform(*self.starts))


_HAZARD_LOW, _HAZARD_HIGH = radians(5.0), radians(60.0)
"""The sector that the pendulum must not enter."""

TASKS: Final = {
    "balance": PendulumTask("balance", (-pi / 4, pi / 4), (-0.2, 0.2), 0.0, ends=False),
    "swing": PendulumTask(
        "swing", (_HAZARD_HIGH, _HAZARD_LOW + 2 * pi), (_HAZARD_HIGH + 0.05, _HAZARD_HIGH + 0.2), 2 * pi, ends=True
    ),
}
"""``balance``: stay within 45 degrees of upright. ``swing``: swing up from just below a hazard, the long way round."""


def task_named(name: str) -> PendulumTask:
    """Returns the task of that name. Raises InputError for an unknown name."""
    if name not in TASKS:
        raise InputError(f"task '{name}': {did_you_mean(name, TASKS)}")
    return TASKS[name]
