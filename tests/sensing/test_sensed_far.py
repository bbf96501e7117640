"""What a car's sensors see, chosen in one pass; its load among what moves, and how it creeps."""

from dataclasses import replace
from math import inf, nan

import numpy as np
import pytest
from tests.safety.node_steps import surroundings

from safedpa.bus import StateMessage, SurroundingsMessage
from safedpa.dynamics import load_model
from safedpa.errors import InputError
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
from safedpa.robots.car.scenes.sensed import SensedBarriers, reversal_braking, sensed_barriers
from safedpa.safety.barriers.disc_selection import MOST_ROWS, below, discs_near, fastest_of, moving_near
from safedpa.safety.barriers.stack import CompiledBarrierSet
from safedpa.safety.barriers.stopping import Braking
from safedpa.safety.defaults import settings_named
from safedpa.safety.settings import FilterSettings
from safedpa_sim.robots.car.loads import LOADS, footprint, load_named, towed_reach
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene
from safedpa_sim.robots.car.world import CarWorld
from safedpa_sim.sensing import Laser
from safedpa_sim.sensing.laser import LaserSettings
from safedpa_sim.sensing.sensor_inputs import SimulatedSensors

SETTINGS = settings_named("car")
COUNTER, BRAKING, CLEARANCE = reversal_braking(SETTINGS), braking_of(SETTINGS), SETTINGS.barrier("clearance")
BODY = (0.08, 0.40, 0.17)
TOWED = TrailerEnvelope(0.1, 0.5, 0.2, 0.3, (0.0, 0.0, 0.0))


FOLDED = TrailerEnvelope(0.1, 0.5, 0.9, 0.5, (0.0, 0.0, 0.0))
"""A large load that was pushed back as far as it folds."""
MARGINS = {"obstacle": 0.02, "mover": 0.03}
POINTS, MOVERS, HIDDEN = 3, 6, 4
Rows = tuple[tuple[float, ...], ...]


def state_of(values: tuple[float, ...]) -> StateMessage:
    reported = CarRobot(Scene(0, None, (-9.0, 9.0, -9.0, 9.0), (), (0.0, 0.0, 0.0))).state_message()
    return replace(reported, values=values, footprint=BODY)


def seen_by(state: StateMessage, points: Rows = (), movers: Rows = (), hidden: Rows = ()) -> SurroundingsMessage:
    return surroundings(state, points=points, movers=movers, hidden=hidden)


def scene(draw: np.random.Generator, count: int) -> tuple[StateMessage, SurroundingsMessage]:
    """A car near the origin, and ``count`` discs of each kind up to 6 m around."""
    values = (*draw.uniform(-0.3, 0.3, 2), draw.uniform(-4.0, 4.0), draw.uniform(-0.6, 2.0))
    state = state_of(tuple(float(value) for value in values))

    def rows(*more: float) -> Rows:
        angle, distance = draw.uniform(-np.pi, np.pi, count), draw.uniform(0.2, 6.0, count)
        sizes = draw.uniform(0.0, 0.3, count)
        table = np.column_stack([distance * np.cos(angle), distance * np.sin(angle), sizes])
        return tuple((*row, *more) for row in table.tolist())

    return state, seen_by(state, rows(), rows(0.1, 0.0, 1.5), rows(0.9))


def every_height(state: StateMessage, seen: SurroundingsMessage, towed: TrailerEnvelope | None) -> dict[str, float]:
    """Of each disc the h that says whether it is near, less how large it has to be: below 0 it is."""
    still = ObstacleBarrier(np.reshape(seen.points, (-1, 3)), BODY, BRAKING, CLEARANCE, towed=towed)
    discs = [(x, y, radius, w) for x, y, radius, *_, w in (*seen.movers, *seen.hidden)]
    thick = {} if towed is None else {"towed": towed, "own_radius": SETTINGS.barrier("own_radius")}
    able = MovingObstacleBarrier(discs, [False] * len(discs), BODY, BRAKING, COUNTER, CLEARANCE, state.period, **thick)
    names = [f"point {row}" for row in range(len(seen.points))]
    names += [f"mover {row}" for row in range(len(seen.movers))]
    names += [f"hidden {row}" for row in range(len(seen.hidden))]
    found = []
    for barrier in (still, able):
        far = irrelevance_distance(barrier, state, SETTINGS.eta, MARGINS[barrier.kind], 0.0, ORDINARY)
        found += (barrier.h(np.array(state.values)) - far).tolist()
    return dict(zip(names, found, strict=True))


@pytest.mark.parametrize("towed", [None, TOWED, FOLDED])
@pytest.mark.parametrize("count", [1, 12, 30])
def test_all_that_is_near_is_looked_at_and_nothing_else(count: int, towed: TrailerEnvelope | None) -> None:
    draw, near, far = np.random.default_rng([4, count]), 0, 0
    for _ in range(60):
        state, seen = scene(draw, count)
        heights = every_height(state, seen, towed)
        found = sensed_barriers(SETTINGS, COUNTER, state, seen, towed, MARGINS)
        wanted = {name for name, height in heights.items() if height < 0.0}
        assert set(found.barriers.names) - {"highest speed", "lowest speed"} == wanted
        near, far = near + len(wanted), far + len(heights) - len(wanted)
    assert near > 20
    assert far > 20


def test_of_too_many_those_with_the_least_h_are_looked_at() -> None:
    draw = np.random.default_rng(6)
    state = state_of((0.0, 0.0, 0.3, 1.0))
    table = np.column_stack([draw.uniform(-1.5, 1.5, (300, 2)), np.full(300, 0.05)])
    found = sensed_barriers(SETTINGS, COUNTER, state, seen_by(state, tuple(map(tuple, table.tolist()))), None)
    still = ObstacleBarrier(table, BODY, BRAKING, CLEARANCE)
    speeds = (1.0, SETTINGS.barrier("speed_low"), SETTINGS.barrier("speed_high"))
    least = np.min([still.h(np.array((0.0, 0.0, 0.3, speed))) for speed in speeds], axis=0)
    wanted = sorted(np.argsort(least)[:MOST_ROWS].tolist())
    assert found.barriers.parts[0].names == tuple(f"point {row}" for row in wanted)
    assert found.left_out.startswith("Of ")


def test_only_the_discs_that_count_give_barriers() -> None:
    state = state_of((0.0, 0.0, 0.0, 0.5))
    near, away = (1.2, 0.2, 0.1, 0.0, 0.0, 0.5), (30.0, 0.0, 0.1, 0.0, 0.0, 1.5)
    found = sensed_barriers(SETTINGS, COUNTER, state, seen_by(state, ((0.9, 0.5, 0.1),), (away, near)), None)
    creeps, own = SETTINGS.barrier("creeping"), SETTINGS.barrier("own_radius")
    known = BODY, BRAKING, COUNTER, CLEARANCE, state.period
    able = MovingObstacleBarrier([(1.2, 0.2, 0.1, 0.5)], [False], *known, ["mover 1"], creeps=creeps, own_radius=own)
    still = ObstacleBarrier([(0.9, 0.5, 0.1)], BODY, BRAKING, CLEARANCE, ["point 0"])
    for one, wanted in zip(found.barriers.parts[:2], (still, able), strict=True):
        assert (one.names, one.shared, one.each) == (wanted.names, wanted.shared, wanted.each)


@pytest.mark.parametrize(("speed", "reported"), [(0.1, ""), (0.11, "an unseen person may")])
def test_only_a_moving_car_yields_to_hidden_people(speed: float, reported: str) -> None:
    state, place = state_of((0.0, 0.0, 0.0, speed)), (0.6, 0.0, 0.1)
    assert sensed_barriers(SETTINGS, COUNTER, state, seen_by(state), None).yields_to == ""
    hidden = sensed_barriers(SETTINGS, COUNTER, state, seen_by(state, hidden=((*place, 1.5),)), None)
    assert hidden.yields_to.startswith(reported)
    assert bool(hidden.yields_to) is bool(reported)
    away, near = (30.0, 0.0, 0.1, 0.0, 0.0, 1.5), (*place, 0.0, 0.0, 1.5)
    seen = sensed_barriers(SETTINGS, COUNTER, state, seen_by(state, (), (away, near)), None)
    assert seen.yields_to == "mover 1 may reach the robot before it stops"


def test_discs_reach_to_their_rim_and_room_and_for_a_state_of_another_length_all_count() -> None:
    state = state_of((0.0, 0.0, 0.0, 0.0, 0.0))
    seen = seen_by(state, ((90.0, 0.0, 0.1),), ((90.0, 0.0, 0.1, 0.0, 0.0, 1.5),), ((90.0, 0.0, 0.1, 1.5),))
    found = sensed_barriers(SETTINGS, COUNTER, state, seen, None)
    assert found.barriers.names == ("point 0", "mover 0", "hidden 0", "highest speed", "lowest speed")
    assert found.yields_to == ""
    rows = ((3.0, 0.0, 0.5), (0.0, -3.0, 0.5), (3.0, 0.0, 0.6))
    assert discs_near(rows, 0.0, 0.0, 2.4, 0.1) == ([2], [(3.0, 0.0, 0.7)])
    assert discs_near(rows, 0.0, 0.0, 2.4 + 1e-9, 0.1)[0] == [0, 1, 2]
    assert discs_near(rows, 0.0, 0.0, inf, 0.1)[0] == [0, 1, 2]
    assert discs_near((), 0.0, 0.0, inf, 0.1) == ([], [])


def test_what_moves_comes_nearer_while_the_car_stops() -> None:
    movers, hidden = ((3.0, 0.0, 0.1, 0.0, 0.0, 1.5),), ((-3.0, 0.0, 0.1, 1.0), (0.0, 3.0, 0.1, 0.5))
    place = (0.0, 0.0, 2.0)
    rows, discs, everywhere = moving_near(movers, hidden, place, 0.7, 0.2, 0.1)
    assert rows == [0, 1]
    assert discs == [(3.0, 0.0, pytest.approx(0.45), 1.5, 1.5), (-3.0, 0.0, pytest.approx(0.4), 1.0, 0.0)]
    assert everywhere == [(-3.0, 0.0, pytest.approx(0.4), 1.0, 1.0)]
    assert moving_near(movers, hidden, place, inf, 0.2, 0.1)[0] == [0, 1, 2]
    assert fastest_of(movers, hidden) == 1.5
    assert fastest_of((), hidden) == 1.0
    assert fastest_of((), ()) == 0.0


def test_discs_of_floats_are_chosen_as_those_of_other_numbers() -> None:
    """C takes tuples of floats; NumPy's floats are left to Python."""
    draw = np.random.default_rng(13)
    for count in (0, 1, 7, 300):
        numbers = draw.normal(0.0, 3.0, (count, MOVERS))
        numbers[:, 2:] = np.abs(numbers[:, 2:])
        both = [tuple(tuple(kind(value) for value in row) for row in numbers.tolist()) for kind in (float, np.float64)]
        compiled, python = [tuple(row[:POINTS] for row in rows) for rows in both]
        for within in (0.5, 3.0, inf):
            assert discs_near(compiled, 0.3, -0.2, within, 0.1) == discs_near(python, 0.3, -0.2, within, 0.1)
        hidden = [tuple(row[:HIDDEN] for row in rows) for rows in both]
        assert fastest_of(both[0], hidden[0]) == fastest_of(both[1], hidden[1])


def test_below_is_less_and_a_number_that_is_none_is_not() -> None:
    assert below([1.0, 0.5, nan, -2.0, 1.0], 1.0) == [1, 3]


@pytest.mark.parametrize(("name", "width"), [("points", POINTS), ("movers", MOVERS), ("hidden", HIDDEN)])
def test_rows_that_are_no_discs_are_refused(name: str, width: int) -> None:
    good = (1.0,) * width

    def reported(*rows: tuple[float, ...]) -> None:
        if name == "points":
            discs_near(rows, 0.0, 0.0, 1.0, 0.1)
        else:
            fastest_of(rows if name == "movers" else (), rows if name == "hidden" else ())

    reported(good, good)
    for bad in ((1.0,) * (width - 1), (1.0,) * (width + 1), ()):
        with pytest.raises(InputError, match=f"{name}: got rows of other lengths, wanted {width} numbers each"):
            reported(good, bad)
    for place in range(width):
        for number in (nan, inf, -inf):
            with pytest.raises(InputError, match=f"{name}: got NaN or infinity, wanted finite"):
                reported(good, (*good[:place], number, *good[place + 1 :]))
    for place in {2, width - 1}:
        with pytest.raises(InputError, match=f"{name}: got a radius or a speed below 0, wanted 0 or more"):
            reported((*good[:place], -0.1, *good[place + 1 :]), good)
    reported((1e308,) * width, (1e308,) * width)  # whose sum is no finite number


MODELS = ("car", "car_fix", "car_learned", "car_measured", "car_mix", "car_rma_p", "car_simulated", "dart_car")


def bounds_of(name: str) -> PerformanceLimits:
    return performance_limits(load_model(name), settings_named("car_throttle" if name == "dart_car" else "car"))


@pytest.mark.parametrize("name", MODELS)
def test_no_period_does_more(name: str) -> None:
    model, draw = load_model(name), np.random.default_rng(7)
    settings = settings_named("car_throttle" if name == "dart_car" else "car")
    bounds, count, period = performance_limits(model, settings), 2000, model.period
    states = np.zeros((count, 4))
    states[:, 2] = draw.uniform(-np.pi, np.pi, count)
    states[:, 3] = draw.uniform(settings.barrier("speed_low"), settings.barrier("speed_high"), count)
    actions, before = draw.uniform(settings.action_low, settings.action_high, (2, count, 2))
    ends = np.array([(model.parameters[one].low, model.parameters[one].high) for one in model.latent_names])
    latent = draw.uniform(*ends.T, (count, len(ends))) if len(ends) else None
    after = model.advance(states, actions, model.initial_memory(before, latent), latent)[0]
    changes = np.abs(after - states)
    swiftness = np.abs(states[:, 3]) + bounds.acceleration * period
    assert (changes[:, 3] <= bounds.acceleration * period).all()
    assert (changes[:, 2] <= bounds.curvature * swiftness * period).all()
    assert (changes[:, :2] <= bounds.reach * swiftness[:, None] * period).all()


def test_a_model_that_is_quicker_than_a_car_is_taken_so_and_one_without_a_number_leaves_nothing_out(monkeypatch):
    """With the bounds of an ordinary car, what it can reach would be left out as far away."""
    assert bounds_of("car") == bounds_of("car_mix") == ORDINARY
    assert bounds_of("car_learned").acceleration > 1.5 * ORDINARY.acceleration, "at the ends of its latents"
    assert bounds_of("dart_car").acceleration == pytest.approx(125.0), "of a gain of up to 100 m/s2"
    model = load_model("car")
    monkeypatch.setattr(type(model), "advance", lambda *_, **__: (np.full((9, 5, 5, 5, 4), np.nan), None))
    found = performance_limits(model, settings_named("car"))
    assert found.acceleration == found.curvature == found.reach == np.inf


CREEPS = SETTINGS.barrier("creeping")
BRAKES, BRAKES_BACK = Braking(2.0, 2.5), ReversalBraking(2.0, 2.5, 0.6)
OWN = 0.12


def barrier(load: str, discs: object, way: float, *, hidden: bool = False, creeps: float = 0.0):
    table = np.array(discs, dtype=np.float64)
    body, (begin, end, reach) = footprint(load_named(load)), towed_reach(load_named(load))
    towed = TrailerEnvelope(begin, end, reach - body[2], way, (0.0, 0.0, 0.0))
    known = body, BRAKES, BRAKES_BACK, 0.0, 0.0, None, towed
    return MovingObstacleBarrier(table, [hidden] * len(table), *known, creeps=creeps, own_radius=OWN)


def share_of(load: str, way: float) -> float:
    begin, end, _ = towed_reach(load_named(load))
    return float(np.clip((way - begin) / (end - begin), 0.0, 1.0))


@pytest.mark.parametrize("load", list(LOADS))
def test_what_is_towed_is_where_the_barrier_takes_it_to_be(load: str) -> None:
    """Random programmes, forwards and backwards: no corner is farther, or farther ahead of the hitch, than claimed."""
    known = load_named(load)
    assert known is not None
    rear, _, reach = footprint(known)[0], *towed_reach(known)[1:]
    for seed in range(4):
        draw, world = np.random.default_rng(seed), CarWorld((0.0, 0.0, 0.0), (-80.0, 80.0, -80.0, 80.0), (), known)
        way, action = 0.0, (1.0, 0.0)
        for tick in range(300):
            if tick % 8 == 0:
                ahead = tick < 60 or draw.random() < 0.75
                speed = draw.uniform(0.3, 2.0) if ahead else draw.uniform(-0.6, -0.2)
                action = float(speed), float(draw.choice((-0.34, 0.34, draw.uniform(-0.34, 0.34))))
            before_x, before_y = world.state[:2]
            world.advance(*action, 0.05)
            x, y, yaw, _ = world.state
            way = max(0.0, way - float(np.cos(yaw) * (x - before_x) + np.sin(yaw) * (y - before_y)))
            assert world.towed is not None
            load_x, load_y, turned, length, width = world.towed.pose
            for side in (-1.0, 1.0):
                for end in (-1.0, 1.0):
                    far, aside = end * length / 2, side * width / 2
                    apart_x = load_x + far * np.cos(turned) - aside * np.sin(turned) - x
                    apart_y = load_y + far * np.sin(turned) + aside * np.cos(turned) - y
                    along = np.cos(yaw) * apart_x + np.sin(yaw) * apart_y + rear
                    across = np.cos(yaw) * apart_y - np.sin(yaw) * apart_x
                    assert np.hypot(along, across) <= reach + 0.01
                    assert along <= 0.05 + share_of(load, way) * reach


def region(load: str, way: float) -> np.ndarray:
    """(n, 2) m from the hitch: where the load may be."""
    reach = towed_reach(load_named(load))[2]
    radius, angle = np.meshgrid(np.linspace(0.0, reach, 15), np.linspace(-np.pi, np.pi, 61))
    places = np.column_stack([(radius * np.cos(angle)).ravel(), (radius * np.sin(angle)).ravel()])
    return places[places[:, 0] <= 0.05 + share_of(load, way) * reach]


@pytest.mark.long
@pytest.mark.parametrize("load", list(LOADS))
@pytest.mark.parametrize("way", [0.0, 0.2, 0.6])
@pytest.mark.parametrize("speed", [-0.5, 0.4, 1.2])
def test_a_person_heading_straight_for_car_or_load_arrives_after_it_stopped(load: str, way: float, speed: float):
    """From every place whose h is 0 or more, at 1.5 m/s, for the nearest point; the car brakes as promised."""
    draw, (rear, front, _) = np.random.default_rng(5), footprint(load_named(load))
    places = draw.uniform(-2.0, 2.0, (400, 2))
    h = barrier(load, [(x, y, 0.2, 1.5) for x, y in places.tolist()], way).h(np.array((0.0, 0.0, 0.0, speed)))
    retained = places[h >= 0.0]
    assert 20 < len(retained) < 400
    v, x, driven = speed, 0.0, way
    while abs(v) > IS_STATIONARY:
        v = max(abs(v) - 0.005 * min(2.5 * (abs(v) + 0.6), 2.0), 0.0) * float(np.sign(v))
        x, driven = x + 0.005 * v, max(driven - 0.005 * v, 0.0)
        body = np.column_stack([x + np.linspace(-rear, front, 9), np.zeros(9)])
        load_there = region(load, driven) + np.array((x - rear, 0.0))
        apart = np.vstack([body, load_there]) - retained[:, np.newaxis]
        away = np.hypot(apart[..., 0], apart[..., 1])
        away[:, :9] -= OWN
        assert (away.min(axis=1) > 0.2 - 0.01).all()
        chosen = apart[np.arange(len(retained)), away.argmin(axis=1)]
        retained = retained + 0.005 * 1.5 * chosen / np.hypot(*chosen.T)[:, np.newaxis]


@pytest.mark.parametrize("load", list(LOADS))
@pytest.mark.parametrize("hidden", [False, True])
def test_no_slope_exceeds_its_bound_with_a_load(load: str, hidden: bool) -> None:
    draw = np.random.default_rng(7)
    discs = np.column_stack([draw.uniform(-2, 2, (80, 2)), np.full(80, 0.2), draw.uniform(0.0, 1.5, 80)])
    for way in (0.0, 0.2, 1.0):
        stack = CompiledBarrierSet([barrier(load, discs, way, hidden=hidden, creeps=CREEPS)])
        for _ in range(60):
            state = np.array((*draw.uniform(-0.2, 0.2, 2), draw.uniform(-4, 4), draw.uniform(-0.6, 2.0)))
            bound = np.array(stack.grad_bound(state.tolist()))
            assert (np.abs(stack.grad_h(state)) <= bound + 1e-9).all()


def test_a_load_needs_more_room_behind_and_without_an_own_radius_the_body_is_the_footprint() -> None:
    """Next to the car's front no person is near a towed load; once pushed back it may be there."""
    place, reach = [(0.5, 0.75, 0.2, 1.5)], towed_reach(load_named("large_chair"))[2]
    drawn, pushed = (barrier("large_chair", place, way).h(np.zeros(4))[0] for way in (0.0, 1.0))
    assert pushed == pytest.approx(np.hypot(0.58, 0.75) - reach - 0.2)
    assert drawn == pytest.approx(np.hypot(0.58 - 0.05, 0.75 - reach) - 0.2)
    body, (begin, end, reach) = footprint(load_named("chair")), towed_reach(load_named("chair"))
    towed = TrailerEnvelope(begin, end, reach - body[2], 0.0, (0.0, 0.0, 0.0))
    known = [(1.2, 0.1, 0.2, 1.5)], [False], body, BRAKES, BRAKES_BACK, 0.0, 0.0, None, towed
    wide, slim = MovingObstacleBarrier(*known), MovingObstacleBarrier(*known, own_radius=OWN)
    for speed in (0.0, 0.5):
        state = np.array((0.0, 0.0, 0.0, speed))
        assert slim.h(state)[0] - wide.h(state)[0] == pytest.approx(body[2] - OWN)


@pytest.mark.parametrize("load", ["none", *LOADS])
def test_a_car_may_creep_towards_unseen_room_only_as_fast_as_it_can_stop(load: str) -> None:
    """h of a hidden place is 0 or more exactly where it is far enough or the car is slower than ``IS_STATIONARY``."""
    places = [(0.6, 0.1, 0.27, 1.5), (0.2, -0.5, 0.27, 1.5)]
    if load == "none":
        body = (0.08, 0.40, 0.12)
        strict = MovingObstacleBarrier(places, [True] * 2, body, BRAKES, BRAKES_BACK)
        creeping = MovingObstacleBarrier(places, [True] * 2, body, BRAKES, BRAKES_BACK, creeps=CREEPS)
    else:
        strict = barrier(load, places, 0.3, hidden=True)
        creeping = barrier(load, places, 0.3, hidden=True, creeps=CREEPS)
    for speed in np.linspace(-0.6, 1.5, 64).tolist():
        state = np.array((0.0, 0.0, 0.0, speed))
        wanted = np.maximum(strict.h(state), CREEPS * (IS_STATIONARY - abs(speed)))
        np.testing.assert_allclose(creeping.h(state), wanted, atol=1e-12)
        if abs(speed) > IS_STATIONARY:
            assert ((creeping.h(state) >= 0.0) == (strict.h(state) >= 0.0)).all()


def around(load: str, speed: float, **seen: object) -> tuple[SensedBarriers, StateMessage]:
    scene = Scene(0, load_named(load), (-9.0, 9.0, -9.0, 9.0), (), (0.0, 0.0, 0.0))
    robot = CarRobot(scene, sensor_inputs=SimulatedSensors((Laser(LaserSettings()),)))
    state = replace(robot.state_message(), values=(0.0, 0.0, 0.0, speed))
    stamp = {"epoch": state.epoch, "tick": state.tick, "robot_time": state.robot_time, "publish_time": 0.0}
    reported: dict[str, object] = {"points": (), "movers": (), "hidden": (), "ages": (0.05,), **seen}
    message = SurroundingsMessage(**stamp, **reported)  # type: ignore[arg-type]
    return sensed_barriers(SETTINGS, reversal_braking(SETTINGS), state, message, None), state


@pytest.mark.parametrize("speed", [0.0, 0.06, -0.06])
def test_a_person_in_sight_stops_a_creeping_car(speed: float) -> None:
    """A person who comes out is a mover: creeping is for unseen room."""
    place = (0.75, 0.0, 0.25)
    unseen, state = around("none", speed, hidden=((*place, 1.5),))
    seen, _ = around("none", speed, movers=((*place, 0.0, 0.0, 1.5),))
    assert unseen.barriers.h(np.array(state.values)).min() >= 0.0
    assert seen.barriers.h(np.array(state.values)).min() < 0.0
    assert "mover 0" in seen.yields_to


def test_a_hidden_place_that_holds_a_car_only_once_it_drives_is_looked_at() -> None:
    """At rest h is that of creeping; what counts is the h without it."""
    unseen, _ = around("none", 0.0, hidden=((0.9, 0.2, 0.27, 1.5),))
    assert "hidden 0" in [name for part in unseen.barriers.parts for name in part.names]


def test_a_car_without_settings_for_creeping_stops() -> None:
    """Driving on towards unseen room has to be enabled."""
    assert FilterSettings.for_robot("car").barrier("creeping") == 0.0
    state = np.array([0.0, 0.0, 0.0, 0.0])
    known = np.array([(0.75, 0.0, 0.25, 1.5)]), [True], (0.08, 0.40, 0.12), BRAKES, BRAKES_BACK
    still, creeping = MovingObstacleBarrier(*known), MovingObstacleBarrier(*known, creeps=CREEPS)
    assert still.h(state).min() < 0.0 <= creeping.h(state).min()
