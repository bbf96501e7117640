"""The simulated point robot, independent of the bus: state messages, watchdog, goals and hazards, in a wind."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from math import cos, radians, sin
from typing import Any, final

import numpy as np

from safedpa.bus.messages.messages import StateMessage
from safedpa.errors import InputError
from safedpa_sim.point.body import CONTROL_SECONDS
from safedpa_sim.point.layout import HAZARD_RADIUS
from safedpa_sim.point.simulation import LARGEST_TURN, centre_state, controls_of
from safedpa_sim.point.task import PointTask
from safedpa_sim.robots.guard import ActionGuard
from safedpa_sim.robots.robot import SimulatedRobot

_BRAKE_SECONDS = 0.15
"""s; time constant of the watchdog's braking along the heading."""


@final
@dataclass(frozen=True)
class HazardEntry:
    """The entry of a hazard."""

    time: float
    """s since the robot's start."""
    hazard: int
    x: float
    y: float

    def __str__(self) -> str:
        return f"hazard {self.hazard} at t={self.time:.2f} s, ({self.x:.2f}, {self.y:.2f})"


@final
class PointRobot(SimulatedRobot):
    """A point robot among hazards in a wind.

    The state describes the centre of mass. The robot counts as inside a hazard when its geometric centre, 19 mm behind,
    is inside. Raises InputError for a wind force [N] beyond the robot's own thrust.
    """

    def __init__(
        self,
        force: tuple[float, float] = (0.0, 0.0),
        seed: int = 0,
        lockstep: bool = True,
        epoch: int = 1,
        wall_clock: Callable[[], float] = time.time,
    ) -> None:
        self.task = PointTask(1, seed)
        limit = self.task.simulation.body.largest_thrust
        if not float(np.hypot(*force)) < limit:
            raise InputError(f"force: got {force} N, wanted less than the robot's thrust of {limit:g} N")
        self.task.simulation.force[:, 0] = force
        self.seed, self.force = seed, force
        self._collisions: list[HazardEntry] = []
        self._within = False
        guard = ActionGuard(epoch, (-limit, -LARGEST_TURN), (limit, LARGEST_TURN))
        super().__init__(guard, CONTROL_SECONDS, lockstep, wall_clock)

    @property
    def values(self) -> tuple[float, ...]:
        """x, y of the centre of mass, yaw, and its velocity in the world."""
        return tuple(centre_state(self.task.simulation)[0].tolist())

    @property
    def about(self) -> dict[str, Any]:
        """Seed and wind force."""
        return {"seed": self.seed, "force": list(self.force)}

    @property
    def at_rest(self) -> bool:
        """Always True: in a wind the robot drifts under its watchdog and never comes to rest."""
        return True

    @property
    def collisions(self) -> list[HazardEntry]:
        """Every entry of a hazard so far."""
        return self._collisions

    def state_message(self) -> StateMessage:
        """Returns state k with hazards and goal."""
        hazards = self.task.layout.hazards[0].tolist()
        return self._state(
            goal=tuple(self.task.layout.goal[0].tolist()), obstacles=tuple((x, y, HAZARD_RADIUS) for x, y in hazards)
        )

    def _simulate_period(self) -> None:
        stepped = self.task.advance_under(controls_of(np.array([self._applied])))
        self.goals_reached += int(stepped.reached[0])
        self._watch(bool(stepped.cost[0] > 0.0))

    def _watchdog_action(self) -> tuple[float, float]:
        """Brakes along the heading without turning; it does not compensate the wind, so the robot drifts with it."""
        _, _, yaw, vx, vy = self.values
        body = self.task.simulation.body
        speed = cos(yaw) * vx + sin(yaw) * vy
        thrust = -body.mass * speed / _BRAKE_SECONDS
        return min(max(thrust, -body.largest_thrust), body.largest_thrust), 0.0

    def _watch(self, within: bool) -> None:
        """Counts the entry of a hazard once, until the robot has left it."""
        if within and not self._within:
            x, y = (float(part) for part in self.task.simulation.pose[:2, 0])
            apart = np.linalg.norm(self.task.layout.hazards[0] - (x, y), axis=1)
            self._collisions.append(
                HazardEntry((self.tick + 1) * self.period, int(apart.argmin()), round(x, 4), round(y, 4))
            )
        self._within = within


def force_towards(newton: float, degrees: float) -> tuple[float, float]:
    """Returns the components of a force of ``newton`` towards a direction: 0 degrees along x, 90 along y."""
    return newton * cos(radians(degrees)), newton * sin(radians(degrees))
