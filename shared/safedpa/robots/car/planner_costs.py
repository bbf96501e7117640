"""What a planned drive costs: the way that is left, the room that it keeps, how it steers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import final

import numpy as np
from numpy.typing import NDArray

from safedpa.errors import InputError
from safedpa.robots.car.planner_time import TimeToGo, clearance

__all__ = ["DriveCosts", "PlannerSettings"]

Values = NDArray[np.float64]


@final
@dataclass(frozen=True)
class PlannerSettings:
    """How the planner searches, and what it cares for: SI units. Raises InputError naming what is not positive."""

    samples: int = 128
    """Drives that are tried in each period."""
    steps: int = 15
    """Of the horizon."""
    step_seconds: float = 0.1
    knots: int = 5
    """Actions that are drawn, evenly over the horizon; in between the action goes straight from one to the next."""
    speed_spread: float = 0.8
    """m/s; standard deviation of the drawn target speeds."""
    steer_spread: float = 0.2
    """rad; likewise of the wheels."""
    temperature: float = 0.05
    """Of the average: drives that cost more than this above the best hardly count."""
    slowest_target: float = -0.6
    fastest_target: float = 2.0
    steer_limit: float = 0.34
    braking_deceleration: float = 2.8
    """m/s2; the room ahead is measured from where the robot would come to rest."""
    braking_gain: float = 3.2
    """1/s; of the speed servo, below braking_deceleration / braking_gain."""
    room: float = 0.15
    """m of clearance that cost nothing."""
    room_weight: float = 8.0
    contact_weight: float = 60.0
    way_weight: float = 0.3
    """Per second that is left on the mean of the way; one second that is left at the horizon costs 1."""
    sweeps: int = 5
    """Rounds of refining the time to go in each period, until it is settled: about 2 ms each."""
    effort_weight: float = 0.02
    """Per square of the change of an action from knot to knot, over its range."""

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not value > 0.0 and item.name != "slowest_target":
                raise InputError(f"planner, {item.name}: got {value}, wanted a positive number")
        if self.knots < 2 or self.slowest_target >= self.fastest_target:
            raise InputError(f"planner: got {self}, wanted at least 2 knots and slowest_target < fastest_target")


@final
class DriveCosts:
    """The cost of drives in one scene: obstacles (m, 3) [m], field (4,), capsule footprint (rear, front, radius)."""

    def __init__(
        self,
        settings: PlannerSettings,
        goal: Sequence[float],
        obstacles: Values,
        field: Sequence[float],
        footprint: Sequence[float],
    ) -> None:
        self._settings, self._obstacles, self._field, self._footprint = settings, obstacles, field, footprint
        self.to_go = TimeToGo(goal, obstacles, field, footprint, settings.room)

    def of(self, states: Values, knots: Values, last_action: Values) -> Values:
        """Costs (n,) of states (n, steps, 4) under actions (n, knots, 2), after ``last_action`` (2,)."""
        settings = self._settings
        x, y, yaw, speed = (states[..., index] for index in range(4))
        left = self.to_go(x, y, yaw)
        way = left[:, -1] + settings.way_weight * left.mean(axis=1)
        room = self._room(x, y, yaw, speed)
        lacking = np.maximum(1.0 - room / settings.room, 0.0)
        near = settings.room_weight * (lacking**2).mean(axis=1) + settings.contact_weight * (room < 0.0).mean(axis=1)
        scale = np.array((settings.fastest_target - settings.slowest_target, 2.0 * settings.steer_limit))
        changes = np.diff(np.concatenate([np.broadcast_to(last_action, (len(knots), 1, 2)), knots], axis=1), axis=1)
        effort = settings.effort_weight * ((changes / scale) ** 2).sum(axis=(1, 2))
        return np.asarray(way + near + effort)

    def _room(self, x: Values, y: Values, yaw: Values, speed: Values) -> Values:
        """Clearance (n, steps) [m] of the capsule, stretched by the stopping distance."""
        gain, size = self._settings.braking_gain, np.abs(speed)
        corner = self._settings.braking_deceleration / gain
        beyond = np.maximum(size - corner, 0.0) * (size + corner) / (2.0 * self._settings.braking_deceleration)
        stretch = np.sign(speed) * (np.minimum(size, corner) / gain + beyond)
        rear, front, radius = self._footprint
        ends = (-rear + np.minimum(stretch, 0.0), front + np.maximum(stretch, 0.0))
        return clearance((x, y, yaw), ends, self._obstacles, self._field) - radius
