"""The base class of simulated robots: ticks, action guard, watchdog, state messages and the hash of the trajectory."""

from __future__ import annotations

import hashlib
import os
import struct
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, final

from safedpa.bus.messages.messages import ActionMessage, HealthMessage, ScanMessage, StateMessage
from safedpa_sim.robots.guard import ActionGuard

Numbers = tuple[float, ...]


class SimulatedRobot(ABC):
    """A simulated robot; in each period publish ``state_message()``, ``receive`` the action, then ``advance``.

    The action of tick k acts over the whole period after state k, in real time as in lockstep. A robot whose commands
    act with a delay reports it as ``until_action`` [s]. A subclass must be able to return ``values`` before it calls
    this constructor, which records the first state.
    """

    def __init__(
        self,
        guard: ActionGuard,
        period: float,
        lockstep: bool,
        wall_clock: Callable[[], float],
        until_action: float = 0.0,
    ) -> None:
        self._until_action = until_action
        self.guard, self.period, self.lockstep = guard, period, lockstep
        self.tick = self.goals_reached = self.watchdog_ticks = 0
        self._wall_clock = wall_clock
        self._applied: Numbers = (0.0,) * len(guard.low)
        self._applied_by = "none"
        self._hash = hashlib.sha256()
        self._record()

    @property
    @abstractmethod
    def values(self) -> Numbers:
        """The current state (states,), in the order of the robot's system."""

    @property
    @abstractmethod
    def about(self) -> dict[str, Any]:
        """The options of the run, such as seed, load and wind, for the run summary."""

    @property
    @abstractmethod
    def at_rest(self) -> bool:
        """Whether the run can end: the watchdog has stopped the robot, or cannot bring it to rest."""

    @property
    @abstractmethod
    def collisions(self) -> Sequence[Any]:
        """Every collision or violation so far, each a dataclass."""

    @abstractmethod
    def state_message(self) -> StateMessage:
        """Returns state k with the robot's surroundings."""

    def scans(self) -> Sequence[ScanMessage]:
        """Returns the new scans of its sensors, to be published before the state of this tick."""
        return ()

    @property
    @final
    def trajectory_hash(self) -> str:
        """SHA-256 over all states so far, packed as little-endian doubles."""
        return self._hash.hexdigest()

    @final
    def receive(self, message: ActionMessage) -> str | None:
        """Returns None if the action is accepted for this tick, otherwise the reason for the refusal."""
        return self.guard.offer(message)

    @final
    def advance(self) -> None:
        """Simulates one period under the accepted action, or under the watchdog's if none was accepted."""
        self._begin_period()
        self._simulate_period()
        self._end_period()

    @final
    def _begin_period(self) -> None:
        accepted = self.guard.accepted
        if accepted is None:
            self._applied, self._applied_by = self._watchdog_action(), "watchdog"
            self.watchdog_ticks += 1
        else:
            self._applied, self._applied_by = accepted, "filter"

    @final
    def _end_period(self) -> None:
        self.tick += 1
        self.guard.begin(self.tick)
        self._record()

    @final
    def health_message(self, state: str = "running", **more: Any) -> HealthMessage:
        """Returns the heartbeat of the robot's process, with ``more`` fields if given."""
        return HealthMessage(
            epoch=self.guard.epoch,
            tick=self.tick,
            robot_time=self.tick * self.period,
            publish_time=time.time(),
            service="robot",
            pid=os.getpid(),
            state=state,
            steps=self.tick,
            stale=self.watchdog_ticks,
            refused=sum(self.guard.refusals.values()),
            **more,
        )

    @abstractmethod
    def _watchdog_action(self) -> Numbers:
        """Returns the action (actions,) that the robot takes by itself when it receives none."""

    @abstractmethod
    def _simulate_period(self) -> None:
        """Simulates the period after ``tick`` under ``_applied``."""

    @final
    def _state(
        self,
        goal: Numbers,
        obstacles: tuple[Numbers, ...] = (),
        field: Numbers = (),
        footprint: Numbers = (),
        load_pose: Numbers = (),
        corridor: Numbers = (),
        towed: Numbers = (),
        distance_reversed: float = -1.0,
        sources: tuple[str, ...] = (),
        pose: Numbers = (),
    ) -> StateMessage:
        """Returns the state message of this tick with the given surroundings."""
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
            goal=goal,
            obstacles=obstacles,
            field=field,
            footprint=footprint,
            load_pose=load_pose,
            goals_reached=self.goals_reached,
            collisions=len(self.collisions),
            corridor=corridor,
            until_action=self._until_action,
            towed=towed,
            distance_reversed=distance_reversed,
            sources=sources,
            pose=pose,
        )

    def _record(self) -> None:
        values = self.values
        self._hash.update(_packing(len(values))(*values))


@cache
def _packing(count: int) -> Callable[..., bytes]:
    return struct.Struct(f"<{count}d").pack
