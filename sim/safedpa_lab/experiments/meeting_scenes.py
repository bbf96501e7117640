"""Where several cars meet: a field with pillars, a start and goals for each, and what a car is told of the others."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import cos, hypot, sin
from typing import Final, final

import numpy as np

from safedpa.errors import InputError
from safedpa_sim.robots.core import CarRobot
from safedpa_sim.robots.scene import Scene
from safedpa_sim.robots.shared_field import SharedField
from safedpa_sim.sensing import Laser, LaserSettings
from safedpa_sim.sensing.sensor_inputs import SimulatedSensors
from safedpa_sim.sensing.shapes import Point

__all__ = ["LASER", "MOST_ROBOTS", "Piece", "meeting_field", "meeting_scenes", "pieces_of"]

MOST_ROBOTS: Final = 8
LASER: Final = LaserSettings(rays=720)
"""Half a degree from ray to ray: cars are slimmer than people, and with twice that too few rays pass the middle of a
cell 3 m away to show that none is there."""
_APART: Final = 1.5
"""m at least between the rear axles of two cars that begin: their loads do not touch either."""
_TRIES: Final = 400


def meeting_scenes(seed: int, robots: int, load: str = "none") -> tuple[Scene, ...]:
    """One scene a car on the field of ``Scene.random``, whose start and goals the first car has.

    Raises InputError for fewer than 2 or more than 8 cars, and where there is no room for so many.
    """
    if not 2 <= robots <= MOST_ROBOTS:
        raise InputError(f"robots: got {robots}, wanted 2 to {MOST_ROBOTS} on one field")
    scenes, draw = [Scene.random(seed, load)], np.random.default_rng([seed, 31])
    for _ in range(_TRIES):
        if len(scenes) == robots:
            return tuple(scenes)
        x, y, yaw = scenes[0].drawn_start(draw)
        if all(hypot(x - one.start[0], y - one.start[1]) > _APART for one in scenes):
            scenes.append(replace(scenes[0], seed=1000 * seed + len(scenes), start=(x, y, yaw)))
    raise InputError(f"robots: got {robots}, and the field of seed {seed} has room for {len(scenes)}; choose fewer")


def meeting_field(seed: int, robots: int, load: str = "none") -> SharedField:
    """The cars of these scenes, each with a laser of its own noise."""
    scenes = meeting_scenes(seed, robots, load)
    return SharedField([CarRobot(one, sensor_inputs=SimulatedSensors((Laser(LASER, one.seed),))) for one in scenes])


@final
@dataclass(frozen=True)
class Piece:
    """A disc that covers a piece of a car or its load, and goes where that goes."""

    robot: CarRobot
    along: float
    """m of its middle ahead of the rear axle's middle, or of the load's."""
    radius: float
    of_load: bool = False

    @property
    def place(self) -> Point:
        """x, y [m] now."""
        towed = self.robot.world.towed
        x, y, yaw = towed.pose[:3] if self.of_load and towed else self.robot.values[:3]
        return x + self.along * cos(yaw), y + self.along * sin(yaw)


def pieces_of(robot: CarRobot) -> tuple[Piece, ...]:
    """Three discs that hold all of a car, and one that holds its load."""
    car, load = robot.world.parameters, robot.scene.load
    third = (car.rear + car.front) / 3
    pieces = [Piece(robot, -car.rear + (k + 0.5) * third, hypot(third, car.width) / 2) for k in range(3)]
    return (*pieces, *([] if load is None else [Piece(robot, 0.0, load.side / 2**0.5, of_load=True)]))
