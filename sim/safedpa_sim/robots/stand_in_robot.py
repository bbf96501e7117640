"""A robot package of the user, simulated by the stand-in that it declares, independent of the bus."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

from safedpa.bus.messages.messages import ScanMessage, StateMessage
from safedpa.errors import InputError
from safedpa.stand_in import AbstractStandIn
from safedpa.systems.robots import Robot
from safedpa_sim.robots.guard import ActionGuard
from safedpa_sim.robots.robot import SimulatedRobot
from safedpa_sim.sensing.stand_in_sensors import StandInSensors


@final
@dataclass(frozen=True)
class ForbiddenContact:
    """A contact that the robot must avoid."""

    time: float
    """s since the robot's start."""
    what: str

    def __str__(self) -> str:
        return f"{self.what} at t={self.time:.2f} s"


@final
class StandInRobot(SimulatedRobot):
    """Runs the stand-in of a robot package; a contact counts once until it ends.

    Raises InputError for a robot without a stand-in, and for world parameters that the stand-in does not have.
    """

    def __init__(
        self,
        robot: Robot,
        period: float,
        seed: int = 0,
        given: Mapping[str, float] | None = None,
        lockstep: bool = True,
        epoch: int = 1,
        wall_clock: Callable[[], float] = time.time,
        sensors: Callable[[AbstractStandIn], StandInSensors] | None = None,
    ) -> None:
        self.seed, self.given = seed, dict(given or {})
        try:
            self.stand_in: AbstractStandIn = robot.stand_in(seed, self.given)
        except TypeError as error:
            reported = " ".join(f"--world {name}={value:g}" for name, value in self.given.items())
            raise InputError(
                f"robot '{robot.name}': its stand-in does not take {reported or 'the seed'}: {error}"
            ) from error
        self._touched = self.stand_in.contact()
        self.sensors = None if sensors is None else sensors(self.stand_in)
        if self.sensors is not None:
            self.sensors.begin(self.stand_in, epoch)
        self._collisions: list[ForbiddenContact] = []
        settings = robot.settings()
        super().__init__(ActionGuard(epoch, settings.action_low, settings.action_high), period, lockstep, wall_clock)

    @property
    def values(self) -> tuple[float, ...]:
        """The state that the stand-in measures."""
        return self.stand_in.values

    @property
    def about(self) -> dict[str, Any]:
        """Seed and world parameters."""
        return {"seed": self.seed, **self.given}

    @property
    def at_rest(self) -> bool:
        """Always True: the watchdog of an unknown robot may never bring it to rest."""
        return True

    @property
    def collisions(self) -> list[ForbiddenContact]:
        """Every forbidden contact so far."""
        return self._collisions

    def state_message(self) -> StateMessage:
        """Returns state k with the surroundings of the stand-in."""
        seen = self.stand_in
        sensors = self.sensors
        return self._state(
            goal=seen.goal,
            obstacles=seen.obstacles if sensors is None else (),
            field=seen.field,
            footprint=seen.footprint,
            sources=() if sensors is None else sensors.names,
            pose=() if sensors is None else sensors.reported_pose(seen),
        )

    def scans(self) -> Sequence[ScanMessage]:
        """Returns the new scans of its sensors."""
        return () if self.sensors is None else self.sensors.reported()

    def _simulate_period(self) -> None:
        person = ""
        if self.sensors is None:
            self.stand_in.advance(self._applied, self.period)
        else:
            person = self.sensors.advance(self.stand_in, self._applied, self.period, self.guard.epoch, self.tick)
        self.goals_reached = self.stand_in.goals_reached
        touched = self.stand_in.contact() or person
        if touched and not self._touched:
            self._collisions.append(ForbiddenContact((self.tick + 1) * self.period, touched))
        self._touched = touched

    def _watchdog_action(self) -> tuple[float, ...]:
        return self.stand_in.watchdog_action()
