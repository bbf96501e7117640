"""The controller that looks where it goes; anyone who is held back tries another way."""

import math
from dataclasses import replace
from math import cos, hypot, pi, sin, tan

import numpy as np
import pytest
from tests.messages import stamp, state_of

from safedpa.bus import SURROUNDINGS, StateMessage, SurroundingsMessage
from safedpa.dynamics import load_model
from safedpa.errors import InputError, MessageError
from safedpa.policy import PolicyNode
from safedpa.policy.backing_off import BackOffController, BackOffSettings
from safedpa.policy.controller import UsesSurroundings, controller_for
from safedpa.robots.car.controllers.route_cost import Clearances, ClearanceSettings, VisibleObstacles, visible_obstacles
from safedpa.robots.car.controllers.route_follower import RouteFollower
from safedpa_sim.robots.car.loads import load_named
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene
from safedpa_sim.sensing import Laser, LaserSettings
from safedpa_sim.sensing.sensor_inputs import SimulatedSensors

MODEL = load_model("car")
GOAL = (3.0, 0.0)


def state_at(pose: tuple[float, float, float], speed: float = 0.0, tick: int = 0, load: str = "none") -> StateMessage:
    scene = Scene(0, load_named(load), (-6.0, 6.0, -6.0, 6.0), (), (0.0, 0.0, 0.0), (GOAL,))
    reported = CarRobot(scene, sensor_inputs=SimulatedSensors((Laser(LaserSettings()),))).state_message()
    return replace(reported, values=(*pose, speed), tick=tick, robot_time=0.05 * tick, goal=GOAL)


def around(state: StateMessage, **seen: object) -> SurroundingsMessage:
    reported: dict[str, object] = {"points": (), "movers": (), "hidden": (), "ages": (0.05,), **seen}
    stamp = {"epoch": state.epoch, "tick": state.tick, "robot_time": state.robot_time, "publish_time": 0.0}
    return SurroundingsMessage(**stamp, **reported)  # type: ignore[arg-type]


def driven(seconds: float, **seen: object) -> list[tuple[float, float, float, float]]:
    """x, y, yaw, nominal speed of a car that drives as it is requested, kinematically."""
    seeker, x, y, yaw, found = RouteFollower(MODEL), 0.0, 0.0, 0.0, []
    for tick in range(round(seconds / 0.05)):
        state = state_at((x, y, yaw), tick=tick)
        seeker.look(around(state, **seen))
        (speed, steer), _ = seeker.nominal_action(state, None)
        x, y = x + 0.05 * speed * cos(yaw), y + 0.05 * speed * sin(yaw)
        yaw += 0.05 * speed * tan(steer) / 0.32
        found.append((x, y, yaw, speed))
        if hypot(x - GOAL[0], y - GOAL[1]) < 0.3:
            break
    return found


def wall(x: float, low: float, high: float) -> tuple[tuple[float, float, float], ...]:
    return tuple((x, float(y), 0.05) for y in np.arange(low, high, 0.1))


def test_it_drives_straight_where_nothing_is_around_a_wall_and_slower_where_a_mover_may_hide() -> None:
    way = driven(4.0)
    assert hypot(way[-1][0] - GOAL[0], way[-1][1] - GOAL[1]) < 0.3
    assert max(abs(y) for _, y, _, _ in way) < 0.1
    assert way[5][3] == pytest.approx(ClearanceSettings().cruise)
    points = wall(1.5, -0.8, 0.8)
    way = driven(8.0, points=points)
    assert hypot(way[-1][0] - GOAL[0], way[-1][1] - GOAL[1]) < 0.3
    for x, y, yaw, _ in way:
        for ahead in (-0.08, 0.16, 0.4):
            apart = np.array(points)[:, :2] - (x + ahead * cos(yaw), y + ahead * sin(yaw))
            assert np.hypot(*apart.T).min() > 0.12 + 0.05
    corner = tuple((1.5, float(y), 0.3, 1.5) for y in np.arange(0.9, 2.0, 0.1))
    free, careful = driven(6.0), driven(6.0, hidden=corner)
    assert min(y for _, y, _, _ in careful) < min(y for _, y, _, _ in free) - 0.1
    passing = [speed for x, _, _, speed in careful if 1.0 < x < 1.6]
    assert min(passing) <= ClearanceSettings().cruise


def test_the_same_drive_requests_the_same_and_without_surroundings_it_drives_to_its_goal() -> None:
    points = wall(1.5, -0.8, 0.8)
    assert driven(2.0, points=points) == driven(2.0, points=points)
    (speed, steer), notice = RouteFollower(MODEL).nominal_action(state_at((0.0, 0.0, 0.0)), None)
    assert speed == pytest.approx(ClearanceSettings().cruise)
    assert steer == pytest.approx(0.0, abs=0.08)
    assert notice == "way_seeker:ahead"


@pytest.mark.parametrize(
    "odd", [{"values": (0.0, 0.0, 0.0)}, {"goal": ()}, {"footprint": ()}, {"values": (float("nan"), 0.0, 0.0, 0.0)}]
)
def test_a_state_that_does_not_fit_is_refused(odd: dict[str, object]) -> None:
    with pytest.raises(MessageError, match="wanted"):
        RouteFollower(MODEL).nominal_action(replace(state_at((0.0, 0.0, 0.0)), **odd), None)  # type: ignore[arg-type]


def test_where_it_makes_no_headway_the_way_is_closed_for_a_while_and_it_tries_another() -> None:
    seeker, nominal_actions = RouteFollower(MODEL), []
    for tick in range(120):
        state = state_at((0.0, 0.0, 0.0), tick=tick)
        seeker.look(around(state))
        nominal_actions.append(seeker.nominal_action(state, None)[0])
    assert nominal_actions[10][0] > 0.0
    assert abs(nominal_actions[10][1]) < 0.1
    assert any(speed < 0.0 or abs(steer) > 0.2 for speed, steer in nominal_actions[50:])


def test_hidden_places_behind_a_load_block_no_route_but_the_area_behind_is_unseen() -> None:
    state = state_at((0.0, 0.0, pi / 2), load="chair")
    room, sees_behind = visible_obstacles(state, around(state, hidden=((0.0, -1.0, 0.27, 1.5),)), ClearanceSettings())
    assert not sees_behind
    assert not len(room.moves)
    room, sees_behind = visible_obstacles(state, around(state, hidden=((0.0, 1.5, 0.27, 1.5),)), ClearanceSettings())
    assert sees_behind
    assert len(room.moves) == 1


def test_a_metre_costs_more_the_less_room_there_is() -> None:
    room = VisibleObstacles(np.empty((0, 3)), np.empty((0, 3)), 1.5, 0.12, ClearanceSettings())
    free = np.full(40, 100.0)
    for reported in (Clearances(np.linspace(-0.5, 2.5, 40), free), Clearances(free, np.linspace(-0.5, 2.5, 40))):
        assert (np.diff(room.price(reported)) <= 1e-12).all()
        assert (np.diff(room.seconds_each_metre(reported, 1.6)) <= 1e-12).all()
        assert room.price(reported)[-1] == pytest.approx(1.0)


def test_the_service_hands_the_surroundings_to_a_controller_that_looks_around_and_to_no_other() -> None:
    state = state_at((0.0, 0.0, 0.0))
    looking, other = PolicyNode(MODEL, "way_seeker"), PolicyNode(MODEL, "goal_seeker")
    assert isinstance(controller_for(MODEL, "way_seeker")(), UsesSurroundings)
    assert SURROUNDINGS in looking.needs(state)
    assert SURROUNDINGS not in looking.needs(replace(state, sources=()))
    assert SURROUNDINGS not in other.needs(state)


class Stubborn:
    """Asks for the same thing for ever, and counts how often it was asked."""

    asked = 0

    def nominal_action(self, state: StateMessage, latent: np.ndarray | None) -> tuple[tuple[float, ...], str]:
        del state, latent
        self.asked += 1
        return (1.5, 0.1), "stubborn"


def state(tick: int, x: float = 0.0, goal: tuple[float, float] = (3.0, 1.0)) -> StateMessage:
    return state_of(x, 0.0, 0.0, 0.0, **stamp(tick), goal=goal, footprint=(0.08, 0.4, 0.12))


def nominal_actions(states: list[StateMessage]) -> list[tuple[float, ...]]:
    controller = BackOffController(Stubborn())
    return [controller.nominal_action(item, None)[0] for item in states]


def test_a_car_that_moves_is_left_alone_and_one_that_is_held_backs_off_to_one_side_and_the_other() -> None:
    found = nominal_actions([state(tick, x=0.05 * tick) for tick in range(100)])
    assert set(found) == {(1.5, 0.1)}
    found = nominal_actions([state(tick) for tick in range(110)])
    reversing = [index for index, nominal in enumerate(found) if nominal[0] < 0.0]
    assert 17 <= reversing[0] <= 20  # after the patience of one second
    sides = [found[index][1] for index in reversing]
    assert sides[0] < 0.0  # the goal lies to the left: reversing with the wheels to the right turns the nose there
    assert {math.copysign(1.0, side) for side in sides} == {-1.0, 1.0}
    first_stretch = next(k for k in range(reversing[0], 110) if found[k][0] > 0.0) - reversing[0]
    assert abs(first_stretch - 28) <= 1  # 1.4 s


def test_the_controller_is_asked_in_every_tick() -> None:
    inner = Stubborn()
    controller = BackOffController(inner)
    names = {controller.nominal_action(state(tick), None)[1] for tick in range(60)}
    assert inner.asked == 60
    assert names == {"stubborn", "stubborn:back_off"}


def test_a_new_goal_ends_backing_off_and_settings_that_would_never_begin_it_are_refused() -> None:
    held = [state(tick) for tick in range(30)]
    assert nominal_actions([*held, state(30)])[-1][0] < 0.0
    assert nominal_actions([*held, state(30, goal=(-3.0, 0.0))])[-1] == (1.5, 0.1)
    with pytest.raises(InputError, match="speed below 0"):
        replace(BackOffSettings(), reverse_speed=0.3)
