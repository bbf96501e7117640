"""Layouts keep things apart; rewards, costs and observations mean what they say."""

import numpy as np
import pytest

from safedpa_sim.point.layout import FIELD, draw_goals, draw_layouts
from safedpa_sim.point.observation import goal_seen, hazard_lidar
from safedpa_sim.point.task import EPISODE_STEPS, PointTask, control_of


def test_things_lie_apart_within_the_field() -> None:
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
    assert lidar[0] == pytest.approx(1.0 - 1.0 / 3.0)
    assert lidar[4] == pytest.approx(0.5)
    assert lidar[8] == 0.0
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
    task.advance(np.zeros((64, 2)))  # at rest, and the reward is about these goals from now on
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


def test_the_stock_thrust_is_full_beyond_a_twentieth() -> None:
    np.testing.assert_allclose(control_of(np.array([[1.0, 0.5]])), [[0.05], [0.5]])
    np.testing.assert_allclose(control_of(np.array([[1.0, 0.5]]), stock=True), [[1.0], [0.5]])


def test_paired_robots_meet_the_same_goals_whatever_the_others_do() -> None:
    met = []
    for first in (1.0, -1.0):
        task = PointTask(2, 7, paired=True)
        goals = []
        for _ in range(3):
            task.simulation.pose[:2] = task.layout.goal.T  # both reach theirs, or the second alone
            if first < 0.0:
                task.simulation.pose[:2, 0] += 5.0
            assert task.advance(np.zeros((2, 2))).reached.tolist() == [first > 0.0, True]
            goals.append(task.layout.goal[1].copy())
        met.append(goals)
    np.testing.assert_array_equal(*met)
    assert len(np.unique(met[0], axis=0)) == 3
