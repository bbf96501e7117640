"""The paper's model-free baselines, trained on the point robot: PPO and TRPO, each with a Lagrange multiplier too; CPO.

They see the benchmark's sensors, goal and hazard lidar, nothing of the wind, and have to learn what not to do from the
cost alone. Networks 64 x 64 with tanh; every robot one environment, thousands of episodes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from time import monotonic, process_time
from typing import Any, final

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger

from safedpa.errors import InputError, did_you_mean
from safedpa_lab.point.constrained import ConstrainedTRPO, Multiplier
from safedpa_lab.point.fisher import FisherTRPO
from safedpa_lab.point.plan import BASELINES, Plan
from safedpa_lab.point.policy_file import BaselinePolicy, load_policy, save_policy
from safedpa_lab.point.vector_environment import PointEnvironment
from safedpa_sim.point.task import PointTask
from safedpa_sim.training.progress import Tell, silent

__all__ = ["evaluate_policy", "train_baseline"]

_EVALUATED = 256
"""Whole episodes of the last evaluation."""
_EVALUATION_SEED = 1_000_003


def train_baseline(name: str, plan: Plan, path: Path, tell: Tell = silent) -> dict[str, Any]:
    """Trains one of ``BASELINES`` and writes its policy to ``path``; a file from the same plan stays as it is.

    Returns its account: mean reward and cost of whole episodes, seconds, learning curve. Raises InputError for a name
    that is none.
    """
    if name not in BASELINES:
        raise InputError(f"baseline '{name}': {did_you_mean(name, BASELINES)}")
    made_from = {"name": name, **plan.__dict__}
    if path.exists() and (known := load_policy(path)).told.get("plan") == made_from:
        return {**known.told, "skipped": True}
    started, worked = monotonic(), process_time()
    torch.set_num_threads(1)  # the same weights however many cores there are
    environment = PointEnvironment(_task(plan, plan.seed), plan.seed)
    algorithm = _algorithm(name, environment, plan)
    algorithm.set_logger(Logger(None, []))  # else it makes a folder of its own, for nothing, and leaves it
    watch = _Watch(name, environment, plan, tell)
    callbacks: list[BaseCallback] = [watch]
    if name.endswith("lagrangian"):
        callbacks.append(Multiplier(environment))
    with torch.random.fork_rng(devices=[]):
        algorithm.learn(plan.steps, callbacks)
    policy = _policy_of(algorithm)
    account = {
        "plan": made_from,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "seconds": round(monotonic() - started, 1),
        "processor_seconds": round(process_time() - worked, 1),
        **evaluate_policy(policy.act, _task(plan, plan.seed + _EVALUATION_SEED, _EVALUATED)),
        "multiplier": round(environment.weight, 4),
        "learning_curve": watch.curve,
    }
    save_policy(BaselinePolicy(policy.tensors, account), path)
    return account


def evaluate_policy(act: Callable[[np.ndarray[Any, Any]], np.ndarray[Any, Any]], task: PointTask) -> dict[str, Any]:
    """Mean reward, cost and goals of one whole episode of each robot under a policy without noise."""
    gained, paid, goals = np.zeros(task.count), np.zeros(task.count), np.zeros(task.count)
    over = False
    while not over:
        stepped = task.advance(act(task.observation()))
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


def _task(plan: Plan, seed: int, count: int = 0) -> PointTask:
    return PointTask(count or plan.robots, seed, largest_force=plan.largest_force, stock=plan.stock)


def _algorithm(name: str, environment: PointEnvironment, plan: Plan) -> Any:
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
        return PPO("MlpPolicy", learning_rate=lambda left: 6e-4 * max(left, 0.1), **options, **common)
    kind = ConstrainedTRPO if name == "cpo" else FisherTRPO
    return kind("MlpPolicy", n_steps=128, batch_size=2048, n_critic_updates=5, learning_rate=1e-3, **common)


def _policy_of(algorithm: Any) -> BaselinePolicy:
    actor = algorithm.policy
    layers = [actor.mlp_extractor.policy_net[0], actor.mlp_extractor.policy_net[2], actor.action_net]
    tensors = {}
    for index, layer in enumerate(layers):
        tensors[f"policy.{index}.weight"] = layer.weight.detach().numpy().copy()
        tensors[f"policy.{index}.bias"] = layer.bias.detach().numpy().copy()
    return BaselinePolicy(tensors, {})


@final
class _Watch(BaseCallback):
    """The learning curve, the costs that CPO learns from, and word of the progress."""

    def __init__(self, name: str, environment: PointEnvironment, plan: Plan, tell: Tell) -> None:
        super().__init__()
        self.curve: list[list[float]] = []
        self._name, self._environment, self._plan, self._tell_it = name, environment, plan, tell
        self._every = max(1, math.ceil(plan.steps / (100 * 128 * plan.robots)))
        self._rollouts = 0

    def _on_step(self) -> bool:
        if isinstance(self.model, ConstrainedTRPO):
            self.model.recent_costs.append(self._environment.cost.copy())
        return True

    def _on_rollout_end(self) -> None:
        self._rollouts += 1
        environment = self._environment
        if self._rollouts % self._every or not environment.returns:
            return
        reward, cost = float(np.mean(environment.returns)), float(np.mean(environment.costs))
        self.curve.append([self.num_timesteps, round(reward, 3), round(cost, 3), round(environment.weight, 4)])
        note = f"reward {reward:.1f}, cost {cost:.1f}"
        self._tell_it(self._name, self.num_timesteps, self._plan.steps, note)
