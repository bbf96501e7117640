"""The batched point robot agrees with MuJoCo; layouts, rewards, observations, and the teacher of its policy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.errors import InputError
from safedpa.safety.barriers.stopping import Motion
from safedpa_lab.point.world import MujocoPoint
from safedpa_sim.point.body import POINT_BODY
from safedpa_sim.point.filtering import ETA, PointFilter, SimulatedPointModel
from safedpa_sim.point.layout import FIELD, HAZARD_RADIUS, draw_goals, draw_layouts
from safedpa_sim.point.observation import entries_seen, goal_seen, hazard_lidar, policy_seen
from safedpa_sim.point.route_planner import BERTH, RoutePlanner, teacher_actions
from safedpa_sim.point.simulation import PointSimulation, centre_state
from safedpa_sim.point.task import EPISODE_STEPS, PointTask, control_of


def test_objects_are_apart_and_within_the_field() -> None:
    layout = draw_layouts(300, np.random.default_rng(0))
    everything = np.concatenate((layout.robot[:, None], layout.goal[:, None], layout.hazards), axis=1)
    keep = np.array([0.4, 0.305] + [0.18] * 8)
    assert np.all(np.abs(everything) <= FIELD - keep[:, None] + 1e-12)
    for first in range(10):
        for second in range(first):
            apart = np.linalg.norm(everything[:, first] - everything[:, second], axis=1)
            assert apart.min() >= keep[first] + keep[second]
    assert len(np.unique(layout.robot, axis=0)) == 300
    again = draw_layouts(300, np.random.default_rng(0))
    np.testing.assert_array_equal(layout.hazards, again.hazards)


def test_a_new_goal_is_away_from_robot_and_hazards() -> None:
    random = np.random.default_rng(1)
    layout = draw_layouts(200, random)
    goals = draw_goals(layout.robot, layout.hazards, random)
    assert np.linalg.norm(goals - layout.robot, axis=1).min() >= 0.705
    assert np.linalg.norm(goals[:, None] - layout.hazards, axis=2).min() >= 0.485


def test_lidar_and_compass_turn_with_the_robot() -> None:
    hazards = np.array([[[1.0, 0.0], [0.0, 1.5]]])
    pose = np.array([[0.0], [0.0], [0.0]])
    lidar = hazard_lidar(pose, hazards)[0]
    assert (lidar[0], lidar[4], lidar[8]) == (pytest.approx(1.0 - 1.0 / 3.0), pytest.approx(0.5), 0.0)
    turned = hazard_lidar(pose + np.array([[0.0], [0.0], [np.pi / 2]]), hazards)[0]
    np.testing.assert_allclose(np.roll(turned, 4), lidar, atol=1e-9)
    seen = goal_seen(np.array([[0.0], [0.0], [np.pi / 2]]), np.array([[0.0, 2.0]]))[0]
    np.testing.assert_allclose(seen, [1.0, 0.0, 2.0], atol=1e-3)


def test_reward_is_progress_and_goals_and_cost_counts_steps_within() -> None:
    task = PointTask(64, 3)
    task.layout.goal[:] = task.layout.robot + np.array([0.31, 0.0])
    task.simulation.pose[2] = 0.0
    task.layout.hazards[:, 0] = task.layout.robot + np.array([0.0, 0.205])
    task.layout.hazards[:, 1:] = 40.0
    task.advance(np.zeros((64, 2)))  # at rest; from now on the reward refers to these goals
    goal = task.layout.goal.copy()
    gained, reached = np.zeros(64), np.zeros(64, bool)
    for _ in range(20):
        stepped = task.advance(np.tile([1.0, 0.0], (64, 1)))
        gained += np.where(reached, 0.0, stepped.reward)
        reached |= stepped.reached
        within = np.linalg.norm(task.layout.hazards[:, 0] - task.simulation.pose[:2].T, axis=1) <= 0.2
        np.testing.assert_array_equal(stepped.cost, within)
    assert reached.all()
    assert np.abs(gained - 1.0).max() < 0.05
    assert np.all(np.linalg.norm(task.layout.goal - goal, axis=1) > 0.0)


def test_episodes_end_after_a_thousand_steps_and_restart_with_another_wind() -> None:
    task = PointTask(8, 0, largest_force=0.008)
    force = task.simulation.force.copy()
    assert np.linalg.norm(force, axis=0).max() <= 0.008
    task.steps[:] = EPISODE_STEPS - 1
    assert task.advance(np.zeros((8, 2))).timed_out.all()
    task.restart(np.arange(4))
    assert np.all(task.simulation.force[:, :4] != force[:, :4])
    np.testing.assert_array_equal(task.simulation.force[:, 4:], force[:, 4:])


def test_the_stock_thrust_saturates_beyond_a_twentieth() -> None:
    np.testing.assert_allclose(control_of(np.array([[1.0, 0.5]])), [[0.05], [0.5]])
    np.testing.assert_allclose(control_of(np.array([[1.0, 0.5]]), stock=True), [[1.0], [0.5]])


def test_paired_robots_meet_the_same_goals_whatever_the_others_do() -> None:
    met = []
    for first in (1.0, -1.0):
        task = PointTask(2, 7, paired=True)
        goals = []
        for _ in range(3):
            task.simulation.pose[:2] = task.layout.goal.T  # both reach their goals, or only the second
            if first < 0.0:
                task.simulation.pose[:2, 0] += 5.0
            assert task.advance(np.zeros((2, 2))).reached.tolist() == [first > 0.0, True]
            goals.append(task.layout.goal[1].copy())
        met.append(goals)
    np.testing.assert_array_equal(*met)
    assert len(np.unique(met[0], axis=0)) == 3


def test_the_body_has_the_published_constants() -> None:
    model = MujocoPoint().model
    assert POINT_BODY.mass == pytest.approx(0.005189, abs=1e-6)
    assert POINT_BODY.centre_ahead == pytest.approx(0.0193, abs=5e-5)
    assert (POINT_BODY.largest_thrust, POINT_BODY.largest_turn) == (pytest.approx(0.015), pytest.approx(3.0))
    assert model.body_mass[model.body("robot").id] == pytest.approx(POINT_BODY.mass)
    assert model.body_ipos[model.body("robot").id][0] == pytest.approx(POINT_BODY.centre_ahead)
    assert model.opt.timestep == pytest.approx(0.002)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from([0.05, 0.2, 1.0]))
def test_the_batched_simulation_agrees_with_mujoco(seed: int, thrust_range: float) -> None:
    random = np.random.default_rng(seed)
    many, one = PointSimulation(3), MujocoPoint()
    many.pose[:], many.velocity[:] = random.normal(size=(3, 3)), random.normal(size=(3, 3))
    many.force[:] = random.uniform(-0.008, 0.008, (2, 3))
    pose, velocity = many.pose.copy(), many.velocity.copy()
    controls = random.uniform(-1.0, 1.0, (40, 2, 3)) * np.array([thrust_range, 1.2])[:, None]
    for control in controls:
        many.advance(control)
    for index in range(3):
        one.put(pose[:, index], velocity[:, index], (many.force[0, index], many.force[1, index]))
        for control in controls:
            one.advance(control[:, index])
        np.testing.assert_allclose(many.pose[:, index], one.pose, atol=1e-9)
        np.testing.assert_allclose(many.velocity[:, index], one.velocity, atol=1e-9)
        np.testing.assert_allclose(many.sensors(controls[-1])[:, index], one.sensors(), atol=1e-8)


def test_the_turning_servo_does_not_chatter_and_the_thrust_saturates() -> None:
    robots = PointSimulation(2)
    rates = []
    for _ in range(100):
        robots.advance(np.array([[0.05, 1.0], [1.0, 1.0]]))
        rates.append(robots.velocity[2].copy())
    assert np.abs(np.diff(np.array(rates)[20:], 2, axis=0)).max() < 1e-3
    assert rates[-1] == pytest.approx(POINT_BODY.largest_turn, abs=0.05)
    np.testing.assert_allclose(robots.pose[:, 0], robots.pose[:, 1], atol=1e-12)


@pytest.mark.parametrize("control", [[0.0], [np.nan, 0.0], [0.0, np.inf]])
def test_controls_that_are_not_finite_are_refused(control: list[float]) -> None:
    with pytest.raises(InputError, match="two finite numbers"):
        MujocoPoint().advance(np.array(control))


FAR = np.full((7, 2), 9.0) + np.arange(7)[:, None]


def _one(middle: tuple[float, float]) -> np.ndarray:
    return np.concatenate((np.array([middle]), FAR))[np.newaxis]


def test_a_free_route_is_straight_and_a_blocked_one_goes_around() -> None:
    ways, place, goal = RoutePlanner(1), np.array([[-1.0, 0.0]]), np.array([[1.0, 0.0]])
    turn, length = ways.first_turns(place, _one((0.0, 1.0)), goal)
    assert (turn, length) == (pytest.approx(goal), pytest.approx([2.0]))
    turn, length = ways.first_turns(place, _one((0.0, 0.05)), goal)
    assert turn[0, 1] < -0.1, "the shorter side"
    tangents, radius = 2.0 * np.sqrt(1.0 - 0.3**2), HAZARD_RADIUS + BERTH
    assert tangents < length[0] < 2.0 * np.hypot(1.0, radius + 0.05)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000))
def test_routes_avoid_hazards_and_are_never_shorter_than_the_straight_line(seed: int) -> None:
    task = PointTask(4, seed)
    place, layout = task.simulation.pose[:2].T, task.layout
    turn, length = RoutePlanner(4).first_turns(place, layout.hazards, layout.goal)
    assert np.all(length >= np.linalg.norm(layout.goal - place, axis=1) - 1e-5)
    for share in np.linspace(0.0, 1.0, 21)[:, np.newaxis]:
        on_it = place + share * (turn - place)
        assert np.linalg.norm(layout.hazards - on_it[:, np.newaxis], axis=2).min() > HAZARD_RADIUS + 0.005


def test_observations_do_not_depend_on_the_world_frame() -> None:
    task, latent = PointTask(6, 2), np.zeros((6, 2))
    task.simulation.velocity[:] = np.random.default_rng(0).normal(size=(3, 6))
    before = policy_seen(task, latent, task.layout.goal)
    assert before.shape == (6, entries_seen(2))
    angle = 0.7
    matrix = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    task.simulation.pose[:2], task.simulation.velocity[:2] = (
        matrix @ part[:2] for part in (task.simulation.pose, task.simulation.velocity)
    )
    task.simulation.pose[2] += angle
    task.layout.goal, task.layout.hazards = (part @ matrix.T for part in (task.layout.goal, task.layout.hazards))
    assert policy_seen(task, latent, task.layout.goal) == pytest.approx(before, abs=1e-9)


def test_the_teacher_pushes_towards_the_turn_and_against_the_wind() -> None:
    state, motion = np.zeros((2, 5)), Motion(np.array([0.0, 0.0]), 1.93, 2.89, 3.0)
    ahead = teacher_actions(state, np.array([[1.0, 0.0], [0.0, 1.0]]), motion)
    assert ahead[0] == pytest.approx([1.0, 0.0], abs=1e-9)
    assert ahead[1, 1] > 0.9
    against = teacher_actions(np.array([[0.0, 0.0, 0.0, 0.9, 0.0]]), np.array([[1.0, 0.0]]), motion)
    assert against[0, 0] == pytest.approx(0.9 * 1.93 / 2.89)


@pytest.mark.long
def test_a_robot_with_a_wrong_wind_estimate_is_not_blown_into_a_hazard() -> None:
    """It moves away where h < epsilon / eta, although its model predicts that it is stationary."""
    task = PointTask(1, 0)
    task.layout.hazards[:] = _one((0.0, 0.0))
    task.simulation.pose[:, 0] = -(HAZARD_RADIUS + 0.004), 0.0, 0.0
    task.simulation.force[:, 0] = 0.008, 0.0
    mistaken = PointSimulation(1)  # differs from the truth by 0.2 m/s2 of wind
    mistaken.force[:, 0] = 0.008 - 0.2 * mistaken.body.mass, 0.0
    least, shelter, belief = 1.0, PointFilter(0.002), SimulatedPointModel(mistaken)
    for _ in range(300):
        state = centre_state(task.simulation)
        believed = belief.predict(state, np.zeros((1, 0)))
        action = shelter.decide(state, np.ones((1, 2)), task.layout.hazards, believed).action
        task.advance(action * np.array([1.0, 0.5]))
        least = min(least, float(task.hazard_distance()[0]))
    assert least > 0.0
    assert float(task.hazard_distance()[0]) > 0.5 * 0.002 / ETA
