"""The car robot without any bus: senses, judges actions, brakes when there is none, moves, reaches goals, collides."""

from __future__ import annotations

import hashlib
import struct
import time
from collections.abc import Callable
from math import hypot
from typing import Any

from safedpa.bus.messages import ActionMessage, StateMessage
from safedpa.errors import InputError
from safedpa_sim.robots.changes import PlannedChange
from safedpa_sim.robots.contacts import Collision
from safedpa_sim.robots.footprint import footprint
from safedpa_sim.robots.guard import ActionGuard
from safedpa_sim.robots.loads import Load
from safedpa_sim.robots.scene import GOAL_RADIUS, Scene
from safedpa_sim.robots.world import CarWorld

__all__ = ["BRAKE", "CarRobot"]

BRAKE = (0.0, 0.0)
"""The watchdog's action: stop, wheels straight."""

_STANDSTILL = 0.01
"""m/s."""


class CarRobot:
    """One period at a time: publish ``state_message()``, ``receive`` actions, ``advance``.

    The action of tick k acts over the whole period that follows state k, in real time as in lockstep.
    """

    def __init__(
        self,
        scene: Scene,
        period: float = 0.05,
        lockstep: bool = True,
        epoch: int = 1,
        wall_clock: Callable[[], float] = time.time,
        change: PlannedChange | None = None,
    ) -> None:
        if not 0.0 < period <= 1.0:
            raise InputError(f"period: got {period} s, wanted more than 0 and at most 1 s")
        self.scene = scene
        self.period = period
        self.lockstep = lockstep
        self.tick = 0
        self.goals_reached = 0
        self.watchdog_ticks = 0
        self.world = CarWorld(scene.start, scene.field, scene.obstacles, scene.load)
        car = self.world.parameters
        self.guard = ActionGuard(epoch, (car.speed_low, -car.steer_limit), (car.speed_high, car.steer_limit))
        self.changed_at: int | None = None
        """Tick in which the planned change was made."""
        self._change = change
        self._wall_clock = wall_clock
        self._goals = scene.goals()
        self.goal = next(self._goals)
        self._applied, self._applied_by = BRAKE, "none"
        self._hash = hashlib.sha256()
        self._record()

    @property
    def values(self) -> tuple[float, float, float, float]:
        """x, y, yaw, speed now."""
        return self.world.state

    @property
    def about(self) -> dict[str, Any]:
        """What was asked for."""
        return {"seed": self.scene.seed, "load": self.scene.load.name if self.scene.load else "none"}

    @property
    def at_rest(self) -> bool:
        """Whether the car stands."""
        return abs(self.values[3]) <= _STANDSTILL

    @property
    def collisions(self) -> list[Collision]:
        """Every collision so far."""
        return self.world.collisions

    @property
    def trajectory_hash(self) -> str:
        """SHA-256 over all states so far, packed as little-endian doubles."""
        return self._hash.hexdigest()

    def hitch(self, load: Load) -> None:
        """Puts a load behind the car while it drives."""
        self.world.hitch(load)

    def unhitch(self) -> None:
        """Lets the load go while the car drives."""
        self.world.unhitch()

    def state_message(self) -> StateMessage:
        """State k, and what the robot perceives around it."""
        towed = self.world.towed
        return StateMessage(
            epoch=self.guard.epoch,
            tick=self.tick,
            robot_time=self.tick * self.period,
            publish_time=self._wall_clock(),
            values=self.values,
            applied=self._applied,
            applied_by=self._applied_by,
            period=self.period,
            lockstep=self.lockstep,
            goal=self.goal,
            obstacles=self.scene.obstacles,
            field=self.scene.field,
            footprint=footprint(towed.load if towed else None),
            load_pose=towed.pose if towed else (),
            goals_reached=self.goals_reached,
            collisions=len(self.collisions),
        )

    def receive(self, message: ActionMessage) -> str | None:
        """Accepts the action for this tick (None), or says why not."""
        return self.guard.offer(message)

    def advance(self) -> None:
        """One period under the accepted action, or under the watchdog's brake when none was accepted."""
        if self._change is not None and self._change.made(self):
            self._change, self.changed_at = None, self.tick
        accepted = self.guard.accepted
        if accepted is None:
            self._applied, self._applied_by = BRAKE, "watchdog"
            self.watchdog_ticks += 1
        else:
            self._applied, self._applied_by = (accepted[0], accepted[1]), "filter"
        self.world.advance(*self._applied, self.period)
        self.tick += 1
        self.guard.begin(self.tick)
        self._record()
        x, y, _, _ = self.values
        if hypot(self.goal[0] - x, self.goal[1] - y) < GOAL_RADIUS:
            self.goals_reached += 1
            self.goal = next(self._goals)

    def _record(self) -> None:
        self._hash.update(struct.pack("<4d", *self.values))
