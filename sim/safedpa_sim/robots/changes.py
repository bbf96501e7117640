"""What may change about the car while it drives, without anybody telling its model."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, hypot, sin
from typing import TYPE_CHECKING

from safedpa.errors import InputError, did_you_mean
from safedpa_sim.robots.footprint import footprint
from safedpa_sim.robots.loads import LOADS

if TYPE_CHECKING:
    from safedpa_sim.robots.core import CarRobot

__all__ = ["CHANGES", "PlannedChange"]

_WIND = 1.0
"""m/s2; a push of a tenth of the car's weight."""
_OFFSET = 0.08
"""rad; a linkage bent by a knock."""
_DRIVING = 0.8
"""m/s; slower than this nothing is hitched, and there is no head to the wind."""
_AHEAD_SECONDS = 1.0
"""Way that the speed covers in this time must be free ahead of the nose: the load makes the car wider and slower at
once, and it shall drive on."""
_ROOM = 0.1
"""m beyond the load's footprint that must be free around the car where it is hitched."""

CHANGES = ("hitch", "headwind", "steering_offset")
"""A chair hitched; a steady wind against the direction in which the car drives then; a bent steering linkage."""


@dataclass(frozen=True)
class PlannedChange:
    """One of ``CHANGES``, made at the first tick from ``after`` [s] on at which the car drives and there is room.

    Raises InputError for another name.
    """

    name: str
    after: float

    def __post_init__(self) -> None:
        if self.name not in CHANGES:
            raise InputError(f"change '{self.name}': {did_you_mean(self.name, CHANGES)}")

    def made(self, robot: CarRobot) -> bool:
        """Makes the change if it is due; False while it has to wait."""
        _, _, yaw, speed = robot.values
        if robot.tick * robot.period < self.after - 1e-9 or speed < _DRIVING:
            return False
        if self.name == "hitch":
            return _hitched(robot)
        if self.name == "headwind":
            robot.world.wind = (-_WIND * cos(yaw), -_WIND * sin(yaw))
        else:
            robot.world.steering_offset = _OFFSET
        return True


def _hitched(robot: CarRobot) -> bool:
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
