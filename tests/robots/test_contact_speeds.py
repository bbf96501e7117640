"""How fast the car drove into what it touched, and who ran into a car that drives away from him."""

from __future__ import annotations

from typing import final

import pytest

from safedpa.bus.wire.messages import ActionMessage
from safedpa_sim.robots.contacts import Collision
from safedpa_sim.robots.core import CarRobot
from safedpa_sim.robots.loads import load_named
from safedpa_sim.robots.scene import Scene
from safedpa_sim.sensing import Laser, LaserSettings, Person
from safedpa_sim.sensing.senses import Senses
from safedpa_sim.sensing.shapes import Outline, Point

FIELD = (-9.0, 9.0, -9.0, 9.0)


@final
class Runs(Person):
    """Straight on along x."""

    def __init__(self, place: Point, speed: float) -> None:
        super().__init__(place)
        self._speed = speed

    def velocity(self, time: float, robot: Point, outline: Outline) -> Point:
        del time, robot, outline
        return self._speed, 0.0


def test_what_the_car_drives_into_is_driven_into_with_its_speed() -> None:
    scene = Scene(0, load_named("none"), FIELD, ((2.0, 0.0, 0.3),), (0.0, 0.0, 0.0))
    hit = first_contact(CarRobot(scene), 1.0)
    assert (hit.part, hit.what) == ("car", "obstacle 0")
    assert hit.speed == pytest.approx(hit.towards, abs=1e-3)
    assert hit.towards > 0.8


def test_a_car_that_runs_into_a_load_from_behind_was_not_driven_towards() -> None:
    person = Runs((-3.0, 0.0), 1.5)
    scene = Scene(0, load_named("box"), FIELD, (), (0.0, 0.0, 0.0))
    hit = first_contact(CarRobot(scene, senses=Senses((Laser(LaserSettings(), 0),), (person,))), 0.5)
    assert (hit.part, hit.what) == ("load", "person 0")
    assert hit.speed > 0.2
    assert hit.towards == pytest.approx(-hit.speed, abs=1e-3), "it drove away from him"


def first_contact(robot: CarRobot, speed: float) -> Collision:
    """Of a car that is told to drive straight on."""
    for tick in range(200):
        if robot.collisions:
            break
        robot.receive(ActionMessage(epoch=1, tick=tick, robot_time=0.0, publish_time=0.0, values=(speed, 0.0)))
        robot.advance()
    return robot.collisions[0]
