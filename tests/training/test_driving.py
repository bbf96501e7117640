"""The car's policy task: solvable scenes, solid obstacles, and rewards for reaching the goal."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from safedpa.networks import Weights
from safedpa.robots.car.barriers.obstacles import car_barriers
from safedpa.safety import SafetyFilter, Status
from safedpa.safety.defaults import settings_named
from safedpa_sim.training.configuration import Configuration, load_configuration
from safedpa_sim.training.environments.batched_simulator import BatchedSimulator
from safedpa_sim.training.environments.car_scenes import MOST_OBSTACLES, draw_scenes
from safedpa_sim.training.environments.car_task import EPISODE_TICKS, DrivingTask, TrainingFilter
from safedpa_sim.training.environments.vector_environment import VectorEnvironment

CARS = 64


@pytest.fixture(scope="module")
def configuration() -> Configuration:
    return load_configuration("car_small")


@pytest.fixture(scope="module")
def weights(configuration: Configuration, untrained: Callable[[Configuration], Weights]) -> Weights:
    return untrained(configuration)


def straight(driving: DrivingTask, speed: float) -> np.ndarray:
    """Returns actions for a speed [m/s] straight ahead."""
    chosen = np.zeros((driving.count, 2), dtype=np.float32)
    chosen[:, 0] = (speed - 0.7) / 1.3
    return chosen


def room(driving: DrivingTask) -> np.ndarray:
    """Returns the distance [m] from each car to the nearest obstacle or wall, negative inside."""
    (x, y, yaw), scene = driving.state.T[:3], driving.scene
    rear, front, radius = scene.footprint.T
    ahead = np.exp(1j * yaw)
    towards = (scene.obstacles[..., 0] + 1j * scene.obstacles[..., 1] - (x + 1j * y)[:, None]) * ahead.conj()[:, None]
    along = towards.real.clip(-rear[:, None], front[:, None])
    least = (np.abs(towards - along) - scene.obstacles[..., 2] - radius[:, None]).min(axis=1)
    for end in (-rear, front):
        tip = x + 1j * y + end * ahead
        for part, low, high in ((tip.real, 0, 1), (tip.imag, 2, 3)):
            walls = np.minimum(part - scene.field[:, low], scene.field[:, high] - part) - radius
            least = np.minimum(least, walls)
    return np.asarray(least)


def test_scenes_leave_passages_and_free_starts_and_goals() -> None:
    pool = draw_scenes(np.random.default_rng(3), 400)
    there = pool.obstacles[..., 2] > 0.0
    assert pool.obstacles.shape == (400, MOST_OBSTACLES, 3)
    assert set(there.sum(axis=1).tolist()) >= {0, 1, 2, 3, 4, 5}
    for index in range(400):
        radius, placed = pool.footprint[index, 2], pool.obstacles[index][there[index]]
        for number, (x, y, size) in enumerate(placed):
            for other_x, other_y, other in placed[:number]:
                assert np.hypot(x - other_x, y - other_y) - size - other >= 2 * radius + 0.4 - 1e-4
            for place in (pool.start[index, :2], pool.goal[index]):
                assert np.hypot(*(place - (x, y))) >= size + radius + 0.35 - 1e-4
        assert (np.abs(pool.goal[index]) < pool.field[index, 1] - radius - 0.5).all()
        assert np.hypot(*(pool.goal[index] - pool.start[index, :2])) >= 2.0 - 1e-4


def test_many_routes_are_obstructed_and_every_footprint_occurs() -> None:
    pool = draw_scenes(np.random.default_rng(4), 400)
    way = pool.goal - pool.start[:, :2]
    length = np.hypot(way[:, 0], way[:, 1])[:, np.newaxis]
    offset = pool.obstacles[..., :2] - pool.start[:, np.newaxis, :2]
    across = np.abs(offset[..., 0] * way[:, 1:] - offset[..., 1] * way[:, :1]) / length
    along = (offset * way[:, np.newaxis]).sum(axis=-1) / length
    hit = (across < pool.obstacles[..., 2] + pool.footprint[:, 2:]) & (along > 0.0) & (along < length)
    assert hit.any(axis=1).mean() > 0.6
    assert pool.footprint[:, 2].min() == pytest.approx(0.12)
    assert pool.footprint[:, 2].max() == pytest.approx(0.45)


def test_the_same_seed_gives_the_same_drives(configuration: Configuration, weights: Weights) -> None:
    ends = []
    for _ in range(2):
        driving = DrivingTask(configuration, weights, 8, 5)
        for _ in range(20):
            driving.advance(straight(driving, 1.0))
        ends.append(driving.state.copy())
    np.testing.assert_array_equal(*ends)
    assert not np.array_equal(ends[0], DrivingTask(configuration, weights, 8, 6).state)


def test_cars_do_not_drive_through_obstacles_or_walls(configuration: Configuration, weights: Weights) -> None:
    driving = DrivingTask(configuration, weights, CARS, 1, with_filter=False)
    touched = np.zeros(CARS, dtype=bool)
    random = np.random.default_rng(2)
    for _ in range(150):
        chosen = straight(driving, 2.0)
        chosen[:, 1] = random.uniform(-1.0, 1.0)
        touched |= driving.advance(chosen).contact
        assert room(driving).min() > -0.08, "no deeper in anything than a corner between two can push it"
    assert touched.mean() > 0.8


def test_the_filter_keeps_straight_drives_from_contact(configuration: Configuration, weights: Weights) -> None:
    contacts = {}
    for with_filter in (True, False):
        driving = DrivingTask(configuration, weights, CARS, 3, with_filter=with_filter, calm=True)
        contacts[with_filter] = sum(int(driving.advance(straight(driving, 2.0)).began.sum()) for _ in range(100))
    assert contacts[False] > CARS / 2
    assert contacts[True] <= 0.4 * contacts[False], (
        "what is left: heavy loads that brake worse than the filter reckons with"
    )


def test_training_uses_the_batched_safety_filter(configuration, weights, monkeypatch) -> None:
    """Each car gets the action of ``SafetyFilter`` with a margin of eta times the retained distance."""
    asked_of: list[tuple[np.ndarray, ...]] = []
    decide = TrainingFilter.decide

    def watched(self: TrainingFilter, *given: Any) -> np.ndarray:
        asked_of.append(given)
        return decide(self, *given)

    monkeypatch.setattr(TrainingFilter, "decide", watched)
    driving = DrivingTask(configuration, weights, CARS, 7)
    chosen = settings_named("car").with_barriers(clearance=0.0)
    alone, corrected = SafetyFilter.for_model(BatchedSimulator(configuration).model, chosen), 0
    for _ in range(60):
        before, nominal, environment = driving.state.copy(), straight(driving, 2.0), driving.environment.copy()
        driving.advance(nominal)
    scene, asked = driving.scene, weights["action_middle"] + weights["action_scale"] * nominal
    retained = asked_of[-1][-1]
    assert (retained.min() > 0.05, retained.max() < 0.19, retained.std() > 0.02) == (True, True, True)
    for car in range(CARS):
        rear, front, radius = scene.footprint[car].astype(float)
        body = (rear + 0.15 * (radius > 0.13), front, radius)
        around = car_barriers(chosen, body, scene.obstacles[car], scene.field[car].tolist())
        margin = chosen.eta * float(retained[car])
        margins = {"obstacle": margin, "field": margin, "speed": 0.0}
        verdict = alone.decide(before[car], asked[car], environment[car], barriers=around, epsilon=margins)
        np.testing.assert_allclose(driving.applied[car], verdict.action, atol=2e-5)
        corrected += verdict.status is not Status.passed
    assert corrected > CARS / 4


def test_progress_is_rewarded_and_contact_costs_the_given_penalty(configuration, weights) -> None:
    rewards = {}
    for penalty in (0.0, 7.0):
        driving = DrivingTask(configuration, weights, CARS, 1, penalty=penalty, with_filter=False, calm=True)
        moves = [driving.advance(straight(driving, 2.0)) for _ in range(60)]
        rewards[penalty] = sum(move.reward for move in moves), sum(move.began for move in moves)
    (plain, began), (punished, same) = rewards[0.0], rewards[7.0]
    np.testing.assert_array_equal(began, same)
    np.testing.assert_allclose(plain - punished, 7.0 * began, rtol=1e-4, atol=1e-4)

    driving = DrivingTask(configuration, weights, CARS, 9, calm=True)
    before = np.hypot(*(driving.scene.goal - driving.state[:, :2]).T)
    total = sum(driving.advance(straight(driving, 1.0)).reward for _ in range(10))
    gained = before - np.hypot(*(driving.scene.goal - driving.state[:, :2]).T)
    assert np.corrcoef(total, gained)[0, 1] > 0.95


def test_a_car_within_the_goals_radius_has_reached_it(configuration: Configuration, weights: Weights) -> None:
    driving = DrivingTask(configuration, weights, 4, 2, calm=True)
    driving.scene.goal[:2] = driving.state[:2, :2] + 0.1
    moved = driving.advance(straight(driving, 0.0))
    assert moved.reached.tolist() == [True, True, False, False]
    assert (moved.reward[:2] > 4.0).all()
    assert (moved.reward[2:] < 1.0).all()


def test_environments_change_during_drives_unless_calm(configuration: Configuration, weights: Weights) -> None:
    changed = {}
    for calm in (True, False):
        driving = DrivingTask(configuration, weights, CARS, 4, calm=calm)
        first, latent = driving.environment.copy(), driving.latent.copy()
        for _ in range(60):
            driving.advance(straight(driving, 0.5))
        others = (driving.environment != first).any(axis=1)
        np.testing.assert_array_equal((driving.latent != latent).any(axis=1), others)
        changed[calm] = int(others.sum())
    assert changed[True] == 0
    assert 2 <= changed[False] <= 30


def test_the_vector_environment_restarts_and_reports_the_last_observation(configuration, weights) -> None:
    driving = DrivingTask(configuration, weights, 4, 2)
    length = driving.observation().shape[1]
    environment = VectorEnvironment(driving, np.zeros(length, np.float32), np.full(length, 2.0, np.float32))
    np.testing.assert_allclose(environment.reset(), driving.observation() / 2.0)
    driving.scene.goal[0] = driving.state[0, :2] + 0.05
    driving.tick[1] = EPISODE_TICKS - 1
    observation, reward, ended, notes = environment.step(straight(driving, 0.0))
    assert ended.tolist() == [True, True, False, False]
    assert reward[0] > 4.0
    assert [note.get("TimeLimit.truncated") for note in notes] == [False, True, None, None]
    assert driving.tick.tolist() == [0, 0, 1, 1]
    assert not np.array_equal(notes[0]["terminal_observation"], observation[0])
    np.testing.assert_allclose(observation, driving.observation() / 2.0)
    assert (environment.reached, environment.ended) == (1, 2)
