"""The filter on what sensors see: passive safety, what it does when a source fails, and what it leaves as it was."""

from dataclasses import replace
from itertools import pairwise
from math import hypot

import numpy as np
import pytest
from tests.safety.node_steps import asked, latent_at, surroundings

from safedpa.bus import SURROUNDINGS, Stale, StateMessage, SurroundingsMessage
from safedpa.bus.messages.messages import VerdictMessage
from safedpa.dynamics import fingerprint, load_model
from safedpa.operations import FLOATS
from safedpa.perception import PerceptionNode
from safedpa.robots.car.barriers.body import TrailerEnvelope
from safedpa.robots.car.barriers.moving_obstacles import MovingObstacleBarrier
from safedpa.robots.car.barriers.obstacles import ObstacleBarrier, braking_of
from safedpa.robots.car.barriers.pruning import irrelevance_distance
from safedpa.robots.car.dynamics.limits import (
    IS_STATIONARY,
    ORDINARY,
    PerformanceLimits,
    ReversalBraking,
    performance_limits,
)
from safedpa.robots.car.scenes.sensed import reversal_braking, sensed_barriers
from safedpa.runtime.calibrated_model import CalibratedModel
from safedpa.runtime.node import SafetyFilterNode
from safedpa.runtime.robot_session import RobotSession
from safedpa.runtime.scene import scene_of
from safedpa.safety.barriers.stack import CompiledBarrierSet
from safedpa.safety.barriers.stopping import Braking
from safedpa.safety.defaults import margin_for, settings_named
from safedpa_sim.closed_loop import drive
from safedpa_sim.robots.car.loads import load_named
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene
from safedpa_sim.robots.car.world import CarWorld
from safedpa_sim.sensing import Laser, LaserSettings, Person, StepsOut, Walks
from safedpa_sim.sensing.sensor_inputs import SimulatedSensors
from safedpa_sim.sensing.shapes import box

SETTINGS = settings_named("car")
BRAKING = Braking(2.0, 2.5)
BODY = (0.08, 0.40, 0.17)
MODEL = load_model("car")


COUNTER = ReversalBraking(2.0, 2.5, 0.6)


def barrier(discs: object, hidden: bool = False, towed: TrailerEnvelope | None = None, period: float = 0.0):
    table = np.array(discs, dtype=np.float64)
    return MovingObstacleBarrier(table, [hidden] * len(table), BODY, BRAKING, COUNTER, 0.0, period, towed=towed)


def states(count: int, seed: int) -> np.ndarray:
    draw = np.random.default_rng(seed)
    return np.column_stack(
        [
            draw.uniform(-2, 2, count),
            draw.uniform(-2, 2, count),
            draw.uniform(-4, 4, count),
            draw.uniform(-0.6, 2.0, count),
        ]
    )


def test_for_static_objects_the_barrier_asks_no_more_than_the_obstacle_barrier() -> None:
    """The same room at rest; in motion no less, since who brakes harder comes to stand earlier."""
    places = np.random.default_rng(1).uniform(-3, 3, (20, 2))
    exact = ObstacleBarrier(np.column_stack([places, np.full(20, 0.2)]), BODY, BRAKING)
    sensed = barrier([(x, y, 0.2, 0.0) for x, y in places.tolist()])
    for state in states(200, 2):
        assert (sensed.h(state) >= exact.h(state) - 1e-9).all()
        state[3] = 0.0
        np.testing.assert_allclose(sensed.h(state), exact.h(state), atol=1e-12)


def braked(speed: float, seconds: float) -> float:
    """What is left of a speed after the braking that ``ReversalBraking`` guarantees."""
    return max(abs(speed) - seconds * min(2.5 * (abs(speed) + 0.6), 2.0), 0.0) * float(np.sign(speed))


@pytest.mark.parametrize("towed", [None, TrailerEnvelope(0.1, 0.5, 0.2, 0.15, (0.0, 0.0, 0.0))])
def test_braking_never_lowers_h_whatever_moves_as_fast_as_it_may(towed: TrailerEnvelope | None) -> None:
    """Discs head straight for the car at their speed; the car brakes as it is guaranteed to."""
    draw = np.random.default_rng(3)
    for state in states(150, 4):
        if towed is not None:
            state[:3] = draw.uniform(-0.01, 0.01, 3)  # the distance backwards is given for this place
        discs = np.column_stack([draw.uniform(-4, 4, (30, 2)), np.full(30, 0.1), draw.uniform(0.0, 1.5, 30)])
        before = barrier(discs, towed=towed).h(state)
        x, y, yaw, speed = state.tolist()
        for _ in range(40):
            speed = braked(speed, 0.00125)
            x, y = x + 0.00125 * speed * np.cos(yaw), y + 0.00125 * speed * np.sin(yaw)
        after = np.array((x, y, yaw, speed))
        stood = discs.copy()
        way = np.array((x, y)) - discs[:, :2]
        stood[:, :2] += 0.05 * discs[:, 3:] * way / np.hypot(*way.T)[:, np.newaxis]
        later = barrier(stood, towed=towed).h(after)
        assert abs(speed) < IS_STATIONARY or (later >= before - 5e-3).all()  # who stands may be touched
        hoped = barrier(discs, towed=towed, period=0.05).h(after)
        assert (hoped <= later + 5e-3).all()


def test_time_and_distance_to_stop_are_no_less_than_guaranteed_braking_takes() -> None:
    for speed in (0.05, 0.3, 0.8, 1.4, 2.0, -0.5):
        v, seconds, way = speed, 0.0, 0.0
        while abs(v) > IS_STATIONARY:
            v, seconds = braked(v, 1e-5), seconds + 1e-5
            way += 1e-5 * abs(v)
        late = 0.05 * min(abs(speed) / IS_STATIONARY, 1.0)
        reported = float(COUNTER.seconds(speed, COUNTER.numbers, FLOATS))
        assert seconds + late - 1e-4 <= reported <= 1.1 * seconds + late + 1e-4
        assert way + 0.05 * abs(speed) <= abs(COUNTER.distance(speed, COUNTER.numbers, FLOATS)) + 1e-4


@pytest.mark.parametrize("load", ["none", "box", "chair", "large_chair"])
@pytest.mark.parametrize("speed", [0.3, 0.6, 1.0, 1.5, 1.9, -0.5])
def test_the_simulated_car_stops_within_the_promised_time(load: str, speed: float) -> None:
    """With every load, straight and turning, driving steadily and just speeding up; the settings' own numbers."""
    counter = reversal_braking(SETTINGS)
    for steer in (0.0, 0.34):
        for nominal_speed in (speed, np.copysign(2.0, speed)):
            world = CarWorld((0.0, 0.0, 0.0), (-60.0, 60.0, -60.0, 60.0), (), load_named(load))
            for _ in range(60 if nominal_speed == speed else 12):
                world.advance(nominal_speed, steer, 0.05)
                if nominal_speed != speed and abs(world.state[3]) >= abs(speed):
                    break
            began, taken, way = world.state[3], 0.0, 0.0
            while abs(world.state[3]) > IS_STATIONARY:
                command = float(counter.action(np.array(world.state), 0.05)[0])
                for _ in range(20):
                    x, y, _, v = world.state
                    if abs(v) <= IS_STATIONARY:
                        break
                    world.advance(command, 0.0, 0.0025)
                    taken, way = taken + 0.0025, way + float(np.hypot(world.state[0] - x, world.state[1] - y))
            assert taken <= float(counter.seconds(began, counter.numbers, FLOATS)) + 0.0025
            assert way <= abs(float(counter.distance(began, counter.numbers, FLOATS))) + 0.0025
            for _ in range(10):  # and goes on standing
                world.advance(float(counter.action(np.array(world.state), 0.05)[0]), 0.0, 0.05)
                assert abs(world.state[3]) < IS_STATIONARY


def test_a_car_with_a_throttle_has_no_speed_of_reversed_sign() -> None:
    """-1 is its full throttle, no speed: what it is promised is the braking that its own backup does."""
    throttled = settings_named("car_throttle")
    counter = reversal_braking(throttled, servo=False)
    assert counter.against == 0.0
    seen = surroundings(state_of(), movers=((3.0, 0.0, 0.05, 0.0, 0.0, 1.5),))
    model = load_model("dart_car")
    scene = scene_of(model, throttled)
    state = replace(state_of(), values=(0.0, 0.0, 0.0, 0.8), sources=("laser",))
    found = scene.around(state, seen)
    assert not isinstance(found, str)
    mover = next(part for part in found.parts if isinstance(part, MovingObstacleBarrier))
    assert mover.shared[4:7] == pytest.approx((counter.numbers[1], counter.numbers[2], counter.numbers[0]))
    assert scene.backup is not None
    assert -1.0 < scene.backup(np.array(state.values))[0] < 0.0


def test_its_slopes_are_those_of_its_values_and_within_their_bound() -> None:
    sensed = barrier([(1.0, 0.5, 0.2, 1.5), (-1.0, 1.0, 0.1, 0.0), (0.3, -1.2, 0.3, 0.7)])
    bound = np.array(CompiledBarrierSet([sensed]).grad_bound([0.0, 0.0, 0.0, 2.0]))
    for state in states(50, 6):
        _, gradient = sensed.h_and_grad(state)
        assert (np.abs(gradient) <= bound + 1e-9).all()
        for entry in range(4):
            nudge = np.zeros(4)
            nudge[entry] = 1e-6
            slope = (sensed.h(state + nudge) - sensed.h(state - nudge)) / 2e-6
            assert np.abs(slope - gradient[:, entry]).max() < 1e-4


@pytest.mark.parametrize("against", [0.0, 0.3, 0.6])
@pytest.mark.parametrize(("deceleration", "gain"), [(2.0, 2.5), (1.0, 1.0), (4.0, 2.5)])
def test_no_slope_exceeds_the_bound_however_the_car_brakes(against: float, deceleration: float, gain: float) -> None:
    """A car with a throttle needs a longer way than its segment of what is stationary has."""
    draw = np.random.default_rng(7)
    discs = np.column_stack([draw.uniform(-4, 4, (60, 2)), np.full(60, 0.1), draw.uniform(0.0, 1.5, 60)])
    counter = ReversalBraking(deceleration, gain, against)
    sensed = MovingObstacleBarrier(discs, [False] * 60, BODY, Braking(deceleration, gain), counter)
    stack = CompiledBarrierSet([sensed])
    for state in states(100, 8):
        bound = np.array(stack.grad_bound(state.tolist()))
        assert (np.abs(stack.grad_h(state)) <= bound + 1e-9).all()


def decided(seen: SurroundingsMessage | Stale | None, speed: float = 1.0, nominal: float = 1.0) -> VerdictMessage:
    """One tick of the real node at the origin, driving east."""
    robot = CarRobot(
        Scene(0, None, (-9.0, 9.0, -9.0, 9.0), (), (0.0, 0.0, 0.0)),
        sensor_inputs=SimulatedSensors((Laser(LaserSettings()),)),
    )
    state = replace(robot.state_message(), values=(0.0, 0.0, 0.0, speed))
    node = SafetyFilterNode(MODEL, SETTINGS, margin_for(MODEL))
    return asked(node, state, latent_at(state), (nominal, 0.0), seen or surroundings(state))


def state_of() -> StateMessage:
    return CarRobot(Scene(0, None, (-9.0, 9.0, -9.0, 9.0), (), (0.0, 0.0, 0.0))).state_message()


def test_the_nominal_action_passes_where_nothing_is_near_and_a_point_ahead_is_kept_away_from() -> None:
    assert decided(None).status == "passed"
    verdict = decided(surroundings(state_of(), points=((1.05, 0.0, 0.05),)))
    assert verdict.status == "corrected"
    assert verdict.active == ("point 0",)
    assert verdict.action[0] < 1.0


def test_what_moves_needs_more_room_than_what_is_at_rest_and_what_hides_behind_the_car_holds_it_not() -> None:
    place = (1.6, 0.0, 0.05)
    assert decided(surroundings(state_of(), points=(place,))).status == "passed"
    assert decided(surroundings(state_of(), movers=((*place, 0.0, 0.0, 1.5),))).status == "corrected"
    assert decided(surroundings(state_of(), movers=((1.2, 0.0, 0.05, 0.0, 0.0, 1.5),))).status == "stopped"
    assert decided(surroundings(state_of(), hidden=((*place, 1.5),))).status != "passed"
    behind = ((-0.9, 0.0, 0.3, 1.5),)
    assert decided(surroundings(state_of(), hidden=behind)).status == "passed"
    assert decided(surroundings(state_of(), hidden=behind), speed=-0.5, nominal=-0.5).status != "passed"


def test_a_person_who_may_touch_the_car_before_it_stops_is_reported_and_the_car_brakes() -> None:
    verdict = decided(surroundings(state_of(), movers=((1.0, 0.3, 0.1, 0.0, 0.0, 1.5),)))
    assert verdict.status == "stopped"
    assert "mover 0 may reach the robot before it stops" in verdict.sentence
    assert verdict.action == (-0.6, 0.0), "as hard as it can"


@pytest.mark.parametrize(
    ("seen", "notice"),
    [
        (Stale(SURROUNDINGS, None), "no surroundings has arrived"),
        (Stale(SURROUNDINGS, 4), "4 ticks old"),
        (surroundings(state_of(), problems=("the source laser is frozen",)), "laser is frozen"),
        (surroundings(state_of(), ages=()), "ages of 0 sources"),
        (surroundings(state_of(), movers=((1.0, 2.0, 0.1),)), "movers"),
        (surroundings(state_of(), points=((1.0, 2.0, -0.1),)), "below 0"),
    ],
)
def test_without_believable_surroundings_the_car_brakes_and_reports_why(seen: SurroundingsMessage | Stale, notice: str):
    verdict = decided(seen)
    assert verdict.status == "fallback"
    assert verdict.action == (-0.6, 0.0), "as hard as it can"
    assert notice in verdict.sentence


def of_some_kind(discs: np.ndarray, towed: TrailerEnvelope | None) -> list[ObstacleBarrier | MovingObstacleBarrier]:
    counter, braking = reversal_braking(SETTINGS), braking_of(SETTINGS)
    movers = np.column_stack([discs, np.full(len(discs), 1.5)])
    return [
        ObstacleBarrier(discs, BODY, braking, towed=towed),
        MovingObstacleBarrier(movers, [False] * len(discs), BODY, braking, counter, 0.0, 0.05, towed=towed),
    ]


@pytest.mark.long
@pytest.mark.parametrize("late", [0, 1, 4])
@pytest.mark.parametrize("name", ["car", "car_measured", "car_learned"])
def test_no_action_breaks_a_condition_of_what_is_left_out_as_far(name: str, late: int) -> None:
    """Every action of one period, from where it begins to act: h of what is as far as that satisfies its condition."""
    draw, model, left_out = np.random.default_rng(9), load_model(name).with_period(0.05), 0
    quick = performance_limits(model, SETTINGS)
    farthest = 12.0 if name != "car_learned" else 60.0  # with latents at their ends it is three times as quick
    ends = [(model.parameters[one].low, model.parameters[one].high) for one in model.latent_names]
    for number, state in enumerate(states(60, 10)):
        towed = TrailerEnvelope(0.1, 0.5, 0.2, 0.15, (0.0, 0.0, 0.0)) if number % 3 == 0 else None
        latent = np.array([draw.choice(end) for end in ends])
        distance, angle = draw.uniform(0.5, farthest, 60), draw.uniform(-np.pi, np.pi, 60)
        places = state[:2] + distance[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        reported = replace(state_of(), values=tuple(state.tolist()))
        for barrier in of_some_kind(np.column_stack([places, np.full(60, 0.1)]), towed):
            far = irrelevance_distance(barrier, reported, SETTINGS.eta, 0.1, 0.05 * late, quick)
            rows = barrier.h(state) >= far
            left_out += int(rows.sum())
            for action in ((2.0, 0.34), (-0.6, -0.34), (2.0, -0.34), (-0.6, 0.34), (0.0, 0.0)):
                begin = state
                for _ in range(late):
                    begin = model.step(begin, np.array(draw.choice(((2.0, 0.34), (-0.6, -0.34)))), latent)
                before, after = barrier.h(begin), barrier.h(model.step(begin, np.array(action), latent))
                wanted = np.full(60, 0.2) if barrier.at_once else (1.0 - SETTINGS.eta) * before + 0.2
                assert (after[rows] >= wanted[rows]).all()
    assert left_out > 100


@pytest.mark.parametrize("coming", [1.5, 4.0])
def test_no_turn_brings_a_hiding_place_before_the_car_that_was_left_out_as_far(coming: float) -> None:
    """Behind the car paths of hidden people do not count, next to it all do: h falls by more than by moving."""
    draw, counter, left_out = np.random.default_rng(12), reversal_braking(SETTINGS), 0
    model, clearance = MODEL.with_period(0.05), SETTINGS.barrier("clearance")
    for state in states(60, 11):
        reported = replace(state_of(), values=tuple(state.tolist()))
        distance, aside = draw.uniform(0.5, 6.0, 60), draw.choice((-1.0, 1.0), 60) * draw.uniform(1.5, 1.9, 60)
        aside += state[2]
        places = state[:2] + distance[:, None] * np.column_stack([np.cos(aside), np.sin(aside)])
        discs = np.column_stack([places, np.full(60, 0.2), np.full(60, coming)])
        seen = surroundings(reported, hidden=tuple(map(tuple, discs.tolist())))
        found = sensed_barriers(SETTINGS, counter, reported, seen, None, {"mover": 0.03})
        rows = np.array([f"hidden {row}" not in found.barriers.names for row in range(60)])
        left_out += int(rows.sum())
        every = MovingObstacleBarrier(
            discs, [True] * 60, reported.footprint, braking_of(SETTINGS), counter, clearance, 0.05
        )
        for action in ((2.0, 0.34), (-0.6, -0.34), (2.0, -0.34), (-0.6, 0.34), (0.0, 0.0)):
            after = every.h(model.step(state, np.array(action)))
            assert (after[rows] >= 0.03).all()
    assert left_out > 100


def test_what_a_margin_that_widens_at_once_makes_near_is_looked_at_in_the_same_tick() -> None:
    """Five times the car is 0.3 m nearer than was predicted: then the margin is several times as wide."""
    robot = RobotSession.create(CalibratedModel(MODEL, fingerprint(MODEL), margin_for(MODEL)), SETTINGS)
    places = tuple((0.7 + 0.05 * k, 0.0, 0.1) for k in range(60))
    movers, widths = tuple((*place, 0.0, 0.0, 0.0) for place in places), []
    for tick in range(8):
        first = state_of()
        state = replace(first, tick=tick, robot_time=0.05 * tick, sources=("laser",), obstacles=(), applied_by="filter")
        seen = surroundings(state, points=places, movers=movers)
        robot.observe_state(state)
        robot.margin.expect((-0.3, 0.0, 0.0, 0.0))
        robot.observe_surroundings(state, seen)
        assert not isinstance(robot.barriers, str)
        wanted = sensed_barriers(SETTINGS, reversal_braking(SETTINGS), state, seen, None, robot.margin.epsilon)
        assert robot.barriers.names == wanted.barriers.names
        widths.append(robot.margin.epsilon["obstacle"])
    assert max(after / before for before, after in pairwise(widths)) > 2.0


def test_what_is_far_is_nearer_for_a_slow_car_and_farther_where_its_action_acts_late() -> None:
    (still, _) = of_some_kind(np.array([[3.0, 0.0, 0.1]]), None)
    reported = [replace(state_of(), values=(0.0, 0.0, 0.0, speed)) for speed in (0.0, 1.0, -1.0)]
    slow, quick, backwards = (irrelevance_distance(still, one, SETTINGS.eta, 0.03, 0.0, ORDINARY) for one in reported)
    assert (
        irrelevance_distance(still, reported[0], SETTINGS.eta, 0.03, 0.0, PerformanceLimits(np.inf, np.inf, np.inf))
        == np.inf
    )
    assert slow < backwards == quick < irrelevance_distance(still, reported[1], SETTINGS.eta, 0.03, 0.1, ORDINARY)


def driven(scene: Scene, people: tuple[Person, ...], seconds: float, seed: int = 1) -> CarRobot:
    """The real nodes, the laser alone; the nominal action is full speed ahead."""
    from safedpa.adaptation import AdaptationNode
    from safedpa.policy import PolicyNode

    robot = CarRobot(scene, sensor_inputs=SimulatedSensors((Laser(LaserSettings(), seed),), people))
    nodes = [
        AdaptationNode(MODEL),
        PerceptionNode(),
        PolicyNode(MODEL, "goal_seeker"),
        SafetyFilterNode(MODEL, SETTINGS, margin_for(MODEL)),
    ]
    for _ in drive(robot, nodes, round(seconds / 0.05)):
        pass
    return robot


@pytest.mark.long
def test_with_the_laser_alone_it_reaches_a_goal_and_touches_nothing() -> None:
    scene = Scene(0, None, (-4.0, 4.0, -3.0, 3.0), ((0.0, 1.5, 0.3),), (-3.0, 0.0, 0.0), ((2.5, 0.0), (-2.5, 0.0)))
    robot = driven(scene, (), 20.0)
    assert robot.goals_reached >= 1
    assert not robot.collisions


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_car_stops_for_a_person_who_steps_out_from_behind_a_box(seed: int) -> None:
    draw = np.random.default_rng(seed)
    x = float(draw.uniform(0.0, 1.0))
    scene = Scene(
        0, None, (-4.0, 4.0, -3.0, 3.0), (), (-3.0, 0.0, 0.0), ((3.2, 0.0),), polygons=(box(x, 1.0, 0.9, 0.6),)
    )
    person = (
        StepsOut((x, 1.6), (x, -2.0), 1.5, 9.0) if seed == 3 else StepsOut((x + 0.8, 1.6), (x + 0.8, 0.0), 1.5, 1.4)
    )
    robot = driven(scene, (person,), 12.0, seed)
    assert person.stepped
    assert all(hit.speed < IS_STATIONARY for hit in robot.collisions), [str(hit) for hit in robot.collisions]


@pytest.mark.long
def test_among_people_the_car_never_moves_into_a_person() -> None:
    people = tuple(Walks(place, 1.2, index) for index, place in enumerate(((2.0, 2.0), (2.0, -2.0), (0.0, 2.0))))
    scene = Scene(0, None, (-4.0, 4.0, -3.0, 3.0), (), (-3.0, 0.0, 0.0), ((3.0, 0.0), (-3.0, 0.0)))
    robot = driven(scene, people, 20.0)
    assert all(hit.speed < IS_STATIONARY for hit in robot.collisions), [str(hit) for hit in robot.collisions]
    assert hypot(robot.values[0] + 3.0, robot.values[1]) > 0.2
