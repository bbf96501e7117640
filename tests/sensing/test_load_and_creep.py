"""Where a towed load may be among moving objects, and how a car creeps towards unseen room."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from safedpa.bus import StateMessage, SurroundingsMessage
from safedpa.robots.car.counter_braking import STANDS, CounterBraking
from safedpa.robots.car.sensed_barrier import MoverBarrier
from safedpa.robots.car.sensed_scene import Sensed, counter_braking_of, sensed_barriers
from safedpa.robots.car.towed_reach import TowedReach
from safedpa.safety.braking import Braking
from safedpa.safety.found_delay import Passed
from safedpa.safety.settings import FilterSettings
from safedpa.safety.shipped import settings_named
from safedpa.safety.stacks import EquationStack
from safedpa_sim.robots.core import CarRobot
from safedpa_sim.robots.footprint import footprint, towed_reach
from safedpa_sim.robots.loads import LOADS, load_named
from safedpa_sim.robots.scene import Scene
from safedpa_sim.robots.world import CarWorld
from safedpa_sim.sensing import Laser
from safedpa_sim.sensing.laser import LaserSettings
from safedpa_sim.sensing.senses import Senses

SETTINGS = settings_named("car")
CREEPS = SETTINGS.barrier("creeping")
BRAKING, COUNTER = Braking(2.0, 2.5), CounterBraking(2.0, 2.5, 0.6)
OWN = 0.12


def barrier(load: str, discs: object, way: float, *, hidden: bool = False, creeps: float = 0.0) -> MoverBarrier:
    table = np.array(discs, dtype=np.float64)
    body, (begin, end, reach) = footprint(load_named(load)), towed_reach(load_named(load))
    towed = TowedReach(begin, end, reach - body[2], way, (0.0, 0.0, 0.0))
    known = body, BRAKING, COUNTER, 0.0, 0.0, None, towed
    return MoverBarrier(table, [hidden] * len(table), *known, creeps=creeps, own_radius=OWN)


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


@pytest.mark.parametrize("load", list(LOADS))
@pytest.mark.parametrize("way", [0.0, 0.2, 0.6])
@pytest.mark.parametrize("speed", [-0.5, 0.4, 1.2])
def test_a_person_heading_straight_for_car_or_load_arrives_after_it_stopped(
    load: str, way: float, speed: float
) -> None:
    """From every place whose h is 0 or more, at 1.5 m/s, for the nearest point; the car brakes as promised."""
    draw, (rear, front, _) = np.random.default_rng(5), footprint(load_named(load))
    places = draw.uniform(-2.0, 2.0, (400, 2))
    h = barrier(load, [(x, y, 0.2, 1.5) for x, y in places.tolist()], way).values(np.array((0.0, 0.0, 0.0, speed)))
    kept = places[h >= 0.0]
    assert 20 < len(kept) < 400
    v, x, driven = speed, 0.0, way
    while abs(v) > STANDS:
        v = max(abs(v) - 0.005 * min(2.5 * (abs(v) + 0.6), 2.0), 0.0) * float(np.sign(v))
        x, driven = x + 0.005 * v, max(driven - 0.005 * v, 0.0)
        body = np.column_stack([x + np.linspace(-rear, front, 9), np.zeros(9)])
        load_there = region(load, driven) + np.array((x - rear, 0.0))
        apart = np.vstack([body, load_there]) - kept[:, np.newaxis]
        away = np.hypot(apart[..., 0], apart[..., 1])
        away[:, :9] -= OWN
        assert (away.min(axis=1) > 0.2 - 0.01).all()
        chosen = apart[np.arange(len(kept)), away.argmin(axis=1)]
        kept = kept + 0.005 * 1.5 * chosen / np.hypot(*chosen.T)[:, np.newaxis]


@pytest.mark.parametrize("load", list(LOADS))
@pytest.mark.parametrize("hidden", [False, True])
def test_no_slope_exceeds_its_bound_with_a_load(load: str, hidden: bool) -> None:
    draw = np.random.default_rng(7)
    discs = np.column_stack([draw.uniform(-2, 2, (80, 2)), np.full(80, 0.2), draw.uniform(0.0, 1.5, 80)])
    for way in (0.0, 0.2, 1.0):
        stack = EquationStack([barrier(load, discs, way, hidden=hidden, creeps=CREEPS)])
        for _ in range(60):
            state = np.array((*draw.uniform(-0.2, 0.2, 2), draw.uniform(-4, 4), draw.uniform(-0.6, 2.0)))
            bound = np.array(stack.steepest(state.tolist()))
            assert (np.abs(stack.gradient(state)) <= bound + 1e-9).all()


def test_a_load_needs_more_room_where_the_car_was_driven_backwards() -> None:
    """Next to the car's front no person is near a towed load; once pushed back it may be there."""
    place, reach = [(0.5, 0.75, 0.2, 1.5)], towed_reach(load_named("large_chair"))[2]
    drawn, pushed = (barrier("large_chair", place, way).values(np.zeros(4))[0] for way in (0.0, 1.0))
    assert pushed == pytest.approx(np.hypot(0.58, 0.75) - reach - 0.2)
    assert drawn == pytest.approx(np.hypot(0.58 - 0.05, 0.75 - reach) - 0.2)


def test_without_the_own_radius_the_body_is_the_footprint_as_it_was() -> None:
    body, (begin, end, reach) = footprint(load_named("chair")), towed_reach(load_named("chair"))
    towed = TowedReach(begin, end, reach - body[2], 0.0, (0.0, 0.0, 0.0))
    known = [(1.2, 0.1, 0.2, 1.5)], [False], body, BRAKING, COUNTER, 0.0, 0.0, None, towed
    wide, slim = MoverBarrier(*known), MoverBarrier(*known, own_radius=OWN)
    for speed in (0.0, 0.5):
        state = np.array((0.0, 0.0, 0.0, speed))
        assert slim.values(state)[0] - wide.values(state)[0] == pytest.approx(body[2] - OWN)


@pytest.mark.parametrize("load", ["none", *LOADS])
def test_a_car_may_creep_towards_unseen_room_only_as_fast_as_it_can_stop(load: str) -> None:
    """h of a hidden place is 0 or more exactly where it is far enough or the car is slower than ``STANDS``."""
    places = [(0.6, 0.1, 0.27, 1.5), (0.2, -0.5, 0.27, 1.5)]
    if load == "none":
        body = (0.08, 0.40, 0.12)
        strict = MoverBarrier(places, [True] * 2, body, BRAKING, COUNTER)
        creeping = MoverBarrier(places, [True] * 2, body, BRAKING, COUNTER, creeps=CREEPS)
    else:
        strict = barrier(load, places, 0.3, hidden=True)
        creeping = barrier(load, places, 0.3, hidden=True, creeps=CREEPS)
    for speed in np.linspace(-0.6, 1.5, 64).tolist():
        state = np.array((0.0, 0.0, 0.0, speed))
        wanted = np.maximum(strict.values(state), CREEPS * (STANDS - abs(speed)))
        np.testing.assert_allclose(creeping.values(state), wanted, atol=1e-12)
        if abs(speed) > STANDS:
            assert ((creeping.values(state) >= 0.0) == (strict.values(state) >= 0.0)).all()


def around(load: str, speed: float, **seen: object) -> tuple[Sensed, StateMessage]:
    scene = Scene(0, load_named(load), (-9.0, 9.0, -9.0, 9.0), (), (0.0, 0.0, 0.0))
    robot = CarRobot(scene, senses=Senses((Laser(LaserSettings()),)))
    state = replace(robot.state_message(), values=(0.0, 0.0, 0.0, speed))
    stamp = {"epoch": state.epoch, "tick": state.tick, "robot_time": state.robot_time, "publish_time": 0.0}
    told: dict[str, object] = {"points": (), "movers": (), "hidden": (), "ages": (0.05,), **seen}
    message = SurroundingsMessage(**stamp, **told)  # type: ignore[arg-type]
    return sensed_barriers(SETTINGS, counter_braking_of(SETTINGS), state, message, None), state


@pytest.mark.parametrize("speed", [0.0, 0.06, -0.06])
def test_a_person_in_sight_stops_a_creeping_car(speed: float) -> None:
    """A person who comes out is a mover: creeping is for unseen room."""
    place = (0.75, 0.0, 0.25)
    unseen, state = around("none", speed, hidden=((*place, 1.5),))
    seen, _ = around("none", speed, movers=((*place, 0.0, 0.0, 1.5),))
    assert unseen.barriers.values(np.array(state.values)).min() >= 0.0
    assert seen.barriers.values(np.array(state.values)).min() < 0.0
    assert "mover 0" in seen.yields_to


def test_a_hidden_place_that_holds_a_car_only_once_it_drives_is_looked_at() -> None:
    """At rest h is that of creeping; what counts is the h without it."""
    unseen, _ = around("none", 0.0, hidden=((0.9, 0.2, 0.27, 1.5),))
    assert "hidden 0" in [name for part in unseen.barriers.parts for name in part.names]


def test_a_stationary_car_reports_no_delay() -> None:
    """A load that sticks to the floor does not move for a while, as if commands acted late."""
    commands = (((1.0, 0.0), None), ((0.0, 0.0), None))
    assert Passed((0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.05), commands).stood((3,))
    assert not Passed((0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.2), commands).stood((3,))
    assert not Passed((0.0, 0.0), (0.0, 0.0), commands).stood(())


def test_a_car_without_settings_for_creeping_stops() -> None:
    """Driving on towards unseen room has to be enabled."""
    assert FilterSettings().barrier("creeping") == 0.0
    state = np.array([0.0, 0.0, 0.0, 0.0])
    known = np.array([(0.75, 0.0, 0.25, 1.5)]), [True], (0.08, 0.40, 0.12), BRAKING, COUNTER
    still, creeping = MoverBarrier(*known), MoverBarrier(*known, creeps=CREEPS)
    assert still.values(state).min() < 0.0 <= creeping.values(state).min()
