"""The stopping manoeuvre preserves its barrier, for single robots, in batches, and on the bus."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from safedpa.bus import ActionMessage, StateMessage
from safedpa.dynamics import load_model
from safedpa.errors import InputError
from safedpa.policy.controller import controller_for
from safedpa.robots.point.scene import PointScene, motion_of
from safedpa.robots.point.system import POINT
from safedpa.safety import SafetyFilter, Status
from safedpa.safety.barriers.stopping import (
    ENDS,
    Motion,
    StoppingBarrier,
    minimum_clearances,
    nearer_end,
    stopping_action,
    stopping_path,
    stopping_room,
)
from safedpa.safety.batch.barriers import BatchStopping
from safedpa.safety.batch.filter import STATUSES, BatchFilter
from safedpa.safety.defaults import settings_named
from safedpa.safety.validation import Plausible
from safedpa_services.dashboard.display_settings import display_settings
from safedpa_services.dashboard.world import body_entries
from safedpa_sim.robots.point_robot import PointRobot, force_towards

STRONGEST, FASTEST, DRAG, PERIOD = 2.89, 3.0, 1.93, 0.02
STATE = st.tuples(*[st.floats(-1.0, 1.0)] * 2, st.floats(-3.1, 3.1), *[st.floats(-1.0, 1.0)] * 2)


def _affine(state: np.ndarray, wind: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """x[t+1] = f + g a of a point mass, a = (thrust acceleration, turn)."""
    push = wind - DRAG * state[3:]
    drift = state + PERIOD * np.array([*state[3:], 0.0, *push])
    gain = np.zeros((5, 2))
    gain[3:, 0] = PERIOD * np.array([np.cos(state[2]), np.sin(state[2])])
    gain[2, 1] = PERIOD
    return drift, gain


@settings(max_examples=8, deadline=None)
@given(STATE, st.floats(0.0, 1.5), st.floats(0.0, 6.3))
def test_the_manoeuvre_ends_at_rest_against_the_wind_and_loses_no_room(start, strength, direction) -> None:
    wind = strength * np.array([np.cos(direction), np.sin(direction)])
    motion = Motion(wind, DRAG, STRONGEST, FASTEST)
    barrier = StoppingBarrier(np.array([[0.7, 0.2, 0.2], [-0.9, 0.5, 0.2]]), motion)
    state = np.array(start)
    room, end = barrier.h(state).min(), barrier.best_end(state)
    for _ in range(100):
        thrust, turn = (float(part[0]) for part in stopping_action(state[:, None], motion, np.array([end])))
        drift, gain = _affine(state, wind)
        state = drift + gain @ np.array([thrust, turn])
        apart = np.linalg.norm(state[:2] - np.array([[0.7, 0.2], [-0.9, 0.5]]), axis=1).min() - 0.2
        assert apart >= room - 0.03
    assert np.hypot(state[3], state[4]) < 0.2


def test_a_batch_is_filtered_as_single_robots_are() -> None:
    """Agrees to 1e-6, also where not every constraint can be satisfied, and where an h is negative."""
    random, hazards = np.random.default_rng(0), np.array([[0.4, 0.0, 0.2], [0.0, 0.5, 0.2], [-0.5, -0.2, 0.2]])
    own = replace(settings_named("point"), action_low=(-STRONGEST, -FASTEST), action_high=(STRONGEST, FASTEST))
    near = np.c_[random.uniform(-0.8, 0.8, (3000, 2)), random.uniform(-3, 3, 3000), random.uniform(-1, 1, (3000, 2))]
    wind = random.uniform(-1.0, 1.0, (2, 3000))
    room = BatchStopping(np.broadcast_to(hazards, (3000, 3, 3)), Motion(wind, DRAG, STRONGEST, FASTEST)).h(near)
    close = np.flatnonzero((room.min(axis=1) > -0.01) & (room.min(axis=1) < 0.02))[:40]
    state, motion = near[close], Motion(wind[:, close], DRAG, STRONGEST, FASTEST)
    nominal = np.c_[random.uniform(0.3, 1.0, 40), random.uniform(-1.0, 1.0, 40)] * own.high
    pairs = [_affine(row, motion.of(index).wind) for index, row in enumerate(state)]
    affine = np.stack([f for f, _ in pairs]), np.stack([g for _, g in pairs])
    around = BatchStopping(np.broadcast_to(hazards, (40, 3, 3)), motion)
    backup = np.tile([0.1, -0.2], (40, 1))
    many = BatchFilter(POINT, own).decide(state, nominal, barriers=around, affine=affine, backup=backup.__getitem__)
    believed = Plausible(POINT.state_low, POINT.state_high, POINT.state_names)
    for index, row in enumerate(state):
        filter_ = SafetyFilter(
            lambda _, pair=pairs[index]: pair, [StoppingBarrier(hazards, motion.of(index))], own,
            backup=lambda _, own=backup[index]: own, state_range=believed,
        )  # fmt: skip
        one = filter_.decide(row, nominal[index])
        assert STATUSES[many.status[index]] is one.status
        np.testing.assert_allclose(many.action[index], one.action, atol=1e-6)
        assert many.h_now[index] == pytest.approx(one.h_now, abs=1e-9)
    for status in (Status.passed, Status.corrected, Status.relaxed, Status.violated):
        assert many.count(status) > 0, status
    assert (~many.single).sum() >= 10


def test_the_backup_of_each_robot_is_its_own() -> None:
    state, hazards = np.zeros((2, 5)), np.tile([0.1, 0.0, 0.2], (2, 1, 1))
    motion, own = Motion(np.zeros(2), DRAG, STRONGEST, FASTEST), settings_named("point")
    backup, affine = np.array([[0.01, 0.0], [0.0, 1.0]]), (state, np.full((2, 5, 2), np.nan))
    around = BatchStopping(hazards, motion)
    found = BatchFilter(POINT, own).decide(
        state, np.zeros((2, 2)), barriers=around, affine=affine, backup=backup.__getitem__
    )
    assert found.count(Status.fallback) == 2
    np.testing.assert_array_equal(found.action, backup)


def test_a_filter_without_a_model_wants_f_and_g() -> None:
    around, many = (
        BatchStopping(np.zeros((1, 1, 3)), Motion(np.zeros(2), 1.0, 1.0, 1.0)),
        BatchFilter(POINT, settings_named("point")),
    )
    with pytest.raises(InputError, match="wanted f and g of each robot"):
        many.decide(np.zeros((1, 5)), np.zeros((1, 2)), barriers=around)
    with pytest.raises(InputError, match=r"g: got shape \(1, 5\)"):
        many.decide(np.zeros((1, 5)), np.zeros((1, 2)), barriers=around, affine=(np.zeros((1, 5)), np.zeros((1, 5))))


def test_either_end_is_a_manoeuvre_of_its_own() -> None:
    motion = Motion(np.zeros(2), DRAG, STRONGEST, FASTEST)
    state = np.tile(np.array([[0.0], [0.0], [np.pi / 2 - 0.1], [1.0], [0.0]]), (1, 2))
    thrust, turn = stopping_action(state, motion, ENDS)
    assert turn[0] > 0.0 > turn[1]
    assert np.all(thrust < 0.0)


def test_h_is_continuous_in_state_and_wind() -> None:
    """A change of the end during the manoeuvre would make h jump by up to 17 cm, below 0 without a hazard near."""
    random, jumps = np.random.default_rng(5), []
    for _ in range(400):
        state = np.array([0.0, 0.0, *random.uniform(-np.pi, np.pi, 1), *random.uniform(-0.4, 0.4, 2)])
        wind, direction = random.uniform(-0.7, 0.7, 2), random.uniform(-np.pi, np.pi)
        hazards = np.array([[0.45 * np.cos(direction), 0.45 * np.sin(direction), 0.225]])
        least = [
            StoppingBarrier(hazards, Motion(wind + change, DRAG, STRONGEST, FASTEST)).h(state + move).min()
            for change, move in ((0.0, 0.0), (0.002, 0.0), (0.0, 0.002))
        ]
        jumps += [abs(least[1] - least[0]), abs(least[2] - least[0])]
    assert max(jumps) < 0.01


Values = NDArray[np.float64]

ROBOTS, FASTEST_MANY = 60, 3.0


def drawn(seed: int, hazards: int) -> tuple[Values, BatchStopping]:
    """Draws states of robots that differ in wind, drag and strength, some at rest, and their barriers."""
    random = np.random.default_rng(seed)
    state = np.c_[random.uniform(-0.5, 0.5, (ROBOTS, 2)), random.uniform(-3.1, 3.1, ROBOTS), np.zeros((ROBOTS, 2))]
    state[:, 3:] = random.uniform(-1.0, 1.0, (ROBOTS, 2)) * random.choice([0.0, 1.0], (ROBOTS, 1))
    wind = random.uniform(-1.0, 1.0, (2, ROBOTS)) * random.choice([0.0, 1.0], ROBOTS)
    motion = Motion(wind, random.uniform(1.0, 2.0, ROBOTS), random.uniform(2.0, 3.0, ROBOTS), FASTEST_MANY, 0.02)
    places, radii = random.uniform(-1.0, 1.0, (ROBOTS, hazards, 2)), random.uniform(0.2, 0.3, (ROBOTS, hazards, 1))
    return state, BatchStopping(np.concatenate([places, radii], axis=2), motion)


def alone(many: BatchStopping, robot: int) -> StoppingBarrier:
    (one,) = many.one(robot)
    assert isinstance(one, StoppingBarrier)
    return one


@pytest.mark.parametrize("hazards", [1, 4])
def test_batched_h_ends_and_gradients_equal_those_of_single_robots(hazards: int) -> None:
    state, many = drawn(hazards, hazards)
    g = np.random.default_rng(9).normal(size=(ROBOTS, 5, 2))
    assert (many.kinds, len(many)) == ((StoppingBarrier.kind,) * hazards, ROBOTS)
    (room, end), slopes = many.best(state), many.lie_derivative(state, g, np.ones(2))
    ones = [alone(many, robot) for robot in range(ROBOTS)]
    assert end.tolist() == [one.best_end(own) for one, own in zip(ones, state, strict=True)]
    assert {*end.tolist()} == {1.0, -1.0}
    for robot, (one, own) in enumerate(zip(ones, state, strict=True)):
        h, gradient = one.h_and_grad(own)
        np.testing.assert_allclose(room[robot], h, atol=1e-9)
        np.testing.assert_allclose(slopes[robot], gradient @ g[robot], rtol=1e-6, atol=1e-7)
    np.testing.assert_array_equal(many.h(state), room)


def test_gradients_equal_those_of_the_scalar_rollout() -> None:
    """Checks derivatives along the actions for a fixed end and moving robots: h has kinks at rest and where the closest
    step changes."""
    state, many = drawn(2, 3)
    g, far = np.random.default_rng(8).normal(size=(ROBOTS, 5, 2)), 1e-5
    end, slopes, apart = many.best(state)[1], many.lie_derivative(state, g, np.ones(2)), []
    for robot in np.flatnonzero(state[:, 3]).tolist():
        hazards, motion = many.hazards[robot], many.motion_of(robot)

        def rooms(at: Values, hazards: Any = hazards, motion: Motion = motion, robot: int = robot) -> Values:
            return np.asarray(minimum_clearances(at, motion, float(end[robot]), hazards[:, :2], hazards[:, 2]))

        for action, along in enumerate(g[robot].T):
            change = (rooms(state[robot] + far * along) - rooms(state[robot] - far * along)) / (2.0 * far)
            apart.append(np.abs(change - slopes[robot, :, action]))
    assert len(apart) > 40
    assert np.quantile(np.array(apart), 0.9) < 1e-3


def test_a_selection_equals_the_selected_robots() -> None:
    state, many = drawn(3, 2)
    which = np.array([7, 3, 31])
    np.testing.assert_allclose(many.only(which).h(state[which]), many.h(state)[which], rtol=0.0, atol=1e-15)
    for place, robot in enumerate(which):
        one = alone(many.only(which), place)
        np.testing.assert_allclose(one.h(state[robot]), many.h(state)[robot], atol=1e-9)


def test_without_hazards_there_is_no_h() -> None:
    state, many = drawn(4, 0)
    room, end = many.best(state)
    assert room.shape == (ROBOTS, 0)
    assert end.tolist() == [alone(many, robot).best_end(own) for robot, own in enumerate(state)]
    assert many.lie_derivative(state, np.zeros((ROBOTS, 5, 2)), np.ones(2)).shape == (ROBOTS, 0, 2)


def test_the_nearer_end_is_the_one_that_points_more_to_where_the_robot_has_to_push() -> None:
    """The required push is the acceleration that stops the motion in 0.15 s, minus wind and drag."""
    random, ends = np.random.default_rng(6), set[float]()
    for _ in range(200):
        state = np.r_[random.uniform(-1.0, 1.0, 2), random.uniform(-3.1, 3.1), random.uniform(-1.0, 1.0, 2)]
        wind, drag = complex(*random.uniform(-3.0, 3.0, 2)), random.uniform(1.0, 9.0)
        motion = Motion(np.array([wind.real, wind.imag]), drag, 2.9, FASTEST_MANY)
        velocity = complex(*state[3:])
        push = -velocity / 0.15 - (wind - drag * velocity)
        towards = np.angle(push / np.exp(1j * state[2]))
        found = float(nearer_end(state, motion))
        assert found == (1.0 if abs(towards) < np.pi / 2 else -1.0)
        ends.add(found)
    assert ends == {1.0, -1.0}


def test_the_end_that_leaves_more_room_is_taken_though_the_other_one_is_nearer() -> None:
    state, many = drawn(5, 2)
    gained = 0
    for robot in range(ROBOTS):
        one, hazards, motion = alone(many, robot), many.hazards[robot], many.motion_of(robot)
        rooms = {
            end: min(minimum_clearances(state[robot], motion, end, hazards[:, :2], hazards[:, 2]))
            for end in (1.0, -1.0)
        }
        assert one.h(state[robot]).min() >= max(rooms.values()) - 1e-6
        gained += rooms[one.best_end(state[robot])] > rooms[float(nearer_end(state[robot], motion))] + 0.01
    assert gained > 2


@pytest.mark.parametrize("ahead", [0.0, 0.02, 1.0])
def test_h_refers_to_the_geometric_centre(ahead: float) -> None:
    motion = Motion(np.zeros(2), 1.0, 2.0, FASTEST_MANY, ahead)
    path = stopping_path(np.array([[0.5], [0.2], [0.7], [0.0], [0.0]]), motion, np.ones(1))
    np.testing.assert_allclose(path[:, :, 0], [(0.5 - ahead * np.cos(0.7), 0.2 - ahead * np.sin(0.7))] * len(path))


MODEL, SETTINGS = load_model("point_wind"), settings_named("point")
HAZARDS = ((0.5, 0.0, 0.2), (-0.6, 0.3, 0.2))


def message(values: tuple[float, ...], **changed: object) -> StateMessage:
    reported = {
        "epoch": 1, "tick": 0, "robot_time": 0.0, "publish_time": 0.0, "values": values, "applied": (0.0, 0.0),
        "applied_by": "none", "period": 0.02, "lockstep": True, "goal": (1.0, 1.0), "obstacles": HAZARDS,
        "field": (), "footprint": (),
    }  # fmt: skip
    return StateMessage(**{**reported, **changed})


def act(robot: PointRobot, action: np.ndarray) -> None:
    """Simulates one tick under an action that the robot's guard accepts."""
    sent = ActionMessage(epoch=1, tick=robot.tick, robot_time=0.0, publish_time=0.0, values=tuple(action.tolist()))
    assert robot.guard.offer(sent) is None
    robot.advance()


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.floats(-7.0, 7.0), st.sampled_from(ENDS.tolist()), st.sampled_from([0.0, 0.02]))
def test_the_scalar_rollout_equals_the_array_rollout(seed: int, yaw: float, end: float, ahead: float) -> None:
    random = np.random.default_rng(seed)
    state = np.array([*random.uniform(-1, 1, 2), yaw, *random.uniform(-1.5, 1.5, 2)])
    motion = Motion(random.uniform(-1, 1, 2), 1.9, 2.9, 3.0, ahead)
    hazards, radii = random.uniform(-1, 1, (5, 2)), np.full(5, 0.2)
    many = stopping_room(stopping_path(state[:, np.newaxis], motion, np.array([end])), hazards[np.newaxis], radii)[0]
    np.testing.assert_allclose(minimum_clearances(state, motion, end, hazards, radii), many, atol=1e-9)


def test_the_manoeuvre_is_identified_from_the_model() -> None:
    motion = motion_of(MODEL, np.array([0.7, -1.1]), SETTINGS, 0.02)
    np.testing.assert_allclose(motion.wind, [0.7, -1.1], atol=1e-4)
    assert motion.drag == pytest.approx(1.927, rel=1e-4)
    assert (motion.strongest, motion.fastest) == (pytest.approx(0.015 / 0.005189, rel=1e-4), 3.0)


@pytest.mark.parametrize("period", [0.01, 0.02, 0.04])
@pytest.mark.parametrize("wind", [(0.0, 0.0), (1.0, 0.5)])
def test_the_backup_stops_within_the_distance_that_h_promises(period: float, wind: tuple[float, float]) -> None:
    model = MODEL.with_period(period)
    scene, ahead = PointScene(model, SETTINGS), 2.0
    scene.learn(np.array(wind))
    for speed in (0.3, 0.7, 1.0):
        state = now = np.array([0.0, 0.0, 0.0, speed, 0.0])
        barriers = scene.of(message(tuple(state), obstacles=((ahead, 0.0, 0.2),), period=period))
        assert not isinstance(barriers, str)
        room, furthest = float(barriers.h(state)[0]), 0.0
        for _ in range(round(1.6 / period)):
            now = model.step(now, scene.backup(now), np.array(wind))
            furthest = max(furthest, float(now[0]))
        promised = ahead - 0.2 - SETTINGS.barrier("clearance") - room
        assert furthest <= 1.03 * promised + 1e-4


def test_the_backup_holds_the_robot_in_the_wind() -> None:
    wind = force_towards(0.008, 30.0)
    robot, scene = PointRobot(wind, seed=4), PointScene(MODEL, SETTINGS)
    scene.learn(np.array(wind) / robot.task.simulation.body.mass)
    start = np.array(robot.values[:2])
    for _ in range(150):
        assert not isinstance(scene.of(robot.state_message()), str)
        act(robot, scene.backup(np.array(robot.values)))
    assert np.linalg.norm(np.array(robot.values[:2]) - start) < 0.25
    assert np.hypot(*robot.values[3:]) < 0.1
    assert not robot.collisions


@pytest.mark.parametrize(
    "changed", [{"corridor": (0.0, 1.0)}, {"obstacles": ((0.0, 1.0),)}, {"obstacles": ((np.nan, 0.0, 0.2),)}]
)
def test_an_invalid_scene_is_named_and_the_backup_rests(changed: dict) -> None:
    scene = PointScene(MODEL, SETTINGS)
    assert "wanted" in scene.of(message((0.0,) * 5, **changed))
    np.testing.assert_array_equal(scene.backup(None), [0.0, 0.0])


def test_the_loop_keeps_a_goal_seeker_out_of_the_hazards_in_the_wind() -> None:
    wind = force_towards(0.008, 135.0)
    robot, scene = PointRobot(wind, seed=6), PointScene(MODEL, SETTINGS)
    filter_ = SafetyFilter.for_model(MODEL, SETTINGS, backup=scene.backup)
    latent = np.array(wind) / robot.task.simulation.body.mass
    scene.learn(latent)
    seeker = controller_for(MODEL)()
    for _ in range(500):
        state = robot.state_message()
        nominal, _ = seeker.nominal_action(state, latent)
        verdict = filter_.decide(state.values, nominal, latent, barriers=scene.of(state))
        act(robot, verdict.action)
    assert robot.goals_reached >= 2
    assert not robot.collisions
    robot.advance()
    assert robot.watchdog_ticks == 1


def test_it_is_drawn_as_a_ball_with_a_nose() -> None:
    entries = body_entries(message((1.0, 2.0, 0.5, 0.0, 0.0)), display_settings(MODEL, SETTINGS))
    shapes = {entry.path: entry.shape for entry in entries}
    assert set(shapes) == {("world", "nose"), ("world", "ball")}
    assert shapes["world", "ball"].centres == ((1.0, 2.0),)
