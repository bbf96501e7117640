"""The simulated laser measures the objects around it, at its own times, and reports them late."""

from __future__ import annotations

from math import cos, hypot, pi, sin

import numpy as np
import pytest

from safedpa.bus.wire.codec import decode, encode
from safedpa.bus.wire.messages import ScanMessage
from safedpa.errors import InputError
from safedpa_sim.robots.core import CarRobot
from safedpa_sim.robots.scene import Scene
from safedpa_sim.sensing import Laser, LaserSettings, StepsOut, Walks
from safedpa_sim.sensing.senses import Senses
from safedpa_sim.sensing.shapes import Outline, box, cast, room_to

FIELD = (-4.0, 4.0, -3.0, 3.0)
EXACT = LaserSettings(noise=0.0, drop_outs=0.0)


def test_a_ray_ends_at_the_first_thing() -> None:
    outline = Outline(((2.0, 0.0, 0.5),), (box(0.0, 2.0, 1.0, 0.5),), (FIELD,))
    angles = np.array([0.0, pi / 2, pi, -pi / 2, pi / 4])
    np.testing.assert_allclose(cast(outline, 0.0, 0.0, angles), [1.5, 1.75, 4.0, 3.0, 3.0 * 2**0.5], atol=1e-12)


def test_rays_agree_with_steps_along_them() -> None:
    draw = np.random.default_rng(3)
    outline = Outline(((1.0, 1.0, 0.4), (-2.0, 0.5, 0.3)), (box(0.5, -1.5, 1.2, 0.4, 0.7),), (FIELD,))
    angles = draw.uniform(-pi, pi, 60)
    for angle, reach in zip(angles, cast(outline, 0.1, 0.2, angles), strict=True):
        at = (0.1 + reach * cos(angle), 0.2 + reach * sin(angle))
        assert abs(room_to(outline, *at)) < 1e-9
        for share in np.linspace(0.02, 0.98, 30):
            assert room_to(outline, 0.1 + share * reach * cos(angle), 0.2 + share * reach * sin(angle)) > 0.0


def driven(
    laser: Laser, ticks: int, people: tuple[Walks | StepsOut, ...] = ()
) -> tuple[CarRobot, list[list[ScanMessage]]]:
    scene = Scene(0, None, FIELD, ((2.0, 0.0, 0.5),), (0.0, 0.0, 0.3))
    robot = CarRobot(scene, senses=Senses((laser,), people))
    told = []
    for _ in range(ticks):
        told.append(robot.scans())
        robot.advance()
    return robot, told


def test_scans_come_at_the_lasers_own_rate_and_late() -> None:
    _, told = driven(Laser(LaserSettings(rate=10.0, latency=0.07)), 20)
    scans = [scan for one in told for scan in one]
    assert [scan.number for scan in scans] == list(range(9))
    np.testing.assert_allclose([scan.robot_time for scan in scans], np.arange(9) * 0.1)
    for tick, one in enumerate(told):
        for scan in one:
            assert 0.07 - 1e-9 <= tick * 0.05 - scan.robot_time < 0.12


def test_what_is_measured_lies_on_the_things() -> None:
    robot, told = driven(Laser(EXACT), 4)
    scan = told[1][0]
    outline = Outline(robot.scene.obstacles, (), (FIELD,))
    ahead, aside, turned = scan.mount
    x, y = ahead * cos(0.3) - aside * sin(0.3), ahead * sin(0.3) + aside * cos(0.3)
    for index, reach in enumerate(scan.ranges):
        angle = 0.3 + turned + scan.first_angle + index * scan.angle_step
        assert abs(room_to(outline, x + reach * cos(angle), y + reach * sin(angle))) < 1e-9


def test_an_upside_down_scanner_reports_the_same_objects_in_reverse_order() -> None:
    _, upright = driven(Laser(EXACT), 4)
    _, hanging = driven(Laser(LaserSettings(noise=0.0, drop_outs=0.0, clockwise=True)), 4)
    one, other = upright[1][0], hanging[1][0]
    assert other.angle_step == -one.angle_step
    assert other.ranges == one.ranges[::-1]


def test_noise_drop_outs_blind_sectors_and_glass() -> None:
    _, exact = driven(Laser(EXACT), 4)
    _, noisy = driven(Laser(LaserSettings(rays=1080, noise=0.02, drop_outs=0.05, blind=((-0.5, 0.5),)), seed=5), 60)
    scans = [scan for one in noisy for scan in one]
    table = np.array([scan.ranges for scan in scans])
    own = scans[0].first_angle + scans[0].angle_step * np.arange(1080)
    blind = np.abs(own) < 0.5
    assert (table[:, blind] < 0.0).all()
    assert 0.04 < (table[:, ~blind] < 0.0).mean() < 0.06
    seen = table[:, ~blind]
    spread = np.array([column[column > 0.0].std() for column in seen.T])
    assert 0.017 < spread.mean() < 0.023
    pane = Scene(0, None, FIELD, (), (0.0, 0.0, 0.0), polygons=(box(1.0, 0.0, 0.1, 1.0),))
    ranges = []
    for glass in ((), (0,)):
        robot = CarRobot(pane, senses=Senses((Laser(EXACT),), glass=glass))
        robot.advance()
        ranges.append(robot.scans()[0].ranges[len(exact[1][0].ranges) // 2])
    assert ranges[0] == pytest.approx(0.83, abs=1e-9)
    assert ranges[1] == pytest.approx(3.88, abs=1e-9)


def test_a_scan_fits_its_topic_and_comes_back_as_it_was() -> None:
    scan = driven(Laser(LaserSettings(rays=1080)), 4)[1][1][0]
    payload = encode(scan)
    assert len(payload) < 12_000
    assert decode(ScanMessage, payload) == scan


def test_two_drives_with_the_same_seed_are_the_same() -> None:
    def once() -> tuple[str, list[list[ScanMessage]]]:
        robot, told = driven(Laser(LaserSettings(), seed=2), 40, (Walks((-2.0, 0.0), 1.5, 3),))
        return robot.trajectory_hash, [[scan.ranges for scan in one] for one in told]

    assert once() == once()


def test_people_walk_within_the_field_and_as_fast_as_they_may() -> None:
    people = tuple(Walks((-2.0 + 0.5 * index, 2.0), 1.5, index) for index in range(4))
    scene = Scene(0, None, FIELD, ((2.0, 0.0, 0.5),), (0.0, 0.0, 0.3))
    robot = CarRobot(scene, senses=Senses((Laser(EXACT),), people))
    outline = Outline(scene.obstacles, (), (FIELD,))
    walked = 0.0
    for _ in range(600):
        before = [person.place for person in people]
        robot.advance()
        for person, (x, y) in zip(people, before, strict=True):
            way = hypot(person.place[0] - x, person.place[1] - y)
            walked += way
            assert way <= 1.5 * 0.05 + 1e-9
            assert room_to(outline, *person.place) > person.radius - 0.02
    assert walked > 4 * 30.0 * 0.3


def test_a_person_steps_out_when_the_robot_is_near() -> None:
    far, near = StepsOut((3.5, 2.5), (3.5, -2.5), 1.5, 0.5), StepsOut((-2.0, 2.0), (-2.0, -2.0), 1.5, 10.0)
    driven(Laser(EXACT), 20, (far, near))
    assert far.place == (3.5, 2.5)
    assert near.place[1] == pytest.approx(2.0 - 1.5 * 0.95, abs=0.1)


def test_a_collision_has_the_speed_of_the_car() -> None:
    scene = Scene(0, None, FIELD, (), (0.0, 0.0, 0.0))
    robot = CarRobot(scene, senses=Senses((Laser(EXACT),), (StepsOut((0.2, 2.0), (0.2, -2.0), 1.0, 10.0),)))
    for _ in range(60):
        robot.advance()
    assert [(item.what, item.speed < 0.01) for item in robot.collisions] == [("person 0", True)]


@pytest.mark.parametrize(("name", "value"), [("rays", 1), ("rays", 2000), ("rate", 0.0), ("noise", float("nan"))])
def test_a_laser_that_cannot_be_is_refused(name: str, value: float) -> None:
    with pytest.raises(InputError, match=f"laser {name}"):
        LaserSettings(**{name: value})
