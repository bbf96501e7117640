"""Several cars on one field, and the approach speed of collisions."""

from collections.abc import Sequence
from math import cos, hypot, pi, sin
from typing import final

import numpy as np
import pytest

from safedpa.bus.messages.messages import ActionMessage
from safedpa.errors import InputError
from safedpa_sim.robots.car.contacts import Collision
from safedpa_sim.robots.car.loads import LOADS, load_named
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene
from safedpa_sim.robots.car.shared_field import SharedField
from safedpa_sim.sensing import Laser, LaserSettings, Person, Walks
from safedpa_sim.sensing.sensor_inputs import SimulatedSensors
from safedpa_sim.sensing.shapes import Outline, Point, box, cast

FIELD = (-4.0, 4.0, -4.0, 4.0)
PILLARS = ((0.0, 3.0, 0.4),)
EXACT = LaserSettings(noise=0.0, drop_outs=0.0)
Pose = tuple[float, float, float]


def car(pose: Pose, load: str = "none", laser: LaserSettings | None = None, seed: int = 1) -> CarRobot:
    sensor_inputs = None if laser is None else SimulatedSensors((Laser(laser, seed),))
    return CarRobot(Scene(0, load_named(load), FIELD, PILLARS, pose), sensor_inputs=sensor_inputs)


def live(field: SharedField, ticks: int, actions: Sequence[tuple[float, float]]) -> None:
    for _ in range(ticks):
        for robot, values in zip(field.robots, actions, strict=True):
            reported = ActionMessage(epoch=1, tick=robot.tick, robot_time=0.0, publish_time=0.0, values=values)
            assert robot.receive(reported) is None
        field.advance()


def outline_of(robot: CarRobot) -> tuple[tuple[float, float], ...]:
    """Computed from the car's dimensions, not from the shapes of the physics engine."""
    x, y, yaw, _ = robot.values
    own = robot.world.parameters
    middle = (own.front - own.rear) / 2
    return box(x + middle * cos(yaw), y + middle * sin(yaw), own.rear + own.front, own.width, yaw)


def test_two_that_drive_at_each_other_touch_once_and_both_moved() -> None:
    field = SharedField([car((-2.0, 0.0, 0.0)), car((2.0, 0.05, pi))])
    live(field, 60, [(1.5, 0.0), (1.0, 0.0)])
    (touch,) = field.touches
    assert touch.parts == ("car", "car")
    speeds = dict(zip(touch.robots, touch.speeds, strict=True))
    assert speeds[0] == pytest.approx(1.5, abs=0.1)
    assert speeds[1] == pytest.approx(1.0, abs=0.1)
    (noses,) = (one.values[0] + 0.4 for one in field.robots[:1])
    assert noses == pytest.approx(field.robots[1].values[0] - 0.4, abs=0.01)
    assert field.collisions(0) == field.collisions(1) == []
    assert [hit.what for hit in field.robots[0].collisions] == ["robot 1"]
    assert [hit.what for hit in field.robots[1].collisions] == ["robot 0"]
    assert "car of robot" in str(touch)


@pytest.mark.parametrize("first", [0, 1])
def test_a_contact_does_not_depend_on_the_order_of_the_cars(first: int) -> None:
    cars = [car((-2.0, 0.0, 0.0)), car((2.0, 0.05, pi))]
    field = SharedField([cars[first], cars[1 - first]])
    live(field, 60, [(1.5, 0.0)] * 2)
    (touch,) = field.touches
    assert touch.time == pytest.approx(1.325, abs=0.01)
    assert touch.speeds == pytest.approx((1.46, 1.46), abs=0.02)


def test_a_stationary_car_is_not_pushed_and_counts_as_stationary() -> None:
    field = SharedField([car((-2.0, 0.0, 0.0)), car((2.0, 0.05, pi))])
    live(field, 80, [(2.0, 0.0), (0.0, 0.0)])
    (touch,) = field.touches
    speeds = dict(zip(touch.robots, touch.speeds, strict=True))
    assert speeds[0] > 1.8
    assert speeds[1] < 0.01
    x, y, yaw, speed = field.robots[1].values
    assert hypot(x - 2.0, y - 0.05) < 0.005
    assert abs(yaw - pi) < 0.005
    assert abs(speed) < 0.01


@pytest.mark.parametrize("load", list(LOADS))
def test_a_load_can_be_hit_at_its_position(load: str) -> None:
    towing = car((0.0, 0.0, pi / 2), load)
    own = LOADS[load]
    y = -0.08 - own.length
    field = SharedField([towing, car((-2.0, y, 0.0))])
    live(field, 80, [(0.0, 0.0), (1.0, 0.0)])
    (touch,) = field.touches
    assert dict(zip(touch.robots, touch.parts, strict=True)) == {0: "load", 1: "car"}
    assert dict(zip(touch.robots, touch.speeds, strict=True))[0] < 0.02
    assert field.robots[1].values[0] + 0.4 == pytest.approx(-own.side / 2, abs=0.01)


def test_a_newly_hitched_load_exists_for_the_others_from_the_next_period_on() -> None:
    towing, other = car((0.0, 0.0, pi / 2)), car((-2.0, -0.3, 0.0))
    field = SharedField([towing, other])
    live(field, 2, [(0.0, 0.0), (0.0, 0.0)])
    towing.hitch(LOADS["box"])
    live(field, 80, [(0.0, 0.0), (1.0, 0.0)])
    (touch,) = field.touches
    assert sorted(touch.parts) == ["car", "load"]


def test_a_laser_sees_the_other_where_it_is_while_both_move() -> None:
    field = SharedField([car((-2.0, 0.0, 0.0), laser=EXACT), car((1.0, 0.3, 2.0), "chair", EXACT)])
    for robot in field.robots:
        robot.scans()
    live(field, 20, [(1.0, 0.1), (1.5, 0.3)])
    poses, outlines = [one.values for one in field.robots], [outline_of(one) for one in field.robots]
    towed = field.robots[1].world.towed
    assert towed is not None
    x, y, yaw, length, width = towed.pose
    load = box(x, y, length, width, yaw)
    for robot in field.robots:
        robot.scans()
    live(field, 1, [(1.0, 0.1), (1.5, 0.3)])
    for index, robot in enumerate(field.robots):
        (scan,) = robot.scans()
        assert scan.robot_time == pytest.approx(1.0)
        around = Outline(PILLARS, (outlines[1 - index], load), (FIELD,))
        x, y, yaw, _ = poses[index]
        ahead, aside, turned = scan.mount
        angles = yaw + turned + scan.first_angle + scan.angle_step * np.arange(len(scan.ranges))
        place = x + ahead * cos(yaw) - aside * sin(yaw), y + ahead * sin(yaw) + aside * cos(yaw)
        true = cast(around, *place, angles)
        without = cast(Outline(PILLARS, (load,) if index else (), (FIELD,)), *place, angles)
        on_the_other = true < without - 0.1
        assert on_the_other.sum() > 3
        seen = np.array(scan.ranges)
        # a ray that just misses a corner may hit it after a few micrometres of motion
        assert (np.abs(seen - true)[on_the_other] < 1e-3).mean() > 0.9
        assert (np.abs(seen - true) < 1e-3).mean() > 0.98


def test_the_very_first_scan_sees_the_others_and_touches_repeat_bit_for_bit() -> None:
    field = SharedField([car((-2.0, 0.0, 0.0), laser=EXACT), car((1.0, 0.0, pi), laser=EXACT)])
    for robot in field.robots:
        robot.scans()
    live(field, 1, [(0.0, 0.0)] * 2)
    (scan,) = field.robots[0].scans()
    assert min(scan.ranges[175:185]) == pytest.approx(1.0 - 0.4 - (-2.0 + 0.12))
    starts = [(-2.0, 0.0, 0.0), (2.0, 0.05, pi), (0.0, -2.0, pi / 2)]
    fields = [SharedField([car(pose, "box", LaserSettings(), 5 + k) for k, pose in enumerate(starts)]) for _ in "12"]
    assert wavy(fields[0], 60) == wavy(fields[1], 60)
    assert fields[0].touches == fields[1].touches != []


def wavy(field: SharedField, ticks: int) -> list[str]:
    for tick in range(ticks):
        live(field, 1, [(1.2 + 0.1 * k, 0.3 * sin(0.3 * tick + k)) for k in range(len(field.robots))])
    return [robot.trajectory_hash for robot in field.robots]


def test_a_car_that_touches_no_other_drives_as_if_alone() -> None:
    field, alone = SharedField([car((-2.0, 0.0, 0.0)), car((2.0, 2.0, 0.0))]), car((-2.0, 0.0, 0.0))
    for tick in range(40):
        action = (1.0, 0.3 * sin(0.3 * tick))
        live(field, 1, [action, (0.0, 0.0)])
        alone.receive(ActionMessage(epoch=1, tick=tick, robot_time=0.0, publish_time=0.0, values=action))
        alone.advance()
    np.testing.assert_allclose(field.robots[0].values, alone.values, atol=1e-9)


def test_what_cannot_share_a_field_is_refused() -> None:
    with pytest.raises(InputError, match="got 1, wanted two or more"):
        SharedField([car((0.0, 0.0, 0.0))])
    elsewhere = CarRobot(Scene(0, None, FIELD, (), (2.0, 0.0, 0.0)))
    with pytest.raises(InputError, match="scenes: got different ones"):
        SharedField([car((0.0, 0.0, 0.0)), elsewhere])
    slower = CarRobot(Scene(0, None, FIELD, PILLARS, (2.0, 0.0, 0.0)), period=0.1)
    with pytest.raises(InputError, match=r"period: got 0.05 and 0.1 s"):
        SharedField([car((0.0, 0.0, 0.0)), slower])
    among = SimulatedSensors((Laser(EXACT),), (Walks((0.0, 2.0), 1.0, 1),))
    alone = CarRobot(Scene(0, None, FIELD, PILLARS, (2.0, 0.0, 0.0)), sensor_inputs=among)
    with pytest.raises(InputError, match=r"people: got 1 in one car's world, wanted none"):
        SharedField([car((0.0, 0.0, 0.0)), alone])
    field = SharedField([car((0.0, 0.0, 0.0)), car((2.0, 0.0, 0.0))])
    with pytest.raises(InputError, match="already drove or shares a field"):
        SharedField([*field.robots, car((-2.0, 0.0, 0.0))])


WIDE = (-9.0, 9.0, -9.0, 9.0)


@final
class Runs(Person):
    def __init__(self, place: Point, speed: float) -> None:
        super().__init__(place)
        self._speed = speed

    def velocity(self, time: float, robot: Point, outline: Outline) -> Point:
        del time, robot, outline
        return self._speed, 0.0


def test_only_the_car_that_hits_something_has_an_approach_speed() -> None:
    scene = Scene(0, load_named("none"), WIDE, ((2.0, 0.0, 0.3),), (0.0, 0.0, 0.0))
    hit = first_contact(CarRobot(scene), 1.0)
    assert (hit.part, hit.what) == ("car", "obstacle 0")
    assert hit.speed == pytest.approx(hit.towards, abs=1e-3)
    assert hit.towards > 0.8
    person = Runs((-3.0, 0.0), 1.5)
    scene = Scene(0, load_named("box"), WIDE, (), (0.0, 0.0, 0.0))
    hit = first_contact(CarRobot(scene, sensor_inputs=SimulatedSensors((Laser(LaserSettings(), 0),), (person,))), 0.5)
    assert (hit.part, hit.what) == ("load", "person 0")
    assert hit.speed > 0.2
    assert hit.towards == pytest.approx(-hit.speed, abs=1e-3), "it drove away from him"


def first_contact(robot: CarRobot, speed: float) -> Collision:
    for tick in range(200):
        if robot.collisions:
            break
        robot.receive(ActionMessage(epoch=1, tick=tick, robot_time=0.0, publish_time=0.0, values=(speed, 0.0)))
        robot.advance()
    return robot.collisions[0]
