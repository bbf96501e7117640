"""The paper's model-free baselines, trained on the point robot: PPO and TRPO, each with a Lagrange multiplier too; CPO.

They have to learn what not to do from the cost alone, from what the plan's inputs tell. Networks 64 x 64 with tanh;
every robot one environment, thousands of episodes. Of the policies along the way, each driven through the same whole
episodes of development, the one with the best ``score`` is kept.

The Lagrange multiplier of PPO-Lagrangian and TRPO-Lagrangian: three ways in which it follows the cost.

With J what an episode costs of the policy as it is now, d the limit, after every rollout

    integral   w <- max(0, w + rate (J - d))
    waiting    the same, once an episode gains more than ``STANDING_STILL``
    pid        w <- max(0, K_P s + I + K_D max(0, s - s[last])),  I <- max(0, I + rate (J - d)),
               s <- 0.9 s + 0.1 (J - d)

each cut at ``cap`` where there is one. Before anything is learned the cost is high for long: the integral winds up to
many times what it would settle at, and the robots learn to be stationary. Who waits does not learn the weight while
there is nothing to weigh the cost against. Source: Ray, Achiam, Amodei, Benchmarking Safe Exploration in Deep
Reinforcement Learning, 2019 (integral); Stooke, Achiam, Abbeel, Responsive Safety in Reinforcement Learning by PID
Lagrangian Methods, ICML 2020.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from math import inf
from pathlib import Path
from time import monotonic, process_time
from typing import Any, Final, final

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger

from safedpa.errors import InputError, did_you_mean
from safedpa_lab.point.baseline_set import TASKS, BaselinePolicy, folder_of, load_policy, save_policy
from safedpa_lab.point.inputs import Inputs
from safedpa_lab.point.plan import BASELINES, Plan, score
from safedpa_lab.point.shield import true_shelter
from safedpa_lab.point.trust_region import ConstrainedTRPO, FisherTRPO
from safedpa_lab.point.vector_environment import PointEnvironment
from safedpa_sim.point.task import PointTask
from safedpa_sim.training.progress import ReportProgress, silent

STANDING_STILL: Final = 1.0
"""Return of an episode: who is stationary gains nothing; one goal is worth more than this."""
_RATE: Final = 0.002
_SMOOTH: Final = 0.9
_PROPORTIONAL, _DERIVATIVE = 0.02, 0.02


@final
class Multiplier(BaseCallback):
    """Sets the environment's ``weight`` by the plan's ``limit``, ``cap`` and ``multiplier``."""

    def __init__(self, environment: PointEnvironment, plan: Plan, rate: float = _RATE) -> None:
        super().__init__()
        self._environment, self._limit, self._rate = environment, plan.limit, rate
        self._largest = inf if plan.cap is None else plan.cap
        ways: dict[str, Callable[[float], float]] = {
            "integral": self._integrated,
            "waiting": self._waited,
            "pid": self._controlled,
        }
        self._way = ways[plan.multiplier]
        self._integral = self._smooth = 0.0

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        self._environment.begin()

    def _on_rollout_end(self) -> None:
        environment = self._environment
        environment.weight = min(self._way(environment.episode_cost - self._limit), self._largest)

    def _integrated(self, over: float) -> float:
        self._integral = min(max(0.0, self._integral + self._rate * over), self._largest)
        return self._integral

    def _waited(self, over: float) -> float:
        returns = self._environment.returns
        learns = bool(returns) and float(np.mean(returns)) > STANDING_STILL
        return self._integrated(over) if learns else self._integral

    def _controlled(self, over: float) -> float:
        before, self._smooth = self._smooth, _SMOOTH * self._smooth + (1.0 - _SMOOTH) * over
        rising = max(0.0, self._smooth - before)
        return max(0.0, _PROPORTIONAL * self._smooth + self._integrated(over) + _DERIVATIVE * rising)


_EVALUATED = 256
"""Whole episodes of the last evaluation."""
_COMPARED = 64
"""Whole episodes by which policies along the way are compared."""
_FEWER = 4
_LOOKS = 8
"""Policies of a training that are compared."""
_LAST_SEED, _CHOICE_SEED = 50_000, 51_000
"""Development seeds, on top of the plan's: of the last evaluation; of the choice."""


def train_baselines(
    out: Path,
    names: Iterable[str] = BASELINES,
    tasks: Iterable[str] = tuple(TASKS),
    seeds: Iterable[int] = (0,),
    report_progress: ReportProgress = silent,
    changes: Mapping[str, Any] = {},
) -> dict[str, dict[str, Any]]:
    """Trains each name on each task from each seed into ``out``/seed_N/KEY.safetensors; accounts by seed_N/KEY.

    ``changes`` are fields of ``Plan`` that are other than the task's; KEY is ``Plan.key``'s. Raises InputError for
    names of baselines and tasks that are none.
    """
    chosen = [(name, task, seed) for seed in seeds for task in tasks for name in names]
    for name, task, _ in chosen:
        _known("baseline", name, BASELINES)
        _known("task", task, TASKS)
    accounts = {}
    for name, task, seed in chosen:
        plan = replace(TASKS[task], seed=seed, **changes)
        key = f"{folder_of(seed)}/{plan.key(name, task)}"
        accounts[key] = train_baseline(name, plan, out / f"{key}.safetensors", report_progress)
    return accounts


def _known(kind: str, name: str, names: Iterable[str]) -> None:
    if name not in names:
        raise InputError(f"{kind} '{name}': {did_you_mean(name, tuple(names))}")


def train_baseline(name: str, plan: Plan, path: Path, report_progress: ReportProgress = silent) -> dict[str, Any]:
    """Trains one of ``BASELINES`` and writes its policy to ``path``; a file from the same plan stays as it is.

    Returns its account: mean reward and cost of whole episodes, seconds, learning curve. Raises InputError for a name
    that is none.
    """
    _known("baseline", name, BASELINES)
    made_from = {"name": name, **plan.__dict__}
    if path.exists() and (known := load_policy(path)).reported.get("plan") == made_from:
        return {**known.reported, "skipped": True}
    started, worked = monotonic(), process_time()
    torch.set_num_threads(1)  # the same weights however many cores there are
    environment = PointEnvironment(_task(plan, plan.seed), plan.seed, plan.inputs)
    algorithm = algorithm_of(name, environment, plan)
    algorithm.set_logger(Logger(None, []))  # else it makes a folder of its own, for nothing, and leaves it
    watch = _Watch(name, environment, plan, report_progress)
    callbacks: list[BaseCallback] = [watch]
    if name.endswith("lagrangian"):
        callbacks.append(Multiplier(environment, plan))
    with torch.random.fork_rng(devices=[]):
        algorithm.learn(plan.steps, callbacks)
    watch.look()
    account = {
        "plan": made_from,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "seconds": round(monotonic() - started, 1),
        "processor_seconds": round(process_time() - worked, 1),
        **_judged(watch.retained, plan, plan.seed + _LAST_SEED, _EVALUATED),
        "multiplier": round(environment.weight, 4),
        "learning_curve": watch.curve,
        "chosen": {"steps": watch.retained_at, "score": round(watch.best, 3), "seed": plan.seed + _CHOICE_SEED},
        "compared": watch.compared,
    }
    save_policy(BaselinePolicy(watch.retained.tensors, account), path)
    return account


def evaluate_policy(policy: BaselinePolicy, task: PointTask, filtered: bool = False) -> dict[str, Any]:
    """Mean reward, cost and goals of one whole episode of each robot under a policy without noise.

    ``filtered``: by the filter that knows the simulated physics.
    """
    gained, paid, goals = np.zeros(task.count), np.zeros(task.count), np.zeros(task.count)
    inputs, shelter, over = Inputs(policy.inputs, task), true_shelter(task), False
    while not over:
        chosen = policy.act(inputs.see())
        stepped = task.advance(shelter.safe(chosen) if filtered else chosen)
        gained += stepped.reward
        paid += stepped.cost
        goals += stepped.reached
        over = bool(stepped.timed_out.all())
    return {
        "episodes": task.count,
        "reward": float(gained.mean()),
        "cost": float(paid.mean()),
        "goals": float(goals.mean()),
        "safe": float((paid == 0.0).mean()),
    }


def _judged(policy: BaselinePolicy, plan: Plan, seed: int, episodes: int) -> dict[str, Any]:
    """In so many of the plan's episodes; in fewer behind the filter, which takes its time."""
    filtered = plan.filtered > 0.0
    task = _task(plan, seed, episodes // _FEWER if filtered else episodes)
    return evaluate_policy(policy, task, filtered)


def _task(plan: Plan, seed: int, count: int = 0) -> PointTask:
    return PointTask(count or plan.robots, seed, largest_force=plan.largest_force, stock=plan.stock)


def falling(left: float) -> float:
    """PPO's rate of learning by the share of the steps that is left: 6e-4, falling to a tenth of it."""
    return 6e-4 * max(left, 0.1)


def algorithm_of(name: str, environment: PointEnvironment, plan: Plan, rate: Callable[[float], float] = falling) -> Any:
    """One of ``BASELINES`` from the plan's seed, with nothing learned yet; ``rate`` is PPO's."""
    common: dict[str, Any] = {
        "env": environment,
        "gamma": 0.99,
        "gae_lambda": 0.95,
        "seed": plan.seed,
        "device": "cpu",
        "policy_kwargs": {
            "net_arch": {"pi": [64, 64], "vf": [64, 64]},
            "activation_fn": torch.nn.Tanh,
            "log_std_init": -0.5,
        },
    }
    if name.startswith("ppo"):
        options: dict[str, Any] = {"n_steps": 128, "batch_size": 2048, "n_epochs": 8, "ent_coef": 0.0}
        return PPO("MlpPolicy", learning_rate=rate, **options, **common)
    common |= {"n_steps": 128, "batch_size": 2048, "n_critic_updates": 5, "learning_rate": 1e-3}
    if name == "cpo":
        return ConstrainedTRPO("MlpPolicy", limit=plan.limit, **common)
    return FisherTRPO("MlpPolicy", **common)


def policy_of(algorithm: Any, plan: Plan) -> BaselinePolicy:
    """The mean of the actor as it is now."""
    actor = algorithm.policy
    layers = [actor.mlp_extractor.policy_net[0], actor.mlp_extractor.policy_net[2], actor.action_net]
    tensors = {}
    for index, layer in enumerate(layers):
        tensors[f"policy.{index}.weight"] = layer.weight.detach().numpy().copy()
        tensors[f"policy.{index}.bias"] = layer.bias.detach().numpy().copy()
    return BaselinePolicy(tensors, {"plan": plan.__dict__})


@final
class _Watch(BaseCallback):
    """The learning curve, the costs that CPO learns from, word of the progress, and the best policy so far."""

    def __init__(self, name: str, environment: PointEnvironment, plan: Plan, report_progress: ReportProgress) -> None:
        super().__init__()
        self.curve: list[list[float]] = []
        self.compared: list[list[float]] = []
        """Steps, reward, cost and score of each policy that was looked at."""
        self.best, self.retained_at = -math.inf, 0
        self.retained: BaselinePolicy
        self._name, self._environment, self._plan, self._report_it = name, environment, plan, report_progress
        rollouts = math.ceil(plan.steps / (128 * plan.robots))
        self._every, self._look_every = max(1, math.ceil(rollouts / 100)), max(1, rollouts // _LOOKS)
        self._rollouts = 0

    def _on_step(self) -> bool:
        if isinstance(self.model, ConstrainedTRPO):
            self.model.recent_costs.append(self._environment.cost.copy())
        return True

    def _on_rollout_start(self) -> None:
        plan = self._plan
        self._environment.filtered = self.num_timesteps >= (1.0 - plan.filtered) * plan.steps
        if self._rollouts and self._rollouts % self._look_every == 0:
            self.look()

    def _on_rollout_end(self) -> None:
        self._rollouts += 1
        environment = self._environment
        if self._rollouts % self._every or not environment.returns:
            return
        reward, cost = float(np.mean(environment.returns)), float(np.mean(environment.costs))
        self.curve.append([self.num_timesteps, round(reward, 3), round(cost, 3), round(environment.weight, 4)])
        note = f"reward {reward:.1f}, cost {cost:.1f}, weight {environment.weight:.2f}"
        self._report_it(self._name, self.num_timesteps, self._plan.steps, note)

    def look(self) -> None:
        """Drives the policy as it is through the episodes of the choice, and keeps it where none was better."""
        plan, now = self._plan, policy_of(self.model, self._plan)
        if plan.filtered and not self._environment.filtered:
            return
        figures = _judged(now, plan, plan.seed + _CHOICE_SEED, _COMPARED)
        found = score(self._name, figures, plan.limit)
        figures_reported = (figures["reward"], figures["cost"], found)
        self.compared.append([self.num_timesteps, *(round(float(one), 3) for one in figures_reported)])
        if found >= self.best:
            self.best, self.retained, self.retained_at = found, now, self.num_timesteps
