"""What policies are told: the same numbers as SafeDPA's own policy, by another road; reward and filter in training."""

from __future__ import annotations

import numpy as np
import pytest

from safedpa.errors import InputError
from safedpa_lab.point.drivers import Wheel, driver_of
from safedpa_lab.point.inputs import OBSERVATION_SCALE, WayAhead, entries_of, inputs_of
from safedpa_lab.point.methods import METHODS
from safedpa_lab.point.shield import shield_of
from safedpa_lab.point.vector_environment import PointEnvironment
from safedpa_lab.point.weights import weights_named
from safedpa_sim.point.body_steps import actions_of, controls_of
from safedpa_sim.point.observation import policy_seen
from safedpa_sim.point.task import PointTask
from safedpa_sim.point.way import Ways

FORCE = 0.008


def _task(count: int, seed: int) -> PointTask:
    task = PointTask(count, seed, largest_force=FORCE, paired=True)
    task.simulation.force[:] = FORCE * np.array([[0.6], [-0.8]])
    return task


def test_equal_inputs_are_those_of_safedpas_own_policy() -> None:
    """One road: the inputs, of the motors' controls. The other: shield, histories, ways and scales, one by one."""
    task, weights = _task(6, 3), weights_named("learned")
    inputs, shield, ways = inputs_of("equal", task), shield_of("none", task), Ways(6)
    random = np.random.default_rng(0)
    for _ in range(70):
        seen, latent = inputs.see(), shield.see(task)
        turn, _ = ways.first_turns(task.simulation.pose[:2].T, task.layout.hazards, task.layout.goal)
        other = (policy_seen(task, latent, turn) - weights["observation_middle"]) / weights["observation_scale"]
        np.testing.assert_allclose(seen, other.clip(-10.0, 10.0), atol=1e-4)
        chosen = shield.act(task, random.uniform(-1.0, 1.0, (6, 2)))
        task.advance(chosen.action)
    assert np.abs(latent).max() > 0.1, "the wind is known by now"


def test_each_kind_has_its_entries_and_the_lidar_is_the_benchmarks() -> None:
    task = _task(3, 1)
    for kind, size in (("lidar", 31), ("latent", 37), ("equal", 43)):
        assert entries_of(kind) == inputs_of(kind, task).see().shape[1] == size
    np.testing.assert_allclose(inputs_of("lidar", task).see(), task.observation() / OBSERVATION_SCALE, rtol=1e-6)
    with pytest.raises(InputError, match="inputs 'radar'"):
        inputs_of("radar", task)


def test_robots_that_begin_again_know_nothing_of_their_wind() -> None:
    task = _task(4, 5)
    inputs, fresh = inputs_of("latent", task), inputs_of("latent", _task(4, 5)).see()[:, -2:]
    for _ in range(60):
        seen = inputs.see()
        task.advance(np.full((4, 2), 0.3))
    assert np.abs(seen[:, -2:] - fresh).min() > 1e-3
    inputs.reset(np.array([1, 2]))
    task.restart(np.array([1, 2]))
    later = inputs.see()[:, -2:]
    np.testing.assert_allclose(later[1:3], fresh[1:3], atol=1e-5)
    assert np.abs(later[[0, 3]] - fresh[[0, 3]]).min() > 1e-3


def test_motors_do_no_more_than_they_can_whatever_the_control() -> None:
    action = np.array([[0.015, 3.0], [-0.006, -1.2]])
    np.testing.assert_allclose(actions_of(controls_of(action)), action, rtol=1e-9)
    np.testing.assert_allclose(actions_of(np.array([[1.0], [1.0]])), [[0.015, 3.0]], rtol=1e-9)


def test_what_is_gained_along_the_way_adds_up_to_its_length() -> None:
    """Straight on where nothing is between: as much as the benchmark's reward; a goal counts 1."""
    task = PointTask(40, 2)
    way = WayAhead(task)
    straight = np.linalg.norm(way.turn - task.layout.goal, axis=1) < 1e-5
    before = way.left.copy()
    stepped = task.advance(np.tile([1.0, 0.0], (40, 1)))
    gained = way.gained(stepped.reached)
    still = straight & (np.linalg.norm(way.turn - task.layout.goal, axis=1) < 1e-5) & ~stepped.reached
    assert still.sum() > 5
    np.testing.assert_allclose(gained[still], stepped.reward[still], atol=1e-5)
    np.testing.assert_allclose(gained[~stepped.reached], (before - way.left)[~stepped.reached], atol=1e-6)


@pytest.mark.long
def test_in_training_the_filter_takes_over_when_it_is_time() -> None:
    """Reckless robots that start beside hazards pay without it, and nothing with it."""
    paid = {}
    for filtered in (False, True):
        environment = PointEnvironment(PointTask(4, 4), 4, "latent")
        environment.filtered = filtered
        environment.reset()
        for _ in range(60):
            environment.step(np.tile(np.float32([1.0, 0.1]), (4, 1)))
        paid[filtered] = environment.paid
    assert paid[True] == 0.0
    assert paid[False] > 5.0
    assert environment.episode_cost == 0.0


def test_a_filter_without_a_margin_is_refused() -> None:
    with pytest.raises(InputError, match="got no margin for the filter 'mix'"):
        driver_of(METHODS["mix"], PointTask(1, 0), Wheel(margins={"safedpa": 0.002}))
