"""Zones, sources and lone rays: an order of a person is followed, and removes no more than it says."""

from dataclasses import replace
from math import cos, hypot, pi, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.adaptation import AdaptationNode
from safedpa.bus import SURROUNDINGS, Request, SurroundingsMessage
from safedpa.bus.messages.messages import ActionMessage, ScanMessage
from safedpa.dynamics import load_model
from safedpa.errors import InputError
from safedpa.perception import PerceptionNode, PerceptionSettings, SourceSettings, Zone
from safedpa.perception.occlusion import OcclusionMap
from safedpa.perception.occupancy_grid import CELL, Grid
from safedpa.perception.surroundings import closed_discs
from safedpa.perception.zones import distance_to_border, polygon_contains, unoccupied_cells, zone_entry_distance
from safedpa.policy import PolicyNode
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety.defaults import margin_for, settings_named
from safedpa_sim.closed_loop import drive
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene
from safedpa_sim.sensing import Laser, LaserSettings
from safedpa_sim.sensing.sensor_inputs import SimulatedSensors

FIELD = (-3.0, 4.0, -3.0, 3.0)
PILLAR = Scene(0, None, FIELD, ((1.5, 0.0, 0.3),), (0.0, 0.0, 0.0))
AROUND_IT = ((1.1, -0.4), (1.9, -0.4), (1.9, 0.4), (1.1, 0.4))
DOCK = Zone("dock", "ignored", AROUND_IT)
Discs = tuple[tuple[float, ...], ...]


def car(scene: Scene = PILLAR, *lasers: LaserSettings) -> CarRobot:
    return CarRobot(
        scene, sensor_inputs=SimulatedSensors([Laser(one, k) for k, one in enumerate(lasers or (LaserSettings(),), 1)])
    )


def stepped(node: PerceptionNode, robot: CarRobot, tick: int, speed: float = 0.0) -> SurroundingsMessage:
    """One tick of a car with the command to drive at ``speed``."""
    for scan in robot.scans():
        node.hear("r", scan)
    message = node.step("r", robot.state_message(), {})[SURROUNDINGS]
    assert isinstance(message, SurroundingsMessage)
    robot.receive(ActionMessage(epoch=1, tick=tick, robot_time=0.0, publish_time=0.0, values=(speed, 0.0)))
    robot.advance()
    return message


def reported(own: PerceptionSettings, scene: Scene = PILLAR, *lasers: LaserSettings) -> SurroundingsMessage:
    """After a second and a half of a car that stands."""
    node, robot = PerceptionNode(own), car(scene, *lasers)
    return [stepped(node, robot, tick) for tick in range(30)][-1]


def with_zones(*zones: Zone) -> PerceptionSettings:
    return PerceptionSettings(zones=zones)


def middles(discs: Discs, low: tuple[float, float], high: tuple[float, float]) -> list[tuple[float, float]]:
    """Of the discs, those that lie in a box."""
    return [(x, y) for x, y, *_ in discs if low[0] < x < high[0] and low[1] < y < high[1]]


FRONT, BEHIND = ((1.05, -0.45), (1.6, 0.45)), ((1.9, -0.6), (3.0, 0.6))


def test_objects_in_an_ignored_zone_are_left_out_those_behind_stay_hidden_and_the_way_there_is_free() -> None:
    usual, ignoring = reported(PerceptionSettings()), reported(with_zones(DOCK))
    assert middles(usual.points + usual.movers, *FRONT)
    assert not middles(ignoring.points + ignoring.movers, *FRONT)
    assert middles(ignoring.hidden, *BEHIND), "no ray looked there"
    assert not middles(ignoring.hidden, (1.1, -0.4), (1.9, 0.4)), "no person hides in it"
    nothing = reported(PerceptionSettings(), replace(PILLAR, obstacles=()))
    assert not middles(nothing.hidden, *BEHIND)
    assert not ignoring.problems
    # The rays that end in it passed it.
    assert not middles(reported(with_zones(DOCK)).hidden, (0.3, -0.5), (1.0, 0.5))


def test_a_zone_of_the_robot_s_frame_turns_with_it() -> None:
    scene = Scene(0, None, FIELD, ((1.0, 1.0, 0.3),), (1.0, -0.5, pi / 2.0))  # the pillar 1.5 m ahead of it
    low, high = (0.55, 0.6), (1.45, 1.1)
    usual, ignoring = reported(PerceptionSettings(), scene), reported(with_zones(replace(DOCK, frame="robot")), scene)
    assert middles(usual.points + usual.movers, low, high)
    assert not middles(ignoring.points + ignoring.movers, low, high)
    assert middles(ignoring.hidden, (0.4, 1.4), (1.6, 2.5))
    elsewhere = reported(with_zones(DOCK), scene)
    assert middles(elsewhere.points, low, high), "the same numbers on the map are another place"


def test_an_object_seen_before_it_entered_a_zone_of_the_robot_s_frame_stays_reported() -> None:
    ahead = Zone("arm", "ignored", ((0.3, -0.3), (0.7, -0.3), (0.7, 0.3), (0.3, 0.3)), "robot")
    node, robot = PerceptionNode(with_zones(ahead)), car(replace(PILLAR, obstacles=((1.2, 0.0, 0.2),)))
    for tick in range(60):
        message = stepped(node, robot, tick, 0.2)
    x = robot.state_message().values[0]
    assert x + 0.3 < 1.0 < x + 0.7, "the pillar's face is in the zone"
    assert middles(message.points, (0.9, -0.2), (1.2, 0.2))


def test_an_ignored_zone_in_which_no_ray_ends_hides_no_person() -> None:
    shadow = Zone("cupboard", "ignored", ((1.9, -0.8), (3.9, -0.8), (3.9, 0.8), (1.9, 0.8)))
    usual, ignoring = reported(PerceptionSettings()), reported(with_zones(shadow))
    assert middles(usual.hidden, *BEHIND)
    assert not middles(ignoring.hidden, *BEHIND)
    assert middles(ignoring.points, *FRONT), "objects in front of it are reported as ever"


@pytest.mark.parametrize("frame", ["map", "robot"])
def test_an_object_remembered_in_a_zone_that_begins_to_count_stays_reported_in_the_robot_s_frame_alone(frame: str):
    node, robot = PerceptionNode(with_zones(replace(DOCK, frame=frame, use=False))), car()
    before = [stepped(node, robot, tick) for tick in range(30)][-1]
    node.switches.answer("r", Request(do="switch", switches=("zone dock=on",)))
    after = [stepped(node, robot, tick) for tick in range(30, 40)]
    assert middles(before.points, *FRONT)
    assert [bool(middles(message.points, *FRONT)) for message in after] == [frame == "robot"] * 10


def test_a_ray_is_believed_up_to_where_it_first_comes_into_the_zone_that_it_ends_in() -> None:
    horseshoe = ((0.0, 0.0), (3.0, 0.0), (3.0, 2.0), (2.0, 2.0), (2.0, 1.0), (1.0, 1.0), (1.0, 2.0), (0.0, 2.0))
    zone, ends = Zone("u", "ignored", horseshoe), np.array([(2.5, 1.5), (1.5, 1.5), (0.5, 1.5), (5.0, 1.5)])
    assert zone_entry_distance((zone,), (0.0, 0.0, 0.0), (-1.0, 1.5), ends).tolist() == [1.0, np.inf, 1.0, np.inf]
    assert zone_entry_distance((zone,), (0.0, 0.0, 0.0), (1.5, 1.5), ends).tolist() == [0.5, np.inf, 0.5, np.inf]
    assert zone_entry_distance((zone,), (0.0, 0.0, 0.0), (0.5, 1.5), ends).tolist() == [0.0, np.inf, 0.0, np.inf]
    turned = replace(zone, frame="robot")
    assert zone_entry_distance((turned,), (0.0, 0.0, pi / 2.0), (-1.5, -1.0), np.array([(-1.5, 2.5)]))[
        0
    ] == pytest.approx(1.0)


def test_no_person_leaves_an_unseen_ignored_zone_but_one_appearing_next_to_it_may_have() -> None:
    grid = Grid(2.0, 0.0, 0.0)
    square = Zone("z", "ignored", ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)))
    no_one = unoccupied_cells((square,), grid, (0.0, 0.0, 0.0))
    x, y = grid.middles
    away = np.maximum(np.abs(x), np.abs(y))
    assert no_one[away < 0.5].all(), "all of it,"
    alongside = (np.abs(y) < 0.4) & (away > 0.5)
    assert no_one[alongside & (away < 0.6)].all(), "and as far around it as a person would overlap,"
    assert not no_one[away > 0.6].any(), "but no farther"
    nothing = np.zeros_like(no_one)
    outside = ~no_one & (away < 1.2)
    for marked in (True, False):
        hiding = OcclusionMap(grid.size, 0.2, 1.5)
        hiding.unoccupied = no_one if marked else nothing
        hiding.look(0.0, ~no_one, nothing, nothing, nothing)
        hiding.wait(0.2)
        assert bool(hiding.reached(0.2)[outside].any()) is not marked
        assert bool(hiding.exits[away < 1.2].any()) is not marked
    seen_through = OcclusionMap(grid.size, 0.2, 1.5)
    seen_through.unoccupied = no_one
    seen_through.look(0.0, np.ones_like(no_one), nothing, nothing, nothing)
    assert (seen_through.reached(0.2) == no_one)[away < 1.2].all(), "it was empty; who stands in it now is not seen"


@pytest.mark.parametrize("retained", ["speed", "robots", "use"])
def test_a_zone_that_does_not_count_changes_nothing(retained: str) -> None:
    zone = {
        "speed": replace(DOCK, speed=(0.5, 1.0)),
        "robots": replace(DOCK, robots=("another",)),
        "use": replace(DOCK, use=False),
    }[retained]
    usual, other = reported(PerceptionSettings()), reported(with_zones(zone))
    assert replace(other, publish_time=0.0) == replace(usual, publish_time=0.0)
    counting = {"speed": replace(zone, speed=(0.0, 0.5)), "robots": replace(zone, robots=("r",)), "use": DOCK}[retained]
    assert reported(with_zones(counting)).points != usual.points


@pytest.mark.parametrize(
    ("speed", "counts"), [(0.2, False), (0.3, True), (-0.4, True), (0.5, True), (0.6, False), (-0.2, False)]
)
def test_a_range_of_speeds_holds_both_ends_either_way(speed: float, counts: bool) -> None:
    assert replace(DOCK, speed=(0.3, 0.5)).counts_at(speed) is counts
    assert DOCK.counts_at(speed)


@pytest.mark.parametrize("speed", [None, float("nan")])
def test_without_a_speed_only_what_closes_counts(speed: float | None) -> None:
    assert not replace(DOCK, speed=(0.0, 9.0)).counts_at(speed)
    assert replace(DOCK, kind="closed", speed=(0.0, 9.0)).counts_at(speed)


def star(corners: list[float], x: float, y: float, size: float) -> tuple[tuple[float, float], ...]:
    """A polygon whose edges do not cross: its vertices lie around (x, y), each as far away as is drawn."""
    turns = [2.0 * pi * k / len(corners) for k in range(len(corners))]
    return tuple(
        (x + size * far * cos(turn), y + size * far * sin(turn)) for far, turn in zip(corners, turns, strict=True)
    )


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.floats(0.2, 1.0), min_size=3, max_size=12),
    st.tuples(*[st.floats(-4.0, 4.0)] * 2),
    st.floats(0.05, 6.0),
    st.integers(0, 2**32 - 1),
)
def test_every_place_of_a_closed_zone_within_reach_is_covered(corners, middle, size, seed):
    """And no disc goes on beyond the zone for more than the diagonal of a cell."""
    reach, here = 3.0, np.array((0.137, -0.214))
    zone = Zone("z", "closed", star(corners, *middle, size))
    polygon = np.array(zone.polygon)
    discs = closed_discs((zone,), *here.tolist(), reach)
    drawn = np.random.default_rng(seed).uniform(polygon.min(axis=0), polygon.max(axis=0), (400, 2))
    places = np.vstack([drawn[polygon_contains(polygon, drawn)], polygon])
    places = places[np.hypot(*(places - here).T) <= reach]
    if len(places):
        apart = np.hypot(*(places[:, np.newaxis] - discs[:, :2]).transpose(2, 0, 1)) - discs[:, 2]
        assert apart.min(axis=1).max() <= 1e-9
    turns = np.linspace(0.0, 2.0 * pi, 24)
    for x, y, radius in discs:
        rim = np.column_stack([x + radius * np.cos(turns), y + radius * np.sin(turns)])
        beyond = ~polygon_contains(polygon, rim)
        assert not beyond.any() or distance_to_border(polygon, rim[beyond]).max() <= 2.0**0.5 * CELL + 1e-9


def test_a_closed_zone_is_reported_with_what_is_seen_and_never_cut_off() -> None:
    hall = Zone("hall", "closed", ((-2.5, 1.0), (3.5, 1.0), (3.5, 2.8), (-2.5, 2.8)))
    own = replace(with_zones(hall), most=40)
    message, usual = reported(own), reported(PerceptionSettings())
    assert len(message.points) <= 40
    discs = np.array(message.points)
    grid = np.stack(np.meshgrid(np.arange(-2.5, 3.5, 0.05), np.arange(1.0, 2.8, 0.05)), axis=-1).reshape(-1, 2)
    seen = np.array([(x, y) for x, y, *_ in usual.points])
    for place in (*grid[np.hypot(*grid.T) < own.reach], *seen):
        assert (np.hypot(*(discs[:, :2] - place).T) - discs[:, 2]).min() < 1e-9
    assert message.hidden == usual.hidden, "it hides no person"


def farthest_nose(zones: tuple[Zone, ...]) -> float:
    """Largest x [m] of the body of a filtered car whose policy heads straight for a goal at (2, 0)."""
    model, own = load_model("car"), settings_named("car")
    scene = Scene(0, None, FIELD, (), (-1.5, 0.0, 0.0), ((2.0, 0.0),))
    nodes = [
        AdaptationNode(model),
        PerceptionNode(with_zones(*zones)),
        PolicyNode(model, "goal_seeker"),
        SafetyFilterNode(model, own, margin_for(model)),
    ]
    states = [tick.state for tick in drive(car(scene), nodes, 140)]
    return max(one.values[0] + one.footprint[1] * cos(one.values[2]) + one.footprint[2] for one in states)


def test_a_filtered_car_does_not_drive_into_a_closed_zone() -> None:
    wet = Zone("wet", "closed", ((0.2, -2.9), (1.0, -2.9), (1.0, 2.9), (0.2, 2.9)))
    assert farthest_nose(()) > 1.0, "without the zone it does"
    assert -0.3 < farthest_nose((wet,)) < 0.2, "it drives up to it"


def lone(ray: int, at: float = 1.0, width: int = 1) -> list[ScanMessage]:
    """Scans of a round wall at 2.5 m; in each, ``width`` rays end before it."""
    noise = np.random.default_rng(3)
    scans = []
    for number in range(8):
        ranges = 2.5 + 0.01 * noise.standard_normal(360)
        ranges[ray : ray + width] = at + 0.005 * noise.standard_normal(width)
        scans.append(
            ScanMessage(
                epoch=1, tick=2 * number, robot_time=0.1 * number, publish_time=0.0, source="laser",
                mount=(0.0, 0.0, 0.0), first_angle=0.0, angle_step=2.0 * pi / 360, ranges=tuple(ranges.tolist()),
                nearest=0.05, farthest=12.0, number=number,
            )
        )  # fmt: skip
    return scans


def heard(own: PerceptionSettings, scans: list[ScanMessage]) -> SurroundingsMessage:
    node, state = PerceptionNode(own), car().state_message()
    for scan in scans:
        node.hear("r", scan)
        message = node.step("r", replace(state, tick=scan.tick, epoch=1, robot_time=scan.robot_time), {})[SURROUNDINGS]
    assert isinstance(message, SurroundingsMessage)
    return message


def near(message: SurroundingsMessage) -> int:
    return sum(hypot(x, y) < 2.0 for x, y, *_ in message.points + message.movers)


THREE = PerceptionSettings(min_points=3)


def test_lone_rays_are_noise_where_more_are_required_and_free_nothing_behind_a_wall() -> None:
    assert near(heard(PerceptionSettings(), lone(30)))
    assert not near(heard(THREE, lone(30)))
    assert not near(heard(THREE, lone(30, width=2)))
    assert near(heard(THREE, lone(30, width=3)))
    person = 2 * int(np.degrees(np.arcsin(0.2 / 1.0)))
    assert near(heard(replace(THREE, min_points=8), lone(30, width=person)))
    assert near(heard(replace(THREE, sources={"laser": SourceSettings(min_points=1)}), lone(30)))
    assert not near(heard(PerceptionSettings(sources={"laser": SourceSettings(min_points=2)}), lone(30)))
    # The neighbouring rays see past; the wall of all others stays.
    message = heard(THREE, lone(30))
    assert not [1 for x, y, *_ in message.hidden if hypot(x, y) < 2.0]
    assert len([1 for x, y, *_ in message.points if abs(hypot(x, y) - 2.5) < 0.2]) > 20


FRONTAL = LaserSettings(name="front", field_of_view=pi)
REAR = LaserSettings(name="rear", mount=(-0.1, 0.0, pi), field_of_view=pi)
EMPTY = replace(PILLAR, obstacles=())


def test_what_only_a_source_sees_that_is_off_is_hidden_and_its_silence_is_nothing() -> None:
    both = reported(PerceptionSettings(), EMPTY, FRONTAL, REAR)
    one = reported(PerceptionSettings(sources={"rear": SourceSettings(use=False)}), EMPTY, FRONTAL, REAR)
    alongside = ((-1.0, -1.0), (-0.2, 1.0))
    assert not middles(both.hidden, *alongside)
    assert middles(one.hidden, *alongside)
    assert [x for x, *_ in both.points if x < -2.5]
    assert not [x for x, *_ in one.points if x < -2.5]
    assert one.problems == ()
    assert len(one.ages) == 2
    assert one.ages[1] == one.ages[0] > 0.0, "the report is as old as what the others saw"


def test_without_any_source_the_filter_brakes() -> None:
    message = reported(PerceptionSettings(sources={"laser": SourceSettings(use=False)}))
    assert message.problems == ("all sources are switched off: laser",)
    assert message.ages == (-1.0,)
    model = load_model("car")
    node = PerceptionNode(PerceptionSettings(sources={"laser": SourceSettings(use=False)}))
    safe = SafetyFilterNode(model, settings_named("car"), margin_for(model))
    nodes = [AdaptationNode(model), node, PolicyNode(model, "goal_seeker"), safe]
    ticks = list(drive(car(replace(PILLAR, fixed_goals=((2.0, 1.0),))), nodes, 10))
    assert {tick.verdict.status for tick in ticks} == {"fallback"}
    assert "switched off" in ticks[-1].verdict.sentence


def test_a_source_has_a_time_out_of_its_own() -> None:
    silent = [lone(30)[0]]

    def problems(own: PerceptionSettings, after: float) -> tuple[str, ...]:
        node, state = PerceptionNode(own), car().state_message()
        node.hear("r", silent[0])
        for tick in range(round(after / 0.05) + 1):
            seen = node.step("r", replace(state, tick=tick, robot_time=0.05 * tick), {})[SURROUNDINGS]
        assert isinstance(seen, SurroundingsMessage)
        return seen.problems

    quick = PerceptionSettings(sources={"laser": SourceSettings(time_out=0.2)})
    assert problems(PerceptionSettings(), 0.3) == ()
    assert problems(quick, 0.3) == ("the source laser was silent for 0.30 s, its time-out is 0.2 s",)
    assert problems(quick, 0.2) == ()
    assert "its time-out is 0.5 s" in problems(PerceptionSettings(), 0.6)[0]


def test_a_closed_zone_that_the_robot_could_never_leave_is_refused() -> None:
    with pytest.raises(InputError, match="never get out"):
        replace(DOCK, kind="closed", frame="robot")
