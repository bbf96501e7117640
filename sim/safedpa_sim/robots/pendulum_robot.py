"""The pendulum robot without any bus: senses, judges torques, holds its angle without one, leaves its corridor."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from math import degrees, radians, sin
from typing import Any, final

from safedpa.bus.messages.messages import StateMessage
from safedpa.errors import InputError
from safedpa_sim.robots.guard import ActionGuard
from safedpa_sim.robots.pendulum_task import PendulumTask
from safedpa_sim.robots.pendulum_world import PENDULUM_PARAMETERS, PendulumParameters, PendulumWorld
from safedpa_sim.robots.robot import SimulatedRobot

__all__ = ["DAMPING", "STIFFNESS", "PendulumRobot", "Violation"]

STIFFNESS = 200.0
"""N m/rad of the watchdog, as of a drive that holds its position: a wind of 4 m/s moves it by a degree."""
DAMPING = 12.0
"""N m s/rad of the watchdog; with the hinge's own friction nearly critical."""
_GRAVITY = 9.81
"""m/s2."""

_CLOSE, _SLOW = radians(5.0), 1.0
"""rad and rad/s; what counts as at the goal."""
_HELD_SECONDS = 0.5
"""For so long it has to be there before that counts."""


@final
@dataclass(frozen=True)
class Violation:
    """The corridor was left."""

    time: float
    """s since the robot's start."""
    what: str
    """``lower edge`` or ``upper edge``."""
    angle: float
    """rad; the farthest one in the period in which it was left."""

    def __str__(self) -> str:
        return f"{self.what} at t={self.time:.2f} s, {degrees(self.angle):.1f} degrees"


@final
class PendulumRobot(SimulatedRobot):
    """A pendulum in a wind.

    Where a swing ends it is put to its next start; a period is left out of the ticks there, so that no one takes the
    two states for neighbours. Raises InputError for a period that is none, or a wind that is no wind.
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
        """What was asked for."""
        body = self.world.parameters
        hidden = {"payload": body.payload, "dry_friction": body.dry_friction}
        return {"seed": self.seed, "task": self.task.name, "wind": list(self.world.wind), **hidden}

    @property
    def at_rest(self) -> bool:
        """Always: a pendulum that is let go does not come to rest within its corridor, so no one waits for that."""
        return True

    @property
    def collisions(self) -> list[Violation]:
        """Every time that the corridor was left."""
        return self._collisions

    def state_message(self) -> StateMessage:
        """State k, the corridor and the goal."""
        return self._state(goal=(self.task.goal,), corridor=self.task.corridor)

    def _live(self) -> None:
        if self._applied_by != "watchdog":
            self._hold = None
        self._watch(*self.world.advance(self._applied[0], self.period))
        if self._arrived():
            self._begin_again()

    def _watchdog_action(self) -> tuple[float]:
        """-weight - stiffness (angle - held) - damping rate, held: the angle at which the last torque ran out.

        It knows the pendulum's own weight and nothing of the wind: 3.5 N m that it does not know move it by a degree.
        """
        if self._hold is None:
            self._hold = self.world.angle
        body = self.world.parameters
        weight = body.mass * _GRAVITY * body.length * sin(self.world.angle)
        pull = STIFFNESS * (self.world.angle - self._hold) + DAMPING * self.world.rate
        return (min(max(-weight - pull, -body.torque), body.torque),)

    def _watch(self, lowest: float, highest: float) -> None:
        """Counts the corridor as left once, until the pendulum is back."""
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

    def _begin_again(self) -> None:
        self.goals_reached += 1
        self._held, self._outside, self._hold = 0, False, None
        self.tick += 1
        self.world.put(next(self._starts))
        self._applied, self._applied_by = (0.0,), "none"
