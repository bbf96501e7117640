"""A person who touches the car or its load stops: no person shoves either away, and no shove counts as driving."""

from __future__ import annotations

from math import hypot

import pytest

from safedpa.bus.wire.messages import ActionMessage
from safedpa_sim.robots.core import CarRobot
from safedpa_sim.robots.loads import load_named
from safedpa_sim.robots.scene import Scene
from safedpa_sim.sensing import Laser, LaserSettings, Person
from safedpa_sim.sensing.senses import Senses
from safedpa_sim.sensing.shapes import Outline, Point

FIELD = (-4.0, 4.0, -4.0, 4.0)


class Pushes(Person):
    """Goes on towards a position at 1.5 m/s, whatever is in the way."""

    def __init__(self, place: Point, towards: Point) -> None:
        super().__init__(place)
        self._towards = towards
        self.told = 0

    def touched(self, time: float) -> None:
        del time
        self.told += 1

    def velocity(self, time: float, robot: Point, outline: Outline) -> Point:
        del time, robot, outline
        x, y = self._towards[0] - self.place[0], self._towards[1] - self.place[1]
        return 1.5 * x / hypot(x, y), 1.5 * y / hypot(x, y)


@pytest.mark.parametrize(
    ("load", "place", "towards"),
    [
        ("none", (1.5, 0.03), (-9.0, 0.03)),
        ("box", (-0.35, 1.5), (-0.35, -9.0)),
        ("chair", (-1.8, 0.1), (9.0, 0.1)),
        ("large_chair", (-1.4, 1.2), (3.0, -2.5)),
    ],
)
def test_no_person_shoves_a_stationary_car_or_its_load(load: str, place: Point, towards: Point) -> None:
    scene = Scene(0, load_named(load), FIELD, (), (0.0, 0.0, 0.0))
    person = Pushes(place, towards)
    robot = CarRobot(scene, senses=Senses((Laser(LaserSettings(), 1),), (person,)))
    pose = robot.world.towed.pose[:2] if robot.world.towed else (0.0, 0.0)
    for tick in range(60):
        robot.receive(ActionMessage(epoch=1, tick=tick, robot_time=0.0, publish_time=0.0, values=(0.0, 0.0)))
        robot.advance()
        assert hypot(*robot.values[:2]) < 0.01
        after = robot.world.towed.pose[:2] if robot.world.towed else (0.0, 0.0)
        assert hypot(after[0] - pose[0], after[1] - pose[1]) < 0.02
    assert person.told > 10
    assert robot.collisions[0].part == ("car" if load == "none" else "load")
    assert all(hit.speed < 0.01 for hit in robot.collisions)
