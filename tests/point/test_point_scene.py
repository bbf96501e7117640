"""The point robot's barriers and backup on the bus: read off the model, the same manoeuvre in plain numbers."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.bus import ActionMessage, StateMessage
from safedpa.dynamics import load_model
from safedpa.policy.controller import controller_for
from safedpa.robots.point.point_scene import PointScene, motion_of
from safedpa.safety import SafetyFilter
from safedpa.safety.shipped import settings_named
from safedpa.safety.stopping_barrier import ENDS, Motion, stopping_path, stopping_room
from safedpa.safety.stopping_walk import least_rooms
from safedpa_services.dashboard.look import look_of
from safedpa_services.dashboard.world import body_entries
from safedpa_sim.robots.point_robot import PointRobot, force_towards

MODEL, SETTINGS = load_model("point_wind"), settings_named("point")
HAZARDS = ((0.5, 0.0, 0.2), (-0.6, 0.3, 0.2))


def message(values: tuple[float, ...], **changed: object) -> StateMessage:
    told = {
        "epoch": 1, "tick": 0, "robot_time": 0.0, "publish_time": 0.0, "values": values, "applied": (0.0, 0.0),
        "applied_by": "none", "period": 0.02, "lockstep": True, "goal": (1.0, 1.0), "obstacles": HAZARDS,
        "field": (), "footprint": (),
    }  # fmt: skip
    return StateMessage(**{**told, **changed})


def act(robot: PointRobot, action: np.ndarray) -> None:
    """One tick under an action that the robot's guard accepts."""
    sent = ActionMessage(epoch=1, tick=robot.tick, robot_time=0.0, publish_time=0.0, values=tuple(action.tolist()))
    assert robot.guard.offer(sent) is None
    robot.advance()


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.floats(-7.0, 7.0), st.sampled_from(ENDS.tolist()), st.sampled_from([0.0, 0.02]))
def test_plain_numbers_walk_the_same_way(seed: int, yaw: float, end: float, ahead: float) -> None:
    random = np.random.default_rng(seed)
    state = np.array([*random.uniform(-1, 1, 2), yaw, *random.uniform(-1.5, 1.5, 2)])
    motion = Motion(random.uniform(-1, 1, 2), 1.9, 2.9, 3.0, ahead)
    hazards, radii = random.uniform(-1, 1, (5, 2)), np.full(5, 0.2)
    many = stopping_room(stopping_path(state[:, np.newaxis], motion, np.array([end])), hazards[np.newaxis], radii)[0]
    np.testing.assert_allclose(least_rooms(state, motion, end, hazards, radii), many, atol=1e-9)


def test_the_manoeuvre_is_read_off_the_model() -> None:
    motion = motion_of(MODEL, np.array([0.7, -1.1]), SETTINGS, 0.02)
    np.testing.assert_allclose(motion.wind, [0.7, -1.1], atol=1e-4)
    assert motion.drag == pytest.approx(1.927, rel=1e-4)
    assert motion.strongest == pytest.approx(0.015 / 0.005189, rel=1e-4)
    assert motion.fastest == 3.0


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
def test_what_is_no_scene_is_named_and_the_backup_rests(changed: dict) -> None:
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
        wish, _ = seeker.wish(state, latent)
        verdict = filter_.decide(state.values, wish, latent, barriers=scene.of(state))
        act(robot, verdict.action)
    assert robot.goals_reached >= 2
    assert not robot.collisions
    robot.advance()
    assert robot.watchdog_ticks == 1


def test_it_is_drawn_as_a_ball_with_a_nose() -> None:
    entries = body_entries(message((1.0, 2.0, 0.5, 0.0, 0.0)), look_of(MODEL, SETTINGS))
    shapes = {entry.path: entry.shape for entry in entries}
    assert set(shapes) == {("world", "nose"), ("world", "ball")}
    assert shapes["world", "ball"].centres == ((1.0, 2.0),)
