"""Changes of the car during a drive that its model is not informed of."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, hypot, sin
from typing import Protocol

from safedpa.errors import InputError, did_you_mean
from safedpa_sim.robots.car.loads import LOADS, Load, footprint
from safedpa_sim.robots.car.scene import Scene
from safedpa_sim.robots.car.world import CarWorld

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


class ChangeableCar(Protocol):
    """The part of a car that a change uses."""

    scene: Scene
    world: CarWorld
    tick: int
    period: float

    @property
    def values(self) -> tuple[float, float, float, float]:
        """x, y, yaw, speed."""

    def hitch(self, load: Load) -> None:
        """Hitches ``load``."""


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

    def try_apply(self, robot: ChangeableCar) -> bool:
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


def _try_hitch(robot: ChangeableCar) -> bool:
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
