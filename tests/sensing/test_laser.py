"""The simulated laser measures the objects around it, and where its rays end no one hides."""

from math import cos, hypot, pi, sin

import numpy as np
import pytest

from safedpa.bus import StateMessage
from safedpa.bus.messages.codec import decode, encode
from safedpa.bus.messages.messages import ScanMessage
from safedpa.errors import InputError
from safedpa.perception.obstacle_tracker import ObstacleTracker
from safedpa.perception.occlusion import OcclusionMap
from safedpa.perception.occupancy_grid import CELL, Grid, dilate, disc_offsets, erode
from safedpa.perception.scan import ScanRays
from safedpa.perception.settings import PerceptionSettings
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene
from safedpa_sim.sensing import Laser, LaserSettings, StepsOut, Walks
from safedpa_sim.sensing.sensor_inputs import SimulatedSensors
from safedpa_sim.sensing.shapes import Outline, box, cast, clearance_at, clearances_at

FIELD = (-4.0, 4.0, -3.0, 3.0)
EXACT = LaserSettings(noise=0.0, drop_outs=0.0)


def test_rays_end_at_the_first_thing_and_agree_with_steps_along_them() -> None:
    outline = Outline(((2.0, 0.0, 0.5),), (box(0.0, 2.0, 1.0, 0.5),), (FIELD,))
    angles = np.array([0.0, pi / 2, pi, -pi / 2, pi / 4])
    np.testing.assert_allclose(cast(outline, 0.0, 0.0, angles), [1.5, 1.75, 4.0, 3.0, 3.0 * 2**0.5], atol=1e-12)
    draw = np.random.default_rng(3)
    outline = Outline(((1.0, 1.0, 0.4), (-2.0, 0.5, 0.3)), (box(0.5, -1.5, 1.2, 0.4, 0.7),), (FIELD,))
    angles = draw.uniform(-pi, pi, 60)
    for angle, reach in zip(angles, cast(outline, 0.1, 0.2, angles), strict=True):
        at = (0.1 + reach * cos(angle), 0.2 + reach * sin(angle))
        assert abs(clearance_at(outline, *at)) < 1e-9
        for share in np.linspace(0.02, 0.98, 30):
            assert clearance_at(outline, 0.1 + share * reach * cos(angle), 0.2 + share * reach * sin(angle)) > 0.0


def driven(laser: Laser, ticks: int, people: tuple[Walks | StepsOut, ...] = ()):
    scene = Scene(0, None, FIELD, ((2.0, 0.0, 0.5),), (0.0, 0.0, 0.3))
    robot = CarRobot(scene, sensor_inputs=SimulatedSensors((laser,), people))
    reported = []
    for _ in range(ticks):
        reported.append(robot.scans())
        robot.advance()
    return robot, reported


def test_scans_come_at_the_lasers_own_rate_and_late() -> None:
    _, reported = driven(Laser(LaserSettings(rate=10.0, latency=0.07)), 20)
    scans = [scan for one in reported for scan in one]
    assert [scan.number for scan in scans] == list(range(9))
    np.testing.assert_allclose([scan.robot_time for scan in scans], np.arange(9) * 0.1)
    for tick, one in enumerate(reported):
        for scan in one:
            assert 0.07 - 1e-9 <= tick * 0.05 - scan.robot_time < 0.12


def test_what_is_measured_lies_on_the_things() -> None:
    robot, reported = driven(Laser(EXACT), 4)
    scan = reported[1][0]
    outline = Outline(robot.scene.obstacles, (), (FIELD,))
    ahead, aside, turned = scan.mount
    x, y = ahead * cos(0.3) - aside * sin(0.3), ahead * sin(0.3) + aside * cos(0.3)
    for index, reach in enumerate(scan.ranges):
        angle = 0.3 + turned + scan.first_angle + index * scan.angle_step
        assert abs(clearance_at(outline, x + reach * cos(angle), y + reach * sin(angle))) < 1e-9


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
        robot = CarRobot(pane, sensor_inputs=SimulatedSensors((Laser(EXACT),), glass=glass))
        robot.advance()
        ranges.append(robot.scans()[0].ranges[len(exact[1][0].ranges) // 2])
    assert ranges[0] == pytest.approx(0.83, abs=1e-9)
    assert ranges[1] == pytest.approx(3.88, abs=1e-9)


def test_a_scan_comes_back_as_it_was_and_two_drives_with_the_same_seed_are_the_same() -> None:
    scan = driven(Laser(LaserSettings(rays=1080)), 4)[1][1][0]
    payload = encode(scan)
    assert len(payload) < 12_000
    assert decode(ScanMessage, payload) == scan

    def once() -> tuple[str, list[list[ScanMessage]]]:
        robot, reported = driven(Laser(LaserSettings(), seed=2), 40, (Walks((-2.0, 0.0), 1.5, 3),))
        return robot.trajectory_hash, [[scan.ranges for scan in one] for one in reported]

    assert once() == once()


def test_people_walk_within_the_field_and_as_fast_as_they_may() -> None:
    people = tuple(Walks((-2.0 + 0.5 * index, 2.0), 1.5, index) for index in range(4))
    scene = Scene(0, None, FIELD, ((2.0, 0.0, 0.5),), (0.0, 0.0, 0.3))
    robot = CarRobot(scene, sensor_inputs=SimulatedSensors((Laser(EXACT),), people))
    outline = Outline(scene.obstacles, (), (FIELD,))
    walked = 0.0
    for _ in range(600):
        before = [person.position for person in people]
        robot.advance()
        for person, (x, y) in zip(people, before, strict=True):
            way = hypot(person.position[0] - x, person.position[1] - y)
            walked += way
            assert way <= 1.5 * 0.05 + 1e-9
            assert clearance_at(outline, *person.position) > person.radius - 0.02
    assert walked > 4 * 30.0 * 0.3


def test_a_person_steps_out_when_the_robot_is_near_and_a_collision_has_the_speed_of_the_car() -> None:
    far, near = StepsOut((3.5, 2.5), (3.5, -2.5), 1.5, 0.5), StepsOut((-2.0, 2.0), (-2.0, -2.0), 1.5, 10.0)
    driven(Laser(EXACT), 20, (far, near))
    assert far.position == (3.5, 2.5)
    assert near.position[1] == pytest.approx(2.0 - 1.5 * 0.95, abs=0.1)
    scene = Scene(0, None, FIELD, (), (0.0, 0.0, 0.0))
    robot = CarRobot(
        scene, sensor_inputs=SimulatedSensors((Laser(EXACT),), (StepsOut((0.2, 2.0), (0.2, -2.0), 1.0, 10.0),))
    )
    for _ in range(60):
        robot.advance()
    assert [(item.what, item.speed < 0.01) for item in robot.collisions] == [("person 0", True)]


@pytest.mark.parametrize(("name", "value"), [("rays", 1), ("rays", 2000), ("rate", 0.0), ("noise", float("nan"))])
def test_a_laser_that_cannot_be_is_refused(name: str, value: float) -> None:
    with pytest.raises(InputError, match=f"laser {name}"):
        LaserSettings(**{name: value})


SLIMMEST = 0.2
ROOM = (-4.0, 4.0, -4.0, 4.0)


def state() -> StateMessage:
    return StateMessage(
        epoch=1, tick=0, robot_time=0.0, publish_time=0.0, values=(0.0, 0.0, 0.0, 0.0), applied=(0.0, 0.0),
        applied_by="filter", period=0.05, lockstep=True, goal=(0.0, 0.0), obstacles=(), field=(), footprint=(),
    )  # fmt: skip


def sweep(ranges: np.ndarray, field_of_view: float = 2.0 * pi) -> ScanRays:
    """From the origin, the first ray straight behind."""
    scan = ScanMessage(
        epoch=1, tick=0, robot_time=0.0, publish_time=0.0, source="laser", mount=(0.0, 0.0, 0.0),
        first_angle=-0.5 * field_of_view, angle_step=field_of_view / len(ranges), ranges=tuple(ranges.tolist()),
        nearest=0.05, farthest=12.0, number=0,
    )  # fmt: skip
    return ScanRays(scan, (0.0, 0.0, 0.0), state(), open_air=False)


def looked(one: ScanRays) -> ObstacleTracker:
    things = ObstacleTracker(PerceptionSettings(), 0.0, 0.0)
    things.take(one, np.zeros((things.grid.size, things.grid.size), dtype=bool))
    return things


def hidden(things: ObstacleTracker, places: np.ndarray) -> np.ndarray:
    i, j, _ = things.grid.cells(places)
    found: np.ndarray = things.hiding.present[i, j]
    return found


@pytest.mark.parametrize("dropped", [2, 3])
def test_between_dropped_rays_no_person_hides_while_others_pass(dropped: int) -> None:
    """Every other ray measures nothing: a body of 0.4 m would have stood in one of those that do."""
    ranges = np.full(360, 3.0)
    ranges[::dropped] = -1.0
    draw = np.random.default_rng(1)
    distance, turn = draw.uniform(0.3, 2.5, 500), draw.uniform(-pi, pi, 500)
    places = np.column_stack([distance * np.cos(turn), distance * np.sin(turn)])
    assert not hidden(looked(sweep(ranges)), places).any()


def test_a_person_may_hide_where_a_whole_sector_is_dropped() -> None:
    ranges = np.full(360, 3.0)
    ranges[170:191] = -1.0
    assert hidden(looked(sweep(ranges)), np.array([[2.0, 0.0]])).all()


@pytest.mark.parametrize("rays", [90, 360, 1080])
def test_a_person_whom_no_ray_hits_is_accounted_for(rays: int) -> None:
    """Places for a body of 0.2 m among pillars and a box, drawn at random."""
    draw = np.random.default_rng(rays)
    outline = Outline(
        ((1.5, 0.5, 0.3), (-1.0, 1.4, 0.25), (0.3, -1.8, 0.2)), (box(-1.5, -1.0, 0.9, 0.4, 0.5),), (ROOM,)
    )
    angles: np.ndarray = -pi + 2.0 * pi / rays * np.arange(rays, dtype=np.float64)
    ranges = cast(outline, 0.0, 0.0, angles)
    things = looked(sweep(ranges))
    places = draw.uniform(-3.7, 3.7, (6000, 2))
    places = places[(clearances_at(outline, places) > SLIMMEST + 0.15) & (np.hypot(*places.T) > 0.5)]
    along = places[:, :1] * np.cos(angles) + places[:, 1:] * np.sin(angles)
    across = places[:, 1:] * np.cos(angles) - places[:, :1] * np.sin(angles)
    chord = SLIMMEST**2 - across**2
    meets = (along > 0.0) & (chord > 0.0)
    hit = (meets & (along - np.sqrt(np.maximum(chord, 0.0)) < ranges)).any(axis=1)
    assert (~hit).sum() > 50
    assert hidden(things, places[~hit]).all()
    if rays == 360:
        assert hidden(things, places[hit]).mean() < 0.1


def test_one_ray_past_the_middle_of_a_cell_rules_out_a_person_anywhere_in_it() -> None:
    width = OcclusionMap(11, SLIMMEST, 1.5).width
    grid = Grid(5.0, 0.0, 0.0)
    x, y = (part[3, 4] for part in grid.middles)
    draw = np.random.default_rng(3)
    for turn in draw.uniform(-pi, pi, 200):
        ray = np.array((x, y)) + width * np.array((np.cos(turn), np.sin(turn)))
        centres = np.array((x, y)) + draw.uniform(-CELL / 2, CELL / 2, (50, 2))
        assert (np.hypot(*(centres - ray).T) <= SLIMMEST + 1e-9).all()


def test_the_farthest_past_a_place_is_the_most_of_the_rays_that_pass_it() -> None:
    draw = np.random.default_rng(4)
    for field_of_view, rays in ((2.0 * pi, 120), (4.0, 90)):
        ranges = draw.uniform(0.5, 6.0, rays)
        one = sweep(ranges, field_of_view)
        angles = -0.5 * field_of_view + field_of_view / rays * np.arange(rays)
        places = draw.uniform(-3.0, 3.0, (400, 2))
        found = one.farthest_past(places[:, 0], places[:, 1], 0.12)
        along = places[:, :1] * np.cos(angles) + places[:, 1:] * np.sin(angles)
        across = np.abs(places[:, 1:] * np.cos(angles) - places[:, :1] * np.sin(angles))
        most = np.where((across <= 0.12 + 1e-9) & (along > 0.0), ranges, 0.0).max(axis=1)
        assert (found <= most + 1e-9).all()
        assert (found == most).mean() > 0.6


@pytest.mark.parametrize("slimmest", [0.1, 0.15, 0.2])
def test_next_to_the_robot_a_person_may_hide_unless_they_would_stand_in_it(slimmest: float) -> None:
    hiding, grid, draw = OcclusionMap(21, slimmest, 1.5), Grid(1.0, 0.0, 0.0), np.random.default_rng(6)
    nothing, own = np.zeros((21, 21), dtype=bool), np.zeros((21, 21), dtype=bool)
    own[8:12, 9:12] = True
    hiding.look(0.0, nothing, nothing, own, nothing)
    x, y = grid.middles
    for i, j in np.argwhere(~hiding.present):
        centres = np.array((x[i, j], y[i, j])) + draw.uniform(-CELL / 2, CELL / 2, (50, 2))
        apart = np.hypot(centres[:, :1] - x[own], centres[:, 1:] - y[own])
        assert (apart.min(axis=1) <= slimmest + 1e-9).all()


@pytest.mark.parametrize("slimmest", [0.1, 0.2])
def test_in_an_empty_room_no_person_hides_however_slim(slimmest: float) -> None:
    things = ObstacleTracker(PerceptionSettings(slimmest=slimmest), 0.0, 0.0)
    things.take(sweep(np.full(360, 4.5)), np.zeros((things.grid.size, things.grid.size), dtype=bool))
    assert not things.hiding.present[np.hypot(*things.grid.middles) < 2.0].any()


def test_what_is_slimmer_than_a_cell_is_refused() -> None:
    with pytest.raises(InputError, match=r"slimmest: got 0\.09, wanted 0\.1 to 5"):
        PerceptionSettings(slimmest=0.09)


def _flag(cells: np.ndarray, i: int, j: int, beyond: bool) -> bool:
    inside = 0 <= i < len(cells) and 0 <= j < len(cells)
    return bool(cells[i, j]) if inside else beyond


@pytest.mark.parametrize("beyond", [False, True])
@pytest.mark.parametrize("radius", [0.0, 0.1, 0.15, 0.2, 0.25, 0.3, 0.42, 1.3])
@pytest.mark.parametrize("size", [1, 2, 5, 9])
def test_cells_grow_by_a_disc(size: int, radius: float, beyond: bool) -> None:
    draw = np.random.default_rng([size, int(100 * radius)])
    for share in (0.0, 0.1, 0.9, 1.0):
        cells = draw.uniform(size=(size, size)) < share
        before = cells.copy()
        wanted = [
            [any(_flag(cells, i + a, j + b, beyond) for a, b, _ in disc_offsets(radius)) for j in range(size)]
            for i in range(size)
        ]
        found = dilate(cells, radius, beyond=beyond)
        assert found.dtype == np.bool_
        np.testing.assert_array_equal(found, wanted)
        np.testing.assert_array_equal(erode(~cells, radius, beyond=not beyond), ~found)
        found[:] = True  # the result is a copy
        np.testing.assert_array_equal(cells, before)


def test_the_middles_move_with_the_grid_and_are_read_only() -> None:
    grid = Grid(0.3, 0.0, 0.0)
    x, y = grid.middles
    assert grid.middles[0] is x
    with pytest.raises(ValueError, match="read-only"):
        x[0, 0] = 1.0
    grid.move((2, -1))
    np.testing.assert_allclose(grid.middles[0], x + 2 * CELL, atol=1e-12)
    np.testing.assert_allclose(grid.middles[1], y - CELL, atol=1e-12)
