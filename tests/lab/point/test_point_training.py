"""Baselines' training: inputs of the policies, the constrained step, the multiplier, files that are left alone."""

import tempfile
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sb3_contrib import TRPO
from torch.distributions import kl_divergence

from safedpa.errors import InputError
from safedpa_lab.experiments.point.baselines import markdown_of
from safedpa_lab.point import baselines, trust_region
from safedpa_lab.point.baseline_set import BaselinePolicy, baseline_named, baselines_in, seeds_of
from safedpa_lab.point.baselines import STANDING_STILL, Multiplier, algorithm_of, evaluate_policy, train_baselines
from safedpa_lab.point.beliefs import weights_named
from safedpa_lab.point.drivers import Wheel, driver_of
from safedpa_lab.point.inputs import OBSERVATION_SCALE, Inputs, WayAhead, entries_of
from safedpa_lab.point.methods import METHODS
from safedpa_lab.point.plan import Plan, score
from safedpa_lab.point.shield import shield_of
from safedpa_lab.point.trust_region import constrained_step
from safedpa_lab.point.vector_environment import PointEnvironment
from safedpa_sim.point.observation import policy_seen
from safedpa_sim.point.route_planner import RoutePlanner
from safedpa_sim.point.simulation import actions_of, controls_of
from safedpa_sim.point.task import PointTask


def environment_of(plan: Plan) -> PointEnvironment:
    return PointEnvironment(PointTask(plan.robots, 0, largest_force=plan.largest_force, stock=plan.stock), 0)


def test_the_fisher_products_are_those_of_the_divergence(monkeypatch: pytest.MonkeyPatch) -> None:
    """After an update whose line search takes no step, so that the policy is still the one of the matrix."""
    monkeypatch.setattr(trust_region, "EVERY", 1)
    plan = Plan(robots=16)
    algorithm = algorithm_of("trpo", environment_of(plan), plan)
    algorithm.line_search_max_iter = 0
    algorithm.learn(1)
    observations = torch.as_tensor(algorithm.rollout_buffer.observations).reshape(-1, 31)
    now = algorithm.policy.get_distribution(observations).distribution
    old = torch.distributions.Normal(now.mean.detach(), now.stddev.detach())
    distance = kl_divergence(now, old).sum(-1).mean()
    objective = algorithm.policy.get_distribution(observations).log_prob(torch.ones(len(observations), 2)).mean()
    parameters, _, gradient, _ = algorithm._compute_actor_grad(distance, objective)
    vector = torch.randn(len(gradient), generator=torch.Generator().manual_seed(1))
    by_graph = TRPO.hessian_vector_product(algorithm, parameters, gradient, vector)
    written_out = algorithm.hessian_vector_product(parameters, gradient, vector)
    torch.testing.assert_close(written_out, by_graph, rtol=1e-3, atol=1e-4)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.floats(-0.05, 0.05))
def test_the_constrained_step_is_the_best_that_a_search_finds(seed: int, excess: float) -> None:
    """Two parameters: the trust region is an ellipse, its best point lies on the edge or where the limit cuts it."""
    random = np.random.default_rng(seed)
    root = random.normal(size=(2, 2)) + 2.0 * np.eye(2)
    matrix, g, b = root @ root.T, random.normal(size=2), random.normal(size=2)
    largest = 0.01

    def solve(vector: torch.Tensor) -> torch.Tensor:
        return torch.as_tensor(np.linalg.solve(matrix, vector.numpy()))

    step = constrained_step(torch.as_tensor(g), torch.as_tensor(b), excess, largest, solve)
    x = step.direction.numpy()
    assert 0.5 * x @ matrix @ x <= largest * 1.001
    angle = np.linspace(0.0, 2.0 * np.pi, 721)
    edge = np.linalg.solve(root.T, np.stack((np.cos(angle), np.sin(angle)))) * np.sqrt(2.0 * largest)
    points = (edge[:, None] * np.linspace(0.0, 1.0, 101)[None, :, None]).reshape(2, -1)
    allowed = excess + b @ points <= 0.0
    if allowed.any():
        assert step.for_reward
        assert excess + b @ x <= 1e-6
        assert g @ x >= (g @ points[:, allowed]).max() - 1e-6
    elif not step.for_reward:
        assert b @ x == pytest.approx((b @ points).min(), abs=1e-4)


def processor_seconds_of_driving(steps: int) -> float:
    """Of the same robots on the same task, which push with nothing and learn nothing: this machine's own pace."""
    task = environment_of(Plan(stock=True)).task
    began = process_time()
    for _ in range(steps // task.count):
        task.observation()
        task.advance(np.zeros((task.count, 2)))
    return process_time() - began


@pytest.mark.long
def test_a_baseline_that_is_there_stays_as_it_is_and_nothing_is_left_elsewhere(tmp_path, tmp_path_factory, monkeypatch):
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    monkeypatch.setattr(tempfile, "tempdir", str(elsewhere))
    few = PointTask(16, 0)
    monkeypatch.setattr(baselines, "evaluate_policy", lambda policy, *_: evaluate_policy(policy, few))
    began = process_time()
    small = {"steps": 16_000}
    first = train_baselines(tmp_path, ["ppo_lagrangian"], ["still"], changes=small)
    used = process_time() - began
    driven_alone = processor_seconds_of_driving(16_000)
    assert 0.0 < first["seed_0/ppo_lagrangian_still"]["processor_seconds"] < min(used + 0.05, 300.0 * driven_alone)
    assert [path.name for path in elsewhere.iterdir() if "torchinductor" not in path.name] == []  # torch's own cache
    written = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "seed_0").iterdir()}
    assert set(written) == {"ppo_lagrangian_still.safetensors"}
    again = train_baselines(tmp_path, ["ppo_lagrangian"], ["still"], changes=small)
    assert all(account["skipped"] for account in again.values())
    assert {path.name: path.stat().st_mtime_ns for path in (tmp_path / "seed_0").iterdir()} == written
    act = baseline_named("ppo_lagrangian_still", tmp_path).act(np.zeros((3, 31), np.float32))
    assert act.shape == (3, 2)
    with pytest.raises(InputError, match="did you mean"):
        train_baselines(tmp_path, ["cppo"])
    with pytest.raises(InputError, match="train-baselines"):
        baseline_named("none_still", tmp_path)


@pytest.mark.long
@pytest.mark.parametrize("known", [[], [30.0, 40.0]])
@pytest.mark.parametrize("limit", [0.0, 36.0])
def test_the_excess_is_ten_times_the_cost_of_a_step_over_its_limit(known, limit, monkeypatch) -> None:
    """By the episodes that ended last, or else by the steps of the rollout."""
    asked: list[float] = []

    def step(*given: Any) -> Any:
        asked.append(given[2])
        return constrained_step(*given)

    monkeypatch.setattr(trust_region, "constrained_step", step)
    plan = Plan(robots=16, limit=limit)
    environment = environment_of(plan)
    algorithm = algorithm_of("cpo", environment, plan)
    environment.costs.extend(known)
    algorithm.learn(1, lambda *_: algorithm.recent_costs.append(environment.cost.copy()) is None)
    mean = 0.035 if known else environment.paid / environment.stepped
    assert (environment.stepped, asked) == (2048, pytest.approx([10.0 * (mean - limit / 1000.0)]))


def test_the_kept_policy_is_the_one_with_the_best_return_and_cost() -> None:
    """An excess of the limit counts as much as return; a cost below it, or of those that heed none, nothing."""
    safe, quick = {"reward": 9.0, "cost": 2.0}, {"reward": 12.0, "cost": 30.0}
    assert score("ppo_lagrangian", safe, 1.0) == pytest.approx(8.0)
    assert score("ppo_lagrangian", safe, 25.0) == pytest.approx(9.0)
    assert (score("cpo", quick, 25.0), score("trpo", quick, 1.0)) == (pytest.approx(7.0), pytest.approx(12.0))


@pytest.mark.long
def test_each_training_seed_has_a_folder_and_each_plan_a_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def judged(policy: BaselinePolicy, *_: object) -> dict[str, float]:
        return {"reward": float(policy.tensors["policy.1.bias"].sum()), "cost": 0.0, "goals": 0.0}

    monkeypatch.setattr(baselines, "evaluate_policy", judged)  # how good they are is not looked at here
    small = {"steps": 4_000, "robots": 16, "inputs": "equal", "limit": 0.5, "cap": 2.0}
    found = train_baselines(tmp_path, ["trpo_lagrangian"], ["wind"], (0, 3), changes=small)
    assert list(found) == [f"seed_{seed}/trpo_lagrangian_wind_equal_0_5" for seed in (0, 3)]
    assert found["seed_3/trpo_lagrangian_wind_equal_0_5"]["plan"]["cap"] == 2.0
    assert seeds_of("trpo_lagrangian_wind_equal_0_5", tmp_path) == (0, 3)
    one, other = (baseline_named("trpo_lagrangian_wind_equal_0_5", tmp_path, seed) for seed in (0, 3))
    assert one.inputs == "equal"
    assert not np.array_equal(one.tensors["policy.0.weight"], other.tensors["policy.0.weight"])
    account = found["seed_0/trpo_lagrangian_wind_equal_0_5"]
    reported = markdown_of(baselines_in(tmp_path, 3))
    assert "| trpo_lagrangian_wind_equal_0_5 | equal | 0.5 |" in reported
    assert reported.rstrip().endswith("| 3 |")
    scores = {row[0]: row[3] for row in account["compared"]}
    assert scores[account["chosen"]["steps"]] == max(scores.values())


FORCE = 0.008


def _task(count: int, seed: int) -> PointTask:
    task = PointTask(count, seed, largest_force=FORCE, paired=True)
    task.simulation.force[:] = FORCE * np.array([[0.6], [-0.8]])
    return task


def test_equal_inputs_are_those_of_safedpas_own_policy() -> None:
    """One road: the inputs, of the motors' controls. The other: shield, histories, ways and scales, one by one."""
    task, weights = _task(6, 3), weights_named("learned")
    inputs, shield, ways = Inputs("equal", task), shield_of("none", task), RoutePlanner(6)
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
        assert entries_of(kind) == Inputs(kind, task).see().shape[1] == size
    np.testing.assert_allclose(Inputs("lidar", task).see(), task.observation() / OBSERVATION_SCALE, rtol=1e-6)


def test_robots_that_begin_again_know_nothing_of_their_wind() -> None:
    task = _task(4, 5)
    inputs, fresh = Inputs("latent", task), Inputs("latent", _task(4, 5)).see()[:, -2:]
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
    """Reckless robots that start next to hazards pay without it, and nothing with it."""
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


def _rollouts(plan: Plan, episode_costs: list[float], returns: float) -> list[float]:
    """The weights after rollouts of such costs, while episodes gain ``returns``."""
    environment = PointEnvironment(PointTask(2, 0))
    environment.returns.append(returns)
    multiplier, weights = Multiplier(environment, plan, rate=0.01), []
    for cost in episode_costs:
        multiplier.on_rollout_start()
        environment.paid, environment.stepped = 5.0 * cost, 5_000
        multiplier.on_rollout_end()
        weights.append(environment.weight)
    return weights


def test_the_integral_grows_with_the_excess_and_never_below_nothing() -> None:
    plan = Plan(limit=25.0, multiplier="integral")
    assert _rollouts(plan, [35.0, 35.0, 5.0, 5.0], -9.0) == pytest.approx([0.1, 0.2, 0.0, 0.0])


def test_it_has_no_cap_unless_one_is_asked_for() -> None:
    long = [100.0] * 40
    assert _rollouts(Plan(limit=0.0, multiplier="integral"), long, 0.0)[-1] == pytest.approx(40.0)
    assert _rollouts(Plan(limit=0.0, multiplier="integral", cap=1.0), long, 0.0)[-1] == 1.0


def test_a_waiting_multiplier_does_not_wind_up_while_nothing_is_gained() -> None:
    plan = Plan(limit=1.0, multiplier="waiting")
    assert _rollouts(plan, [80.0] * 50, STANDING_STILL - 0.1) == [0.0] * 50
    assert _rollouts(plan, [80.0] * 2, STANDING_STILL + 0.1) == pytest.approx([0.79, 1.58])


def test_the_proportional_part_falls_back_with_the_cost() -> None:
    """After a long high cost the controller lets go sooner than its integral."""
    costs = [50.0] * 20 + [10.0] * 30
    plan = Plan(limit=20.0, multiplier="pid")
    controlled = _rollouts(plan, costs, 5.0)
    integral = _rollouts(Plan(limit=20.0, multiplier="integral"), costs, 5.0)
    assert controlled[0] > integral[0], "a sudden cost is answered at once"
    assert controlled[19] > integral[19]
    assert controlled[-1] < integral[-1]
    assert min(controlled) >= 0.0


@pytest.mark.parametrize(
    ("mistaken", "reported"),
    [
        (lambda: Plan(multiplier="pdi"), "multiplier 'pdi'"), (lambda: Plan(inputs="camera"), "inputs 'camera'"),
        (lambda: Inputs("radar", PointTask(1, 0)), "inputs 'radar'"),
        (lambda: driver_of(METHODS["mix"], PointTask(1, 0), Wheel(margins={"safedpa": 0.002})),
         "got no margin for the filter 'mix'"),
    ],
)  # fmt: skip
def test_unknown_multipliers_and_inputs_and_a_filter_without_a_margin_are_refused(mistaken, reported) -> None:
    with pytest.raises(InputError, match=reported):
        mistaken()
