"""Perception finds what is at rest, what moves and what is hidden, and reports faults of a source."""

from collections.abc import Callable
from dataclasses import replace
from math import hypot

import numpy as np
import pytest
from scipy import ndimage

from safedpa.bus import SURROUNDINGS, ScanMessage, StateMessage, SurroundingsMessage
from safedpa.bus.messages.messages import ActionMessage
from safedpa.errors import MessageError
from safedpa.perception import PerceptionNode, PerceptionSettings
from safedpa.perception.obstacle_tracker import ObstacleTracker
from safedpa.perception.occlusion import OcclusionMap
from safedpa.perception.occupancy_grid import Grid, shift_cells
from safedpa.perception.scan import ScanRays
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene
from safedpa_sim.sensing import Laser, LaserSettings, Person, StepsOut, Walks
from safedpa_sim.sensing.sensor_inputs import SimulatedSensors
from safedpa_sim.sensing.shapes import Outline, box, cast, clearance_at, clearances_at

FIELD = (-3.0, 4.0, -3.0, 3.0)
SCENE = Scene(0, None, FIELD, ((2.0, 0.5, 0.3),), (-1.0, 0.0, 0.2), polygons=(box(0.5, -1.5, 0.6, 0.6, 0.3),))
OUTLINE = Outline(SCENE.obstacles, SCENE.polygons, (FIELD,))
Changes = Callable[[ScanMessage, StateMessage], ScanMessage | None]


def unchanged(scan: ScanMessage, state: StateMessage) -> ScanMessage | None:
    del state
    return scan


def driven(
    ticks: int, action: tuple[float, float] = (0.4, 0.1), people: tuple[Person, ...] = (), scene: Scene = SCENE,
    laser: LaserSettings | None = None, change: Changes = unchanged, settings: PerceptionSettings | None = None,
) -> list[tuple[CarRobot, StateMessage, SurroundingsMessage]]:  # fmt: skip
    robot = CarRobot(scene, sensor_inputs=SimulatedSensors((Laser(laser or LaserSettings(), 1),), people))
    node, reported = PerceptionNode(settings), []
    for tick in range(ticks):
        state = robot.state_message()
        for scan in robot.scans():
            heard = change(scan, state)
            if heard is not None:
                node.hear("r", heard)
        message = node.step("r", state, {})[SURROUNDINGS]
        assert isinstance(message, SurroundingsMessage)
        reported.append((robot, state, message))
        robot.receive(ActionMessage(epoch=1, tick=tick, robot_time=0.0, publish_time=0.0, values=action))
        robot.advance()
    return reported


def seen_from(name: str, x: float, time: float, radius: float, state: StateMessage) -> ScanRays:
    """A scan from (x, 0) of a person of that radius at (1, 0), if any, and of a round wall."""
    angles = np.arange(0.0, 2.0 * np.pi, 0.01)
    along, across = (1.0 - x) * np.cos(angles), (1.0 - x) * np.sin(angles)
    hits = (np.abs(across) < radius) & (along > 0.0)
    near = along - np.sqrt(np.where(hits, radius**2 - across**2, 0.0))
    scan = ScanMessage(
        epoch=state.epoch, tick=state.tick, robot_time=time, publish_time=0.0, source=name, mount=(x, 0.0, 0.0),
        first_angle=0.0, angle_step=0.01, ranges=tuple(np.where(hits, near, 3.0).tolist()), nearest=0.02, farthest=8.0,
        number=int(100 * time),
    )  # fmt: skip
    return ScanRays(scan, (0.0, 0.0, 0.0), state, open_air=False)


def test_what_one_source_saw_is_not_dropped_since_another_one_sees_its_other_side() -> None:
    """Two lasers that alternate: each sees the nearer side of a person between them."""
    state = driven(1)[0][1]
    things = ObstacleTracker(PerceptionSettings(), 0.0, 0.0)
    own = np.zeros(things.first.shape, dtype=bool)
    for tick in range(40):
        radius = 0.12 if tick > 30 else 0.0  # a person has stepped in
        for name, x, later in (("front", -0.5, 0.0), ("rear", 2.5, 0.05)):
            time = 0.1 * tick + later
            things.take(seen_from(name, x, time, radius, state), own)
            if tick > 31:
                reported = things.places(things.moving_now(time))
                assert reported[:, 0].min() < 1.0 - radius + 0.03
                assert reported[:, 0].max() > 1.0 + radius - 0.03


def test_points_lie_on_what_is_at_rest_and_nothing_is_seen_to_move() -> None:
    """What comes out of a shadow may move for a quarter of a second: whether it was hidden is not known."""
    reported = driven(140)
    restless = []
    for _, _, message in reported[20:]:
        assert len(message.points) > 60
        restless.append(len(message.movers))
        assert not message.problems
        for x, y, radius, *_ in message.points + message.movers:
            assert abs(clearance_at(OUTLINE, x, y)) < radius + 0.03
    assert np.mean(restless) < 3
    assert max(restless) < 15


def test_every_near_object_is_covered() -> None:
    """Every visible place on a surface within 1.5 m is at most 5 cm outside of the discs."""
    reported = driven(100)
    _, state, message = reported[-1]
    discs = np.array(message.points)
    table = np.linspace(0.0, 2.0 * np.pi, 200)
    surface = np.column_stack([2.0 + 0.3 * np.cos(table), 0.5 + 0.3 * np.sin(table)])
    x, y = state.values[:2]
    seen = surface[np.hypot(*(surface - (x, y)).T) < hypot(2.0 - x, 0.5 - y) - 0.15]
    assert len(seen) > 20
    for place in seen:
        assert (np.hypot(*(discs[:, :2] - place).T) - discs[:, 2]).min() < 0.05


def test_a_walking_person_is_among_the_movers() -> None:
    person = Walks((1.0, 2.2), 1.2, 5)
    robot = CarRobot(SCENE, sensor_inputs=SimulatedSensors((Laser(LaserSettings(), 1),), (person,)))
    node, walked, in_sight = PerceptionNode(), 0, 0
    for _ in range(200):
        state = robot.state_message()
        for scan in robot.scans():
            node.hear("r", scan)
        message = node.step("r", state, {})[SURROUNDINGS]
        assert isinstance(message, SurroundingsMessage)
        way = np.array(person.position) - state.values[:2]
        blocked = cast(OUTLINE, *state.values[:2], np.array([np.arctan2(way[1], way[0])]))[0] < np.hypot(*way)
        in_sight = 0 if blocked else in_sight + 1
        if state.robot_time > 1.0:
            walked += 1
            reported = message.movers if in_sight > 10 else message.movers + message.hidden  # gone behind the box
            nearest = min(
                (hypot(x - person.position[0], y - person.position[1]) - radius for x, y, radius, *_ in reported),
                default=9.0,
            )
            assert nearest < person.radius, f"at {state.robot_time} s"
        robot.advance()
    assert walked >= 179


def reachable(start: tuple[float, float], message: SurroundingsMessage) -> np.ndarray:
    """Positions (n, 2) m that a person of 0.2 m radius reaches from ``start`` outside hidden and moving discs."""
    edge, size = 0.05, 140
    axis = (np.arange(size) - size // 2) * edge
    places = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
    free = np.array(room_to_all(places.reshape(-1, 2))).reshape(size, size) > 0.2
    for x, y, radius, *_ in message.hidden + message.movers:
        free &= np.hypot(places[..., 0] - x, places[..., 1] - y) > radius
    begin = tuple(np.rint(np.array(start) / edge).astype(int) + size // 2)
    free[begin] = True
    labels, _ = ndimage.label(free)
    return places[labels == labels[begin]]


def room_to_all(places: np.ndarray) -> np.ndarray:
    return clearances_at(OUTLINE, places)


@pytest.mark.long
@pytest.mark.parametrize("action", [(0.0, 0.0), (0.5, 0.2)])
def test_a_hidden_person_comes_out_through_a_reported_disc(action: tuple[float, float]) -> None:
    """A person stands behind the box and is never seen: every path from there to the robot meets a reported disc."""
    place = (0.9, -2.5)
    reported = driven(60, action=action, people=(StepsOut(place, (0.9, 2.0), 1.5, 0.01),))
    for _, state, message in reported[3:]:
        ways = reachable(place, message)
        assert np.hypot(ways[:, 0] - state.values[0], ways[:, 1] - state.values[1]).min() > 0.8, state.robot_time


def test_no_person_is_reported_to_hide_behind_the_walls() -> None:
    """A person may be there and cannot come in: near the middle of a closed room no wall has a disc."""
    reported = driven(60, action=(0.0, 0.0))
    _, _, message = reported[-1]
    assert message.hidden
    for x, y, radius, _ in message.hidden:
        assert max(abs(x) - 4.0, abs(y) - 3.0) < radius, (x, y, radius)


def test_where_too_much_is_seen_one_disc_covers_several_objects() -> None:
    few, all_of_it = PerceptionSettings(most=24), PerceptionSettings(most=256)
    (_, _, coarse), (_, _, fine) = (driven(60, settings=settings)[-1] for settings in (few, all_of_it))
    assert len(fine.points) > 24 >= len(coarse.points)
    discs = np.array(coarse.points)
    alone = [(x, y) for x, y, radius in fine.points if radius == all_of_it.point_radius]
    assert len(alone) > 3
    for x, y in alone:
        assert (np.hypot(discs[:, 0] - x, discs[:, 1] - y) + few.point_radius - discs[:, 2]).min() < 1e-9


def test_a_person_out_of_sight_does_not_grow_for_ever() -> None:
    """A person walks behind the box: the disc of the last sighting gives way to the hidden room."""
    reported = driven(120, action=(0.0, 0.0), people=(StepsOut((2.6, -1.0), (-2.0, -2.6), 1.5, 9.0),))
    assert any(message.movers for _, _, message in reported)
    for _, _, message in reported:
        assert all(radius < 1.0 for _, _, radius, *_ in message.movers)


def test_what_was_seen_long_ago_is_wider_by_what_the_robot_may_have_misjudged_its_way() -> None:
    """A laser that looks ahead alone, and a robot that drives past a box: behind it the box is remembered."""

    def seen_of_the_box(drift: float) -> list[float]:
        own = PerceptionSettings(drift=drift)
        reported = driven(100, action=(0.6, -0.02), laser=LaserSettings(field_of_view=2.4), settings=own)
        return [radius for x, y, radius in reported[-1][2].points if abs(x - 0.5) < 0.5 and abs(y + 1.5) < 0.5]

    exact, drifted = seen_of_the_box(0.0), seen_of_the_box(0.05)
    assert len(exact) == len(drifted) > 0
    assert min(after - before for before, after in zip(exact, drifted, strict=True)) > 0.05 * 0.5


def test_a_laser_that_looks_over_a_low_thing_does_not_erase_it() -> None:
    """Two lasers: one sees the pillar at its height, the other looks over it."""
    low, high = LaserSettings(name="low"), LaserSettings(name="high", mount=(0.0, 0.0, 0.0))
    robot = CarRobot(SCENE, sensor_inputs=SimulatedSensors((Laser(low, 1), Laser(high, 2))))
    bare = CarRobot(
        replace(SCENE, obstacles=(), polygons=()), sensor_inputs=SimulatedSensors((Laser(low, 3), Laser(high, 4)))
    )
    node = PerceptionNode()
    for tick in range(60):
        state = robot.state_message()
        seen, over = robot.scans(), bare.scans()
        for scan in [one for one in seen if one.source == "low"] + [one for one in over if one.source == "high"]:
            node.hear("r", scan)
        message = node.step("r", state, {})[SURROUNDINGS]
        assert isinstance(message, SurroundingsMessage)
        if tick > 20:
            rooms = [hypot(x - 1.7, y - 0.5) - radius for x, y, radius in message.points]
            assert min(rooms) < 0.1, state.robot_time
            assert not message.movers
            assert not message.problems
        robot.advance()
        bare.advance()


def test_empty_room_stays_empty_as_long_as_no_person_can_have_come() -> None:
    """A front goes 1.5 m/s from the last unseen cell: no faster, no slower by more than a cell."""
    hiding = OcclusionMap(81, 0.2, 1.5)
    none = np.zeros((81, 81), dtype=bool)
    seen = none.copy()
    seen[5:76, 5:76] = True  # 3.5 m around the middle
    hiding.look(0.0, seen, none, none, none)
    assert not hiding.present[10:71, 10:71].any()
    for step in range(1, 11):
        hiding.wait(0.1 * step)
    reached = hiding.present[40]
    front = int(np.argmin(reached[:41])) - 1
    assert 4 + 15 - 1 <= front <= 4 + 15


@pytest.mark.parametrize(("gap", "comes"), [(0, False), (2, False), (9, True)])
def test_behind_walls_all_around_nothing_hides_after_one_look_unless_a_gap_lets_people_through(gap: int, comes: bool):
    hiding = OcclusionMap(81, 0.2, 1.5)
    none = np.zeros((81, 81), dtype=bool)
    wall, inside = none.copy(), none.copy()
    wall[20, 20:61] = wall[60, 20:61] = wall[20:61, 20] = wall[20:61, 60] = True
    wall[20, 40 : 40 + gap] = False
    inside[21:60, 21:60] = True
    hiding.look(0.0, inside, wall, none, none)
    for step in range(1, 60):
        hiding.look(0.1 * step, none, wall, none, none)
    assert hiding.present[24:57, 24:57].any() == comes
    assert hiding.present[:17].all()


def test_cells_move_with_the_robot() -> None:
    grid = Grid(2.0, 0.0, 0.0)
    cells = np.zeros((grid.size, grid.size), dtype=bool)
    place = np.array([[0.53, -0.28]])
    i, j, _ = grid.cells(place)
    cells[i, j] = True
    way = grid.shift_to(0.75, -0.4, 2)
    assert way != (0, 0)
    grid.move(way)
    cells = shift_cells(cells, way, False)
    i, j, within = grid.cells(place)
    assert within.all()
    assert cells[i, j].all()
    assert cells.sum() == 1
    x, y = grid.middles
    assert abs(x[i, j][0] - 0.53) <= 0.05
    assert abs(y[i, j][0] + 0.28) <= 0.05


def frozen_after(seconds: float) -> Changes:
    retained: list[ScanMessage] = []

    def change(scan: ScanMessage, state: StateMessage) -> ScanMessage:
        if state.robot_time < seconds or not retained:
            retained[:] = [scan]
            return scan
        return replace(scan, ranges=retained[0].ranges)

    return change


def silent_between(first: float, last: float) -> Changes:
    return lambda scan, state: None if first < state.robot_time < last else scan


def mirrored(scan: ScanMessage, state: StateMessage) -> ScanMessage:
    del state
    return replace(scan, first_angle=-scan.first_angle, angle_step=-scan.angle_step)


def turned(scan: ScanMessage, state: StateMessage) -> ScanMessage:
    """From 3 s on the sensor is knocked out of place."""
    return scan if state.robot_time < 3.0 else replace(scan, ranges=scan.ranges[60:] + scan.ranges[:60])


def old(scan: ScanMessage, state: StateMessage) -> ScanMessage:
    return replace(scan, robot_time=max(scan.robot_time - 0.8, 0.0)) if state.robot_time > 2.0 else scan


def blinded(scan: ScanMessage, state: StateMessage) -> ScanMessage:
    del state
    return replace(scan, ranges=(-1.0,) * len(scan.ranges))


@pytest.mark.parametrize(
    ("change", "notice"),
    [
        (lambda scan, state: None, "no scan was received"),
        (frozen_after(2.0), "frozen"),
        (mirrored, "contradicts"),
        (turned, "contradicts"),
        (old, "was silent"),
        (silent_between(2.0, 9.0), "was silent"),
        (blinded, "measures 0 %"),
    ],
)
def test_a_fault_of_a_source_is_reported(change: Changes, notice: str) -> None:
    reported = driven(120, action=(0.5, 0.3), change=change)
    assert any(notice in sentence for _, state, message in reported for sentence in message.problems)
    assert change is turned or notice in " ".join(reported[-1][2].problems)


def test_a_source_that_speaks_again_is_believed_again() -> None:
    reported = driven(120, change=silent_between(2.0, 3.0))
    problems = [state.robot_time for _, state, message in reported if message.problems]
    assert min(problems[1:]) < 2.7
    assert 2.9 < max(problems) < 3.3


def test_people_from_a_blind_quarter_are_accounted_for() -> None:
    sees = driven(60, action=(0.0, 0.0))[-1]
    blind = driven(60, action=(0.0, 0.0), laser=LaserSettings(blind=((-0.785, 0.785),)))[-1]

    def ahead(message: SurroundingsMessage) -> float:
        return min((hypot(x + 1.0, y) - radius for x, y, radius, _ in message.hidden if x > -0.5), default=9.0)

    assert ahead(sees[2]) > 1.5
    assert ahead(blind[2]) < 0.7


@pytest.mark.parametrize(
    "wrong",
    [
        {"mount": (0.0, 0.0)}, {"ranges": (1.0,)}, {"ranges": (1.0,) * 2000}, {"angle_step": 0.0}, {"angle_step": 3.0},
        {"nearest": 5.0, "farthest": 1.0},
    ],
)  # fmt: skip
def test_a_scan_that_can_be_none_is_refused(wrong: dict[str, object]) -> None:
    scans: list[ScanMessage] = []
    driven(4, change=lambda scan, state: scans.append(scan) or scan)  # type: ignore[func-returns-value]
    with pytest.raises(MessageError, match="scan of laser"):
        PerceptionNode().hear("r", replace(scans[0], **wrong))


def test_a_robot_without_sources_has_no_surroundings() -> None:
    robot = CarRobot(SCENE)
    assert PerceptionNode().step("r", robot.state_message(), {}) == {}
