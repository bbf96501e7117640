"""The gymnasium environment is gymnasium's, and the same task as the vectorised one."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.utils.seeding import np_random

from safedpa.errors import InputError
from safedpa_lab.point.gym_environment import PointGoalEnvironment
from safedpa_lab.point.speed import steps_per_second
from safedpa_sim.point.layout import draw_layouts
from safedpa_sim.point.task import EPISODE_STEPS, PointTask


@pytest.mark.parametrize("options", [{}, {"force": (0.004, -0.004)}, {"largest_force": 0.008, "stock": True}])
@pytest.mark.filterwarnings("ignore:.*Box observation space m.*imum value is.*infinity")
def test_gymnasium_finds_nothing_wrong(options: dict) -> None:
    made = gymnasium.make("safedpa_lab.point.gym_environment:safedpa/PointGoal-v0", **options)
    check_env(made.unwrapped, skip_render_check=True)


def test_one_robot_in_mujoco_lives_as_one_of_many() -> None:
    """The layout, the heading and the wind are drawn in turn from the generator that the seed gives."""
    one, many, (drawn, _) = PointGoalEnvironment(largest_force=0.008), PointTask(1, 0), np_random(3)
    seen, info = one.reset(seed=3)
    layout = draw_layouts(1, drawn)
    many.layout.goal[:], many.layout.hazards[:] = layout.goal, layout.hazards
    many.simulation.pose[:, 0] = *layout.robot[0], drawn.uniform(0.0, 2.0 * np.pi)
    many.simulation.force[:, 0] = info["force"]
    assert 0.0 < np.linalg.norm(info["force"]) <= 0.008
    np.testing.assert_allclose(seen[12:], many.observation()[0, 12:], atol=1e-5)
    random = np.random.default_rng(1)
    for step in range(150):
        action = random.uniform(-1.0, 1.0, 2) * 0.5 + np.array([0.3, 0.2])
        seen, reward, ended, _, info = one.step(action)
        stepped = many.advance(action[np.newaxis])
        if step:  # the goal of the many was put elsewhere before their first step
            assert reward == pytest.approx(stepped.reward[0], abs=1e-6)
        assert info["cost"] == stepped.cost[0]
        assert not ended
        np.testing.assert_allclose(seen, many.observation()[0], atol=1e-3)


def test_a_goal_that_is_reached_counts_one_and_is_put_elsewhere() -> None:
    environment, info = PointGoalEnvironment(), {"reached": False}
    seen, _ = environment.reset(seed=3)
    while not info["reached"]:
        off, away = np.arctan2(seen[13], seen[12]), seen[14]
        action = np.array([1.5 * np.cos(off) * away, 2.0 * off]).clip(-1.0, 1.0)
        seen, reward, _, timed_out, info = environment.step(action)
        assert not timed_out
    assert info["goals"] == 1
    assert reward == pytest.approx(1.0, abs=0.05)
    assert seen[14] > 0.4 > away


def test_an_episode_ends_by_time_and_the_force_stays() -> None:
    environment = PointGoalEnvironment(force=(0.003, 0.001))
    for seed in (0, 1):
        environment.reset(seed=seed)
        lengths = 1
        while not environment.step(np.zeros(2))[3]:
            lengths += 1
        assert lengths == EPISODE_STEPS
        np.testing.assert_array_equal(environment.step(np.zeros(2))[4]["force"], [0.003, 0.001])


@pytest.mark.parametrize("options", [{"force": (1.0,)}, {"force": (np.nan, 0.0)}, {"largest_force": -1.0}])
def test_forces_that_are_not_finite_are_refused(options: dict) -> None:
    with pytest.raises(InputError, match="finite"):
        PointGoalEnvironment(**options)


def test_a_step_needs_a_reset() -> None:
    with pytest.raises(InputError, match="call reset first"):
        PointGoalEnvironment().step(np.zeros(2))


def test_every_speed_is_reported() -> None:
    found = steps_per_second(16, 20, 1)
    assert set(found) == {"simulation", "task", "mujoco", "environment"}
    assert all(0.0 < rate < np.inf for rate in found.values())
    assert found["simulation"] > found["task"]
