"""The simulated car as a robot, independent of the bus: state messages, watchdog, goals, collisions and changes.

Changes of the car during a drive are those that its model is not informed of.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from math import ceil, cos, hypot, inf, isfinite, sin
from typing import Any, final

from safedpa.bus.messages.messages import ScanMessage, StateMessage
from safedpa.errors import InputError, did_you_mean
from safedpa.reversing import distance_reversed
from safedpa_sim.robots.car.actuators import ThrottleMotor
from safedpa_sim.robots.car.contacts import Collision
from safedpa_sim.robots.car.loads import LOADS, Load, footprint, towed_reach
from safedpa_sim.robots.car.parameters import CAR_PARAMETERS, SUBSTEP, CarParameters
from safedpa_sim.robots.car.scene import GOAL_RADIUS, Scene
from safedpa_sim.robots.car.world import CarWorld
from safedpa_sim.robots.guard import ActionGuard
from safedpa_sim.robots.robot import SimulatedRobot
from safedpa_sim.sensing.people import Person
from safedpa_sim.sensing.sensor_inputs import SimulatedSensors

_ROUNDING = 1e-9
"""s; parts of a period shorter than this are rounding errors."""


@final
class DelayedCommands:
    """Pure delays of the commands: felt drive(t) = drive(t - drive_seconds), felt steer(t) = steer(t - steer_seconds).

    The delays need not be multiples of the period. Before the first command, speed and steer are 0. Raises InputError
    for a delay that is not finite or is negative.
    """

    def __init__(self, drive_seconds: float, steer_seconds: float) -> None:
        for name, seconds in (("drive_seconds", drive_seconds), ("steer_seconds", steer_seconds)):
            if not (isfinite(seconds) and seconds >= 0.0):
                raise InputError(f"{name}: got {seconds!r}, wanted a finite number of seconds, 0 or more")
        self._seconds = (drive_seconds, steer_seconds)
        self._now = 0.0
        self._felt: tuple[list[tuple[float, float]], ...] = ([(0.0, 0.0)], [(0.0, 0.0)])
        """For drive and steer: the time [s] from which a command acts, and the command; oldest first."""

    def felt(self, command: tuple[float, float], seconds: float) -> Iterator[tuple[float, float, float]]:
        """Yields drive, steer and their duration [s], in order, over the period in which ``command`` is sent."""
        begin, end = self._now, self._now + seconds
        for history, value, late in zip(self._felt, command, self._seconds, strict=True):
            history.append((begin + late, value))
        edges = [begin]
        for edge in sorted(moment for history in self._felt for moment, _ in history):
            if edges[-1] + _ROUNDING < edge < end - _ROUNDING:
                edges.append(edge)
        for start, stop in pairwise([*edges, end]):
            yield self._at(0, start), self._at(1, start), stop - start
        self._now = end
        for history in self._felt:
            while len(history) > 1 and history[1][0] <= end + _ROUNDING:
                del history[0]

    def _at(self, channel: int, time: float) -> float:
        return [value for begin, value in self._felt[channel] if begin <= time + _ROUNDING][-1]


BRAKE = (0.0, 0.0)
"""The watchdog's action: speed 0, wheels straight."""

_BRAKING_GAIN, _BRAKING = 4.0, 3.0
"""1/s, and m/s2 at most: the watchdog of a car with a throttle brakes in proportion to the speed, as throttle 0 only
lets it roll."""

_AT_REST = 0.01
"""m/s; below this speed the car counts as stationary."""


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
        late: DelayedCommands | None = None,
        until_action: float = 0.0,
        parameters: CarParameters = CAR_PARAMETERS,
        sensor_inputs: SimulatedSensors | None = None,
    ) -> None:
        if parameters.throttle is not None and scene.load is not None:
            raise InputError(
                f"load: got '{scene.load.name}' behind a car with a throttle, wanted none: it tows nothing"
            )
        if not 0.0 < period <= 1.0:
            raise InputError(f"period: got {period} s, wanted more than 0 and at most 1 s")
        self.scene = scene
        self.world = CarWorld(
            scene.start, scene.field, scene.obstacles, scene.load, parameters, polygons=scene.polygons
        )
        car = self.world.parameters
        self.changed_at: int | None = None
        """Tick in which the planned change was applied."""
        self._change, self._late = change, late
        self._may_change: Callable[[], bool] = lambda: True
        self._changes = change is not None
        self._take(scene.load)
        self._goals = scene.goals()
        self.goal = next(self._goals)
        slowest, fastest = (car.speed_low, car.speed_high) if car.throttle is None else (-1.0, 1.0)
        guard = ActionGuard(epoch, (slowest, -car.steer_limit), (fastest, car.steer_limit))
        super().__init__(guard, period, lockstep, wall_clock, until_action)
        self._sensor_inputs = sensor_inputs
        if sensor_inputs is not None:
            sensor_inputs.join(self.world, scene, epoch)

    def hold_change(self, may_change: Callable[[], bool]) -> None:
        """Holds the planned change back until ``may_change``."""
        self._may_change = may_change

    @property
    def values(self) -> tuple[float, float, float, float]:
        """x, y, yaw, speed now."""
        return self.world.state

    @property
    def about(self) -> dict[str, Any]:
        """Seed and load, and the time [s] of the planned change, if any."""
        about = {"seed": self.scene.seed, "load": self.scene.load.name if self.scene.load else "none"}
        if self._changes:
            about["changed"] = None if self.changed_at is None else round(self.changed_at * self.period, 9)
        return about

    @property
    def at_rest(self) -> bool:
        """Whether the car is stationary."""
        return abs(self.values[3]) <= _AT_REST

    @property
    def collisions(self) -> list[Collision]:
        """Every collision so far."""
        return self.world.collisions

    @property
    def people(self) -> tuple[Person, ...]:
        """The people walking in this car's world."""
        return () if self._sensor_inputs is None else self._sensor_inputs.people

    def hitch(self, load: Load) -> None:
        """Hitches a load while the car drives."""
        self.world.hitch(load)

    def unhitch(self) -> None:
        """Unhitches the load while the car drives."""
        self.world.unhitch()

    def state_message(self) -> StateMessage:
        """Returns state k with the robot's surroundings."""
        towed = self.world.towed
        load = towed.load if towed else None
        if load is not self._taken[0]:
            self._take(load)
        return self._state(
            goal=self.goal,
            obstacles=self.scene.obstacles if self._sensor_inputs is None else (),
            field=self.scene.field,
            footprint=self._taken[1],
            load_pose=towed.pose if towed else (),
            towed=self._taken[2],
            distance_reversed=self._way,
            sources=() if self._sensor_inputs is None else self._sensor_inputs.names,
        )

    def scans(self) -> list[ScanMessage]:  # noqa: D102
        if self._sensor_inputs is None:
            return []
        self._sensor_inputs.sense(self.tick)  # before the first period, no step of the physics has triggered it yet
        return self._sensor_inputs.reported()

    def advance_in_steps(self) -> Iterator[float]:
        """Like ``advance``, but yields the world's time [s] before each step of the physics.

        A caller can move other bodies of the world between the steps. The iterator must be exhausted.
        """
        self._begin_period()
        yield from self._simulated_steps(SUBSTEP)
        self._end_period()

    def _take(self, load: Load | None) -> None:
        """Updates load, footprint and reach. The angle of a new load is unknown, so the whole reach is reserved."""
        self._taken = load, footprint(load, self.world.parameters), towed_reach(load)
        self._way = self._taken[2][1] if self._taken[2] else -1.0
        """m driven backwards, the state message's ``distance_reversed``."""

    def _watchdog_action(self) -> tuple[float, float]:
        motor, speed = self.world.drive, self.values[3]
        if not isinstance(motor, ThrottleMotor):
            return BRAKE
        return motor.braking(speed, min(_BRAKING_GAIN * abs(speed), _BRAKING)), BRAKE[1]

    def _simulate_period(self) -> None:
        for _ in self._simulated_steps(inf):
            pass

    def _simulated_steps(self, longest: float) -> Iterator[float]:
        """Simulates one period in steps of at most ``longest`` [s]; yields the world's time [s] before each."""
        if self._change is not None and self._may_change() and self._change.try_apply(self):
            self._change, self.changed_at = None, self.tick
        (drive, steer), before = self._applied, self.world.state
        parts = ((drive, steer, self.period),) if self._late is None else self._late.felt((drive, steer), self.period)
        for felt_drive, felt_steer, seconds in parts:
            for piece in self._pieces(seconds, longest):
                yield self.world.time
                self.world.advance(felt_drive, felt_steer, piece)
        if self._taken[2]:
            self._way = distance_reversed(self._way, before, self.world.state, self._taken[2][1])
        x, y, _, _ = self.world.state
        if hypot(self.goal[0] - x, self.goal[1] - y) < GOAL_RADIUS:
            self.goals_reached += 1
            self.goal = next(self._goals)

    def _pieces(self, seconds: float, longest: float) -> Iterator[float]:
        """Splits ``seconds`` into steps [s] of at most ``longest``, and takes measurements at the sensors' times."""
        if self._sensor_inputs is None:
            yield from _split(seconds, longest)
            return
        end = self.world.time + seconds
        for moment in self._sensor_inputs.moments(end):
            yield from _split(moment - self.world.time, longest)
            self._sensor_inputs.sense(self.tick)
        yield from _split(end - self.world.time, longest)


def _split(seconds: float, longest: float) -> Iterator[float]:
    """Yields equal parts of ``seconds`` of at most ``longest`` [s]; nothing for 0 s."""
    parts = ceil(seconds / longest - _ROUNDING) if longest < inf else int(seconds > 0.0)
    for _ in range(parts):
        yield seconds / parts


_WIND = 1.0
"""m/s2; a force of a tenth of the car's weight."""
_OFFSET = 0.08
"""rad; a linkage bent by an impact."""
_DRIVING = 0.8
"""m/s; changes wait until the car is at least this fast, so that a headwind has a direction."""
_AHEAD_SECONDS = 1.0
"""The distance covered in this time must be free ahead of the nose: the load widens and slows the car at once, and the
car should be able to continue."""
_ROOM = 0.1
"""m around the footprint with load that must be free when it is hitched."""

CHANGES = ("hitch", "headwind", "steering_offset")
"""A chair is hitched; a steady wind starts against the current heading; the steering linkage is bent."""


@dataclass(frozen=True)
class PlannedChange:
    """One of ``CHANGES``, applied at the first tick from ``after`` [s] on at which the car drives and has room.

    Raises InputError for another name.
    """

    name: str
    after: float

    def __post_init__(self) -> None:
        if self.name not in CHANGES:
            raise InputError(f"change '{self.name}': {did_you_mean(self.name, CHANGES)}")

    def try_apply(self, robot: CarRobot) -> bool:
        """Applies the change if it is due and possible; returns whether it did."""
        _, _, yaw, speed = robot.values
        if robot.tick * robot.period < self.after - 1e-9 or speed < _DRIVING:
            return False
        if self.name == "hitch":
            return _try_hitch(robot)
        if self.name == "headwind":
            robot.world.wind = (-_WIND * cos(yaw), -_WIND * sin(yaw))
        else:
            robot.world.steering_offset = _OFFSET
        return True


def _try_hitch(robot: CarRobot) -> bool:
    load = LOADS["chair"]
    x, y, yaw, speed = robot.values
    rear, front, radius = footprint(load)
    behind, ahead = rear + load.drawbar + load.side, front + _AHEAD_SECONDS * speed
    west, east, south, north = robot.scene.field
    for part in range(9):
        along = -behind + part / 8 * (behind + ahead)
        px, py = x + along * cos(yaw), y + along * sin(yaw)
        room = min(px - west, east - px, py - south, north - py)
        room = min([room, *(hypot(px - ox, py - oy) - size for ox, oy, size in robot.scene.obstacles)])
        if room < radius + _ROOM:
            return False
    robot.hitch(load)
    return True
