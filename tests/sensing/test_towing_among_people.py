"""Cars among people and each other: who comes near is not forgotten, and no one shoves anybody."""

from functools import cache
from itertools import pairwise
from math import hypot, pi

import numpy as np
import pytest

from safedpa.adaptation import AdaptationNode
from safedpa.bus import SURROUNDINGS, AbstractNode, StateMessage, SurroundingsMessage
from safedpa.bus.messages.messages import ActionMessage
from safedpa.dynamics import PhysicsModel, load_model
from safedpa.perception import PerceptionNode, PerceptionSettings
from safedpa.policy import PolicyNode
from safedpa.robots.car.barriers.body import TrailerEnvelope
from safedpa.robots.car.barriers.moving_obstacles import MovingObstacleBarrier
from safedpa.robots.car.dynamics.limits import IS_STATIONARY, ReversalBraking
from safedpa.robots.car.scenes.perceived import CarScene
from safedpa.robots.car.scenes.sensed import reversal_braking, sensed_barriers
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety.barriers.stopping import Braking
from safedpa.safety.defaults import margin_for, settings_named
from safedpa_lab.experiments.sensing.nodes import NoFilter
from safedpa_sim.closed_loop import drive, drive_together
from safedpa_sim.robots.car.loads import LOADS, footprint, load_named, towed_reach
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene
from safedpa_sim.robots.car.shared_field import SharedField
from safedpa_sim.sensing import Laser, LaserSettings, Person
from safedpa_sim.sensing.sensor_inputs import SimulatedSensors
from safedpa_sim.sensing.shapes import Outline, Point

SETTINGS = settings_named("car")
BRAKING, COUNTER = Braking(2.0, 2.5), ReversalBraking(2.0, 2.5, 0.6)
FIELD = (-4.0, 4.0, -4.0, 4.0)


PERSON = 0.2
"""m; radius."""
Reported = list[tuple[CarRobot, StateMessage, SurroundingsMessage, Person]]


class GoesTo(Person):
    """Walks to a place at ``pace`` [m/s], stands there until ``leaves`` [s], and walks back."""

    def __init__(self, place: Point, towards: Point, leaves: float = 60.0, pace: float = 1.2) -> None:
        super().__init__(place)
        self._from, self._towards, self._leaves, self._pace = place, towards, leaves, pace

    def velocity(self, time: float, robot: Point, outline: Outline) -> Point:
        del robot, outline
        target = self._towards if 1.0 < time < self._leaves else self._from
        x, y = target[0] - self.position[0], target[1] - self.position[1]
        far = hypot(x, y)
        speed = min(self._pace, far / 0.05)
        return (speed * x / far, speed * y / far) if far > 1e-6 else (0.0, 0.0)


def stands_by(load: str, person: Person, seconds: float) -> Reported:
    """A stationary car with its load, and what its laser sees."""
    scene = Scene(0, load_named(load), FIELD, (), (0.0, 0.0, 0.0))
    robot = CarRobot(scene, sensor_inputs=SimulatedSensors((Laser(LaserSettings(), 1),), (person,)))
    node, reported = PerceptionNode(), Reported()
    for tick in range(round(seconds / 0.05)):
        state = robot.state_message()
        for scan in robot.scans():
            node.hear("r", scan)
        message = node.step("r", state, {})[SURROUNDINGS]
        assert isinstance(message, SurroundingsMessage)
        reported.append((robot, state, message, person))
        robot.receive(ActionMessage(epoch=1, tick=tick, robot_time=0.0, publish_time=0.0, values=(0.0, 0.0)))
        robot.advance()
    return reported


def yields(state: StateMessage, seen: SurroundingsMessage) -> bool:
    scene = CarScene(SETTINGS)
    scene.follow(state)
    return bool(sensed_barriers(SETTINGS, reversal_braking(SETTINGS), state, seen, scene.way.reach(state)).yields_to)


@pytest.mark.parametrize("load", ["box", "chair", "large_chair"])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_car_waits_while_a_person_stands_at_its_load(load: str, side: float) -> None:
    """He comes from aside, seen all the way, and none of the rays that end within reach of the load is believed."""
    known = LOADS[load]
    place = (-0.08 - known.length, side * (known.side / 2 + PERSON + 0.02))
    person = GoesTo((place[0], 2.5 * side), place)
    reported = stands_by(load, person, 7.0)
    for _, state, seen, _ in reported:
        if state.robot_time > 3.2:
            assert yields(state, seen), f"at {state.robot_time:.2f} s the person at the load is not reported"


@pytest.mark.long
@pytest.mark.parametrize("load", ["box", "chair", "large_chair"])
@pytest.mark.parametrize("start", [(1.2, -1.6), (1.2, 1.6), (0.6, -2.0), (-1.0, 2.0)])
@pytest.mark.parametrize("pace", [0.4, 0.65, 1.0, 1.5])
def test_a_person_who_goes_in_next_to_the_load_is_reported_though_a_ray_passes_their_last_position(load, start, pace):
    place = (-0.26, 0.26 if start[1] > 0.0 else -0.26)
    there = 1.0 + hypot(start[0] - place[0], start[1] - place[1]) / pace
    reported = stands_by(load, GoesTo(start, place, pace=pace), there + 1.5)
    for _, state, seen, _ in reported:
        if state.robot_time > there:
            assert yields(state, seen), f"at {state.robot_time:.2f} s the person at the load is not reported"


@pytest.mark.parametrize("load", ["chair", "large_chair"])
@pytest.mark.parametrize("start", [(-1.2, 2.0), (-1.5, 1.8), (-1.2, -2.0), (-1.5, -1.8)])
def test_a_person_who_goes_into_the_shadow_of_the_load_is_reported_at_it(load: str, start: Point) -> None:
    """Before he counts as lost he is unseen for a quarter of a second, in which he goes 0.4 m."""
    place = (-0.38 - towed_reach(LOADS[load])[2], 0.0)
    there = 1.0 + hypot(start[0] - place[0], start[1] - place[1]) / 1.5
    for _, state, seen, _ in stands_by(load, GoesTo(start, place, pace=1.5), there + 1.0):
        assert state.robot_time < there or yields(state, seen), "neither seen nor assumed at the load"


def test_a_car_continues_after_a_person_left_its_load_and_a_far_person_is_not_assumed_at_it() -> None:
    known = LOADS["box"]
    place = (-0.08 - known.length, known.side / 2 + PERSON + 0.02)
    reported = stands_by("box", GoesTo((place[0], 2.5), place, leaves=4.0), 6.5 + PerceptionSettings().restless)
    _, state, seen, _ = reported[-1]
    assert not yields(state, seen)
    reported = stands_by("chair", GoesTo((2.5, 2.0), (2.5, -2.0)), 5.0)
    assert not any(yields(state, seen) for _, state, seen, _ in reported)


def barrier(load: str, discs: object, hidden: bool, way: float = 0.0) -> MovingObstacleBarrier:
    known = load_named(load)
    begin, end, reach = towed_reach(known)
    body = footprint(known)
    table = np.array(discs, dtype=np.float64)
    towed = TrailerEnvelope(begin, end, reach - body[2], way, (0.0, 0.0, 0.0))
    return MovingObstacleBarrier(table, [hidden] * len(table), body, BRAKING, COUNTER, 0.0, 0.0, towed=towed)


@pytest.mark.parametrize("load", list(LOADS))
@pytest.mark.parametrize("way", [0.0, 0.3, 1.0])
def test_h_of_a_person_who_may_touch_the_load_is_below_0_however_little_was_driven_back(load: str, way: float) -> None:
    """Who may move can come between car and load, and is swept away when it is pulled on."""
    _, _, reach = towed_reach(load_named(load))
    angle = np.linspace(-np.pi, np.pi, 40)
    for room, below in ((-0.01, True), (0.01, False)):
        far = reach + PERSON + room
        discs = [(-0.08 + far * np.cos(a), far * np.sin(a), PERSON, 1.5) for a in angle if np.cos(a) < 0.0]
        h = barrier(load, discs, False, way).h(np.zeros(4))
        assert ((h < 0.0) == below).all()


@pytest.mark.parametrize("load", list(LOADS))
def test_the_shadow_of_the_load_holds_no_car_that_drives_away_from_it(load: str) -> None:
    """The room behind the load is unseen, and as near as can be: forwards it is left, backwards it counts."""
    _, _, reach = towed_reach(load_named(load))
    shadow = [(-0.08 - reach - 0.1, across, 0.27, 1.5) for across in (-0.3, 0.0, 0.3)]
    for speed in (0.0, -1e-9, 0.3, 1.0):
        assert (barrier(load, shadow, True).h(np.array((0.0, 0.0, 0.0, speed))) > 0.1).all()
    assert (barrier(load, shadow, True).h(np.array((0.0, 0.0, 0.0, -0.1))) < 0.0).all()
    seen = barrier(load, shadow, False).h(np.array((0.0, 0.0, 0.0, 0.3)))
    assert (seen < 0.0).all(), "who is seen there may come"


@pytest.mark.long
@pytest.mark.parametrize("load", list(LOADS))
def test_a_car_tows_through_an_empty_hall_without_going_on_and_off(load: str) -> None:
    """Unseen room behind the load is no reason to brake as soon as it moves, and to drive off as soon as not."""
    model = load_model("car")
    scene = Scene(0, load_named(load), FIELD, (), (-2.5, 0.0, 0.0), ((2.5, 0.0),))
    robot = CarRobot(scene, sensor_inputs=SimulatedSensors((Laser(LaserSettings(), 1),)))
    nodes = [
        AdaptationNode(model),
        PerceptionNode(),
        PolicyNode(model, "goal_seeker"),
        SafetyFilterNode(model, SETTINGS, margin_for(model)),
    ]
    moving = []
    for tick in drive(robot, nodes, 80):
        moving.append(abs(tick.state.values[3]) > IS_STATIONARY)
        assert not (moving[-1] and tick.verdict.status in ("violated", "stopped"))
    assert sum(one != other for one, other in pairwise(moving)) == 1
    assert robot.values[0] > -1.0
    assert not robot.collisions


class Pushes(Person):
    """Goes on towards a position at 1.5 m/s, whatever is in the way."""

    def __init__(self, place: Point, towards: Point) -> None:
        super().__init__(place)
        self._towards = towards
        self.reported = 0

    def touched(self, time: float) -> None:
        del time
        self.reported += 1

    def velocity(self, time: float, robot: Point, outline: Outline) -> Point:
        del time, robot, outline
        x, y = self._towards[0] - self.position[0], self._towards[1] - self.position[1]
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
    robot = CarRobot(scene, sensor_inputs=SimulatedSensors((Laser(LaserSettings(), 1),), (person,)))
    pose = robot.world.towed.pose[:2] if robot.world.towed else (0.0, 0.0)
    for tick in range(60):
        robot.receive(ActionMessage(epoch=1, tick=tick, robot_time=0.0, publish_time=0.0, values=(0.0, 0.0)))
        robot.advance()
        assert hypot(*robot.values[:2]) < 0.01
        after = robot.world.towed.pose[:2] if robot.world.towed else (0.0, 0.0)
        assert hypot(after[0] - pose[0], after[1] - pose[1]) < 0.02
    assert person.reported > 10
    assert robot.collisions[0].part == ("car" if load == "none" else "load")
    assert all(hit.speed < 0.01 for hit in robot.collisions)


SEEN = PerceptionSettings(fastest=2.0, coming=2.0, slimmest=0.12)


@cache
def model() -> PhysicsModel:
    return load_model("car")


def facing(apart: float) -> SharedField:
    half = apart / 2
    scenes = (
        Scene(1, None, FIELD, (), (-half, 0.0, 0.0), ((3.2, 0.0), (-3.2, 0.0))),
        Scene(2, None, FIELD, (), (half, 0.03, pi), ((-3.2, 0.0), (3.2, 0.0))),
    )
    return SharedField(
        [CarRobot(one, sensor_inputs=SimulatedSensors((Laser(LaserSettings(), one.seed),))) for one in scenes]
    )


def nodes(guard: AbstractNode) -> list[AbstractNode]:
    return [AdaptationNode(model()), PerceptionNode(SEEN), PolicyNode(model(), "goal_seeker"), guard]


def met(apart: float, *, filtered: bool, seconds: float = 4.0) -> SharedField:
    field = facing(apart)
    guards = [
        SafetyFilterNode(model(), settings_named("car"), margin_for(model())) if filtered else NoFilter() for _ in "12"
    ]
    for _ in drive_together(field, [nodes(guard) for guard in guards], round(seconds / 0.05)):
        pass
    return field


@pytest.mark.long
@pytest.mark.parametrize("apart", [2.5, 5.0])
def test_head_on_they_touch_without_the_filter_and_with_it_do_not(apart: float) -> None:
    (touch,) = met(apart, filtered=False).touches[:1]
    assert min(touch.speeds) > 1.0
    retained = met(apart, filtered=True)
    assert [touch for touch in retained.touches if max(touch.speeds) >= IS_STATIONARY] == []
    assert all(abs(robot.values[0]) < apart / 2 + 0.5 for robot in retained.robots)


def test_each_is_a_mover_to_the_other() -> None:
    field, heard = facing(4.0), list[SurroundingsMessage]()

    class Hears(NoFilter):
        sensor_inputs = (SURROUNDINGS,)

        def step(self, robot, state, inputs):  # type: ignore[no-untyped-def]
            reported = inputs.get(SURROUNDINGS)
            if isinstance(reported, SurroundingsMessage):
                heard.append(reported)
            return super().step(robot, state, inputs)

    for _ in drive_together(field, [nodes(Hears()), nodes(NoFilter())], 16):
        pass
    other = field.robots[1].values
    nearest = min(abs(x - (other[0] - 0.4)) + abs(y - other[1]) for x, y, *_ in heard[-1].movers)
    assert nearest < 0.4
