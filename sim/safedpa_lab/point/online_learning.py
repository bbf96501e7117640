"""A policy that goes on learning by PPO while it drives in a wind, behind SafeDPA's filter or without one.

    a = F(w, x, z),   w ~ N(pi(o), sigma)

PPO learns on the nominal action w: its ratio is that of w, and the filter F belongs to the world. The latents z of
policy and filter are those of what was carried out, a. Reward: what is gained along the shortest way, as in every
training with these inputs; nothing is taken off for a step in a hazard. The wind is known to none of them. Every step
of the learning counts, in rows of so many steps.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final, final

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger

from safedpa.arrays import BoolArray
from safedpa_lab.experiments.common.statistics import mean_interval, wilson_interval
from safedpa_lab.point.baseline_set import BaselinePolicy, baseline_named
from safedpa_lab.point.baselines import algorithm_of, policy_of
from safedpa_lab.point.drivers import ShieldedDriver, driven, evenly, windy_task
from safedpa_lab.point.inputs import Inputs
from safedpa_lab.point.plan import Plan
from safedpa_lab.point.shield import DIRECTIONS, LearningShield, Shield, shield_of
from safedpa_lab.point.vector_environment import PointEnvironment
from safedpa_sim.point.task import PointTask, StepResult

COUNTS: Final = ("unsafe", "goals", "reward", "corrected", "relaxed", "episodes", "safe_episodes", "episode_goals")
"""Sums of a row: steps in a hazard, goals, the benchmark's reward, steps that the filter changed, steps in which not
every condition could be kept; whole episodes that ended, those of them without an unsafe step, their goals."""


@final
class Tally:
    """Of ``count`` robots. An episode counts among the whole ones when it was seen from its first step on."""

    def __init__(self, count: int) -> None:
        self.rows: list[dict[str, Any]] = []
        """``steps``: of all robots together, since the learning began; then ``COUNTS``."""
        self._count, self._steps = count, 0
        self._whole = np.zeros(count, bool)
        self._paid, self._reached = np.zeros(count), np.zeros(count)
        self._sums = dict.fromkeys(COUNTS, 0.0)

    def add(self, stepped: StepResult, corrected: BoolArray, relaxed: BoolArray) -> None:
        """One step of every robot."""
        self._steps += self._count
        self._paid += stepped.cost
        self._reached += stepped.reached
        over = stepped.timed_out & self._whole
        each = (stepped.cost, stepped.reached, stepped.reward, corrected, relaxed)
        ended = (over, over & (self._paid == 0.0), self._reached * over)
        for name, values in zip(COUNTS, (*each, *ended), strict=True):
            self._sums[name] += float(values.sum())
        self._whole |= stepped.timed_out
        self._paid[stepped.timed_out] = self._reached[stepped.timed_out] = 0.0

    def close_row(self) -> None:
        """What came since the last row becomes one."""
        self.rows.append({"steps": self._steps, **{name: round(value, 4) for name, value in self._sums.items()}})
        self._sums = dict.fromkeys(COUNTS, 0.0)


RATE: Final = 3e-4
"""Of learning; it does not fall, since a policy that goes on adapting has no last step."""
WARMING: Final = 32_768
"""Steps in which a policy that was trained before drives on as it is, while a critic of it is learned: none ships."""


@final
@dataclass(frozen=True)
class Start:
    """Where the learning begins: inputs of ``INPUTS``, and the key of a baseline; empty: a fresh network."""

    title: str
    inputs: str
    key: str = ""
    deviation: float = -0.5
    """log of the nominal actions' deviation at the start."""


STARTS: Final = {
    "shipped": Start("PPO-Lagrangian that ships, given lidar and z", "latent", "ppo_lagrangian_wind_latent_1", -1.0),
    "nothing": Start("a fresh network, given z, way and hazards", "equal"),
    "careless": Start("PPO that ships, given z, way and hazards", "equal", "ppo_wind_equal", -1.0),
}


@final
@dataclass(frozen=True)
class Learning:
    """One policy that learns; plain values, so that they can be kept in a file."""

    start: str
    """Of ``STARTS``."""
    epsilon: float | None
    """m, the filter's margin; nothing: no filter."""
    training_seed: int
    """Of the network and the noise."""
    layout_seed: int
    """Of layouts, goals and winds in which it learns."""
    judged_seed: int
    """Of the episodes in which the policy is judged at the end."""
    steps: int
    """At least so many; 0: the policy is judged as it is."""
    robots: int
    episodes: int
    """Of each direction, in which the policy is judged."""
    force: float
    """N, in learning and judging."""


def learned(learning: Learning) -> dict[str, Any]:
    """``rows`` of ``Tally``, one an update, and ``judged``: the mean of the policy that came of it, without noise."""
    torch.set_num_threads(1)  # the same weights however many cores there are
    with torch.random.fork_rng(devices=[]):
        environment, between = learning_environment(learning)
        start = STARTS[learning.start]
        plan = Plan(steps=learning.steps, robots=learning.robots, seed=learning.training_seed, inputs=start.inputs)
        algorithm = algorithm_of("ppo", environment, plan, lambda _: RATE)
        algorithm.set_logger(Logger(None, []))  # else it makes a folder of its own, for nothing, and leaves it
        _begin(algorithm.policy, start)
        counting = _Counting(environment, between, WARMING if start.key else 0)
        if learning.steps:
            algorithm.learn(learning.steps, counting)
    reported = {item.name: getattr(learning, item.name) for item in fields(learning)}
    return {**reported, "rows": counting.tally.rows, "judged": _judged(policy_of(algorithm, plan), learning)}


def learning_environment(learning: Learning) -> tuple[PointEnvironment, LearningShield]:
    """The robots with their goals from sequences of their own, and what stands between them and the policy."""
    task = PointTask(learning.robots, learning.layout_seed, paired=True)
    between = LearningShield(task, _shield(task, learning.epsilon), learning.force, learning.layout_seed)
    environment = PointEnvironment(task, learning.layout_seed, STARTS[learning.start].inputs, between)
    environment.filtered = True
    return environment, between


def _shield(task: PointTask, epsilon: float | None) -> Shield:
    return shield_of("none", task, adapts="") if epsilon is None else shield_of("safedpa", task, epsilon=epsilon)


def _begin(policy: Any, start: Start) -> None:
    """The actor of the start's baseline, if it has one, and its deviation."""
    with torch.no_grad():
        policy.log_std.fill_(start.deviation)
        if not start.key:
            return
        tensors = baseline_named(start.key, Path()).tensors
        layers = (policy.mlp_extractor.policy_net[0], policy.mlp_extractor.policy_net[2], policy.action_net)
        for index, layer in enumerate(layers):
            layer.weight.copy_(torch.as_tensor(tensors[f"policy.{index}.weight"]))
            layer.bias.copy_(torch.as_tensor(tensors[f"policy.{index}.bias"]))


def _judged(policy: BaselinePolicy, learning: Learning) -> dict[str, Any]:
    """Whole episodes without noise, behind the same filter or none, in winds from every direction."""
    task = windy_task(evenly(DIRECTIONS, learning.episodes), learning.force, learning.judged_seed)
    inputs = Inputs(policy.inputs, task)
    found = driven(ShieldedDriver(task, _shield(task, learning.epsilon), lambda _: policy.act(inputs.see())), task)
    safe = int((found.cost == 0.0).sum())
    return {
        "episodes": task.count,
        "safe": safe,
        "safe_95": list(wilson_interval(safe, task.count)),
        "unsafe_steps": int(found.cost.sum()),
        "goals": mean_interval(found.goals),
        "reward": mean_interval(found.reward),
        "corrected": round(found.corrected, 5),
    }


@final
class _Counting(BaseCallback):
    """Counts every step; holds the actor still for the first ``warming`` steps."""

    def __init__(self, environment: PointEnvironment, between: LearningShield, warming: int) -> None:
        super().__init__()
        self.tally = Tally(environment.num_envs)
        self._environment, self._between, self._warming = environment, between, warming

    def _on_rollout_start(self) -> None:
        policy: Any = self.model.policy
        parts = (policy.mlp_extractor.policy_net, policy.action_net)
        for parameter in (policy.log_std, *(one for part in parts for one in part.parameters())):
            parameter.requires_grad = self.num_timesteps >= self._warming

    def _on_step(self) -> bool:
        self.tally.add(self._environment.last, self._between.corrected, self._between.relaxed)
        return True

    def _on_rollout_end(self) -> None:
        self.tally.close_row()
