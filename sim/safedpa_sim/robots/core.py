"""The car robot without any bus: senses, judges actions, brakes when there is none, moves, reaches goals, collides."""

from __future__ import annotations

import time
from collections.abc import Callable
from math import hypot
from typing import Any, final

from safedpa.bus.messages import StateMessage
from safedpa.errors import InputError
from safedpa.reversing import reversed_way
from safedpa_sim.robots.changes import PlannedChange
from safedpa_sim.robots.contacts import Collision
from safedpa_sim.robots.footprint import footprint, towed_reach
from safedpa_sim.robots.guard import ActionGuard
from safedpa_sim.robots.late_commands import LateCommands
from safedpa_sim.robots.loads import Load
from safedpa_sim.robots.robot import SimulatedRobot
from safedpa_sim.robots.scene import GOAL_RADIUS, Scene
from safedpa_sim.robots.world import CarWorld

__all__ = ["BRAKE", "CarRobot"]

BRAKE = (0.0, 0.0)
"""The watchdog's action: stop, wheels straight."""

_STANDSTILL = 0.01
"""m/s."""


@final
class CarRobot(SimulatedRobot):
    """A car in its scene, with or without a load behind it."""

    def __init__(
        self,
        scene: Scene,
        period: float = 0.05,
        lockstep: bool = True,
        epoch: int = 1,
        wall_clock: Callable[[], float] = time.time,
        change: PlannedChange | None = None,
        late: LateCommands | None = None,
        until_action: float = 0.0,
    ) -> None:
        if not 0.0 < period <= 1.0:
            raise InputError(f"period: got {period} s, wanted more than 0 and at most 1 s")
        self.scene = scene
        self.world = CarWorld(scene.start, scene.field, scene.obstacles, scene.load)
        car = self.world.parameters
        self.changed_at: int | None = None
        """Tick in which the planned change was made."""
        self._change, self._late = change, late
        self._changes = change is not None
        self._take(scene.load)
        self._goals = scene.goals()
        self.goal = next(self._goals)
        guard = ActionGuard(epoch, (car.speed_low, -car.steer_limit), (car.speed_high, car.steer_limit))
        super().__init__(guard, period, lockstep, wall_clock, until_action)

    @property
    def values(self) -> tuple[float, float, float, float]:
        """x, y, yaw, speed now."""
        return self.world.state

    @property
    def about(self) -> dict[str, Any]:
        """What was asked for, and when it changed [s] where something was to change."""
        about = {"seed": self.scene.seed, "load": self.scene.load.name if self.scene.load else "none"}
        if self._changes:
            about["changed"] = None if self.changed_at is None else round(self.changed_at * self.period, 9)
        return about

    @property
    def at_rest(self) -> bool:
        """Whether the car stands."""
        return abs(self.values[3]) <= _STANDSTILL

    @property
    def collisions(self) -> list[Collision]:
        """Every collision so far."""
        return self.world.collisions

    def hitch(self, load: Load) -> None:
        """Puts a load behind the car while it drives."""
        self.world.hitch(load)

    def unhitch(self) -> None:
        """Lets the load go while the car drives."""
        self.world.unhitch()

    def state_message(self) -> StateMessage:
        """State k, and what the robot perceives around it."""
        towed = self.world.towed
        load = towed.load if towed else None
        if load is not self._taken[0]:
            self._take(load)
        return self._state(
            goal=self.goal,
            obstacles=self.scene.obstacles,
            field=self.scene.field,
            footprint=self._taken[1],
            load_pose=towed.pose if towed else (),
            towed=self._taken[2],
            reversed_way=self._way,
        )

    def _take(self, load: Load | None) -> None:
        """What it tows, and the room that it takes with it; of a new load nobody knows how it hangs."""
        self._taken = load, footprint(load), towed_reach(load)
        self._way = self._taken[2][1] if self._taken[2] else -1.0
        """m driven backwards, as a state tells it."""

    def _watchdog_action(self) -> tuple[float, float]:
        return BRAKE

    def _live(self) -> None:
        if self._change is not None and self._change.made(self):
            self._change, self.changed_at = None, self.tick
        (drive, steer), before = self._applied, self.world.state
        parts = ((drive, steer, self.period),) if self._late is None else self._late.felt((drive, steer), self.period)
        for felt_drive, felt_steer, seconds in parts:
            self.world.advance(felt_drive, felt_steer, seconds)
        if self._taken[2]:
            self._way = reversed_way(self._way, before, self.world.state, self._taken[2][1])
        x, y, _, _ = self.world.state
        if hypot(self.goal[0] - x, self.goal[1] - y) < GOAL_RADIUS:
            self.goals_reached += 1
            self.goal = next(self._goals)
