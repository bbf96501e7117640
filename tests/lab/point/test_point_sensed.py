"""The sensed state of 15 numbers: decoding, its slopes, training in small, the filter that believes it."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from safedpa.errors import InputError
from safedpa.networks import load_weights
from safedpa_lab.point.beliefs import from_task_action
from safedpa_lab.point.driven import driven, windy_task
from safedpa_lab.point.drivers import ShieldedDriver, Wheel, driver_of
from safedpa_lab.point.methods import METHODS
from safedpa_lab.point.sensed_belief import sensed_weights
from safedpa_lab.point.shield import shield_of
from safedpa_sim.point.belief import to_task_action
from safedpa_sim.point.body import POINT_BODY
from safedpa_sim.point.body_steps import centre_state
from safedpa_sim.point.sensed import ENTRIES, GROUPS, decoded, decoding_slopes, sensed, without_goal
from safedpa_sim.point.simulation import PointSimulation
from safedpa_sim.point.task import PointTask
from safedpa_sim.training.configuration import Phase1a, Phase2, load_configuration
from safedpa_sim.training.pipeline import run_pipeline
from safedpa_sim.training.sensed_training import draw_sensed
from safedpa_sim.training.simulator import BatchedCars

NOWHERE = Path("no weights here")


def _robots(count: int, seed: int) -> tuple[PointSimulation, np.ndarray, np.ndarray]:
    random, simulation = np.random.default_rng(seed), PointSimulation(count)
    simulation.pose[:2] = random.uniform(-1.5, 1.5, (2, count))
    simulation.pose[2] = random.uniform(-9.0, 9.0, count)
    simulation.velocity[:] = random.uniform(-3.0, 3.0, (3, count))
    simulation.force[:] = random.uniform(-0.008, 0.008, (2, count))
    goal = random.uniform(-1.5, 1.5, (count, 2))
    return simulation, random.uniform(-0.05, 0.05, (2, count)), goal


def test_decoding_what_is_sensed_gives_the_state_back() -> None:
    simulation, control, goal = _robots(500, 1)
    found, state = decoded(sensed(simulation, control, goal), goal), centre_state(simulation)
    turns = (found[:, 2] - state[:, 2]) / (2.0 * np.pi)
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-9)
    np.testing.assert_allclose(np.delete(found, 2, axis=1), np.delete(state, 2, axis=1), atol=1e-9)


def test_slopes_of_the_decoding_are_its_differences() -> None:
    simulation, control, goal = _robots(50, 2)
    seen = sensed(simulation, control, goal) + 0.02 * np.random.default_rng(3).normal(size=(50, len(ENTRIES)))
    slopes, nudge = decoding_slopes(seen), 1e-6
    assert slopes.shape == (50, 5, 15)
    for entry in range(len(ENTRIES)):
        step = nudge * np.eye(len(ENTRIES))[entry]
        apart = decoded(seen + step, goal) - decoded(seen - step, goal)
        apart[:, 2] = (apart[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
        np.testing.assert_allclose(slopes[..., entry], apart / (2.0 * nudge), atol=1e-6)


def test_the_sensed_state_is_what_the_benchmark_observes_without_its_lidar() -> None:
    task = PointTask(6, 4, largest_force=0.008)
    for _ in range(5):
        task.advance(np.full((6, 2), 0.4))
    seen = sensed(task.simulation, task.control, task.layout.goal)
    np.testing.assert_array_equal(seen, task.observation()[:, :15])
    kept = without_goal(seen)
    np.testing.assert_array_equal(kept[:, :12], seen[:, :12])
    assert not kept[:, 12:].any()
    assert [part for group in GROUPS.values() for part in range(15)[group]] == list(range(15))


def test_pairs_are_steps_of_the_body_with_goals_all_over_the_field() -> None:
    cars = BatchedCars(load_configuration("point_small"))
    environment, state, action, change = draw_sensed(cars, 4000, cars.generator(5))
    distance = state[:, 14].numpy()
    assert distance.min() >= 0.299
    assert distance.max() > 3.0
    assert change[:, [2, 5, 6, 7, 11]].abs().max() == 0.0, "gravity and what lies in the plane's normal"
    nothing = np.zeros((len(state), 2))
    before, after = (decoded(seen.double().numpy(), nothing) for seen in (state, state + change))
    moved = np.linalg.norm(after[:, :2] - before[:, :2] - 0.02 * before[:, 3:], axis=1)
    assert np.quantile(moved, 0.99) < 0.003, "one period of motion, whatever the goal"
    turned = (after[:, 2] - before[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
    assert np.corrcoef(turned, action[:, 1].numpy())[0, 1] > 0.95
    assert environment.abs().max() <= 1.6


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("sensed")
    small = load_configuration("point_small")
    steps = Phase1a(pairs=60_000, batch=512, learning_rate=1e-3, last_learning_rate=1e-5, hidden=48)
    drives = Phase2(rounds=2, cars=60, steps=90, updates=60, batch=256)
    configuration = dataclasses.replace(small, phase_1a=steps, phase_2=drives)
    record = run_pipeline(configuration, folder, ["17"])["17"]
    assert run_pipeline(configuration, folder, ["17"])["17"]["skipped"]
    return folder, record


@pytest.mark.long
def test_training_in_small_explains_what_is_sensed(trained: tuple[Path, dict[str, Any]]) -> None:
    folder, record = trained
    by_entry = dict(zip(record["entries"], record["explained"], strict=True))
    assert by_entry["accelerometer_z"] is None
    assert min(by_entry[name] for name in ("velocimeter_x", "gyro_z", "magnetometer_x", "compass_left")) > 0.4
    assert len(record["explained_latents"]) == 2
    weights = load_weights(folder / "point_17.safetensors")
    assert weights.description.states == ENTRIES
    assert all(weights.has(name) for name in ("mu", "f", "g", "phi"))
    assert not (folder / "point_17.toml").exists(), "no model of the robot's own state"
    assert sensed_weights(folder).digest == weights.digest


@pytest.mark.long
def test_weights_of_another_state_are_refused(tmp_path: Path, trained: tuple[Path, dict[str, Any]]) -> None:
    from safedpa.networks import save_weights
    from safedpa_lab.point.weights import weights_named

    save_weights(weights_named("learned"), tmp_path / "point_17.safetensors")
    with pytest.raises(InputError, match=r"point_17.*another state"):
        sensed_weights(tmp_path)
    shutil.copy(trained[0] / "point_17.safetensors", tmp_path)
    assert sensed_weights(tmp_path).has("phi")


def test_what_is_believed_is_what_the_body_does_and_the_wind_that_blows() -> None:
    """Also just after goals were put elsewhere: phi does not see them."""
    task, random = windy_task(24, 1, 0.008, 3), np.random.default_rng(6)
    shield = shield_of("safedpa_17", task, epsilon=0.004)
    for step in range(80):
        if step % 10 == 0:
            wish = random.uniform(-1.0, 1.0, (24, 2)) * (1.0, 0.3)
        shield.see(task)
        shield.acted(from_task_action(wish))
        task.advance(wish)
    believed = shield.believes(task)
    assert believed.drift.shape == (24, 5)
    assert believed.gain.shape == (24, 5, 2)
    action = np.random.default_rng(8).uniform(-1.0, 1.0, (24, 2))
    predicted = believed.next_state(action)
    task.advance(to_task_action(action))
    error = np.abs(predicted - centre_state(task.simulation))
    assert np.median(error[:, :2].max(axis=1)) < 0.003
    assert np.median(error[:, 2]) < 0.01
    assert np.median(error[:, 3:].max(axis=1)) < 0.01
    wind = task.simulation.force / POINT_BODY.mass
    assert np.median(np.abs(believed.motion.wind - wind)) < 0.1
    strongest = POINT_BODY.largest_thrust / POINT_BODY.mass
    assert np.median(believed.motion.strongest) == pytest.approx(strongest, rel=0.03)


@pytest.mark.long
def test_the_method_drives_safer_than_without_a_filter() -> None:
    found = {}
    for name in ("unfiltered", "safedpa_17"):
        task = windy_task(8, 1, 0.008, 2)
        found[name] = driven(driver_of(METHODS[name], task, Wheel(NOWHERE, margins={"safedpa_17": 0.005})), task, 200)
    assert found["safedpa_17"].cost.sum() < found["unfiltered"].cost.sum()
    assert found["safedpa_17"].corrected > 0.0
    assert found["safedpa_17"].goals.sum() >= 4.0


def test_the_policy_sees_the_same_behind_the_filter_of_five_states() -> None:
    told = []
    for name in ("safedpa", "safedpa_17"):
        task = windy_task(3, 1, 0.008, 9)
        driver = driver_of(METHODS[name], task, Wheel(NOWHERE, margins={name: 0.01}))
        assert isinstance(driver, ShieldedDriver)
        for _ in range(40):
            told.append(driver.shield.see(task).copy())
            driver.shield.acted(np.full((3, 2), 0.3))
            task.advance(np.full((3, 2), 0.3))
    np.testing.assert_array_equal(told[:40], told[40:])
    assert np.abs(told[39]).max() > 0.0
    assert METHODS["safedpa_17"].policy == METHODS["safedpa"].policy
