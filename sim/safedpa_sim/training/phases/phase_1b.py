"""Phase 1b: the policy pi(x, mu(e)), trained by PPO with mu frozen on many simulated robots.

If the configuration has ``imitation`` rounds, the policy first learns a teacher's actions in the states that it visits
itself (DAgger: Ross, Gordon, Bagnell, A Reduction of Imitation Learning and Structured Prediction to No-Regret Online
Learning, 2011).
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, Final, Protocol, final

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger

from safedpa.arrays import Float32Array
from safedpa.errors import InputError
from safedpa.networks import Weights
from safedpa_sim.training.configuration import Configuration, Imitation
from safedpa_sim.training.environments.policy_task import BatchedEnvironment, task_of
from safedpa_sim.training.environments.vector_environment import VectorEnvironment
from safedpa_sim.training.optimisation import Checkpoint, descend, training_device
from safedpa_sim.training.progress import ReportProgress, silent

_NOISY: Final = 0.5
"""Share of the actions with added noise; without it the policy never learns to recover from a deviation."""
_LAST: Final = 4
"""The last round is this many times longer; the critic learns the policy's return from it."""


class EnvironmentWithTeacher(BatchedEnvironment, Protocol):
    """A batched environment with a teacher, which may use information that the policy does not observe."""

    def teacher(self) -> Float32Array:
        """Returns the teacher's actions (robots, actions), each entry in [-1, 1]."""


@final
class _ImitationData:
    """The observations so far with the teacher's actions for them."""

    def __init__(
        self, robots: EnvironmentWithTeacher, environment: VectorEnvironment, plan: Imitation, seed: int
    ) -> None:
        self.robots, self.environment, self.plan = robots, environment, plan
        self.random = np.random.default_rng([seed, 29])
        self.seen: list[Float32Array] = []
        self.wanted: list[Float32Array] = []
        self.reward: list[Float32Array] = []

    def drive(self, actor: torch.nn.Module | None, ticks: int, noisy: float) -> None:
        """Drives the robots with ``actor``, or the teacher, and records; rewards are kept for the latest drive only."""
        self.reward = []
        for _ in range(ticks):
            seen, wanted = self.environment.scaled_observation(), self.robots.teacher()
            self.seen.append(seen)
            self.wanted.append(wanted)
            with torch.no_grad():
                chosen = wanted if actor is None else actor(torch.from_numpy(seen)).numpy()
            noise = self.random.normal(0.0, self.plan.noise, chosen.shape)
            noise *= self.random.random((len(chosen), 1)) < noisy
            moved = self.robots.advance(np.clip(chosen + noise, -1.0, 1.0).astype(np.float32))
            self.reward.append(moved.reward)
            self.robots.restart(np.flatnonzero(moved.reached | moved.timed_out))

    def fit(
        self, network: torch.nn.Module, optimiser: torch.optim.Optimizer, seen: Float32Array, wanted: Float32Array
    ) -> float:
        """Fits the network to ``wanted`` by Adam and returns the mean squared error of the last batch."""
        inputs, targets, error = torch.from_numpy(seen), torch.from_numpy(wanted), 0.0
        for _ in range(self.plan.updates):
            which = torch.from_numpy(self.random.integers(0, len(inputs), self.plan.batch))
            loss = torch.nn.functional.mse_loss(network(inputs[which]), targets[which])
            error = float(descend(optimiser, loss))
        return error


def _imitate(
    robots: EnvironmentWithTeacher,
    environment: VectorEnvironment,
    policy: Any,
    plan: Imitation,
    discount: float,
    seed: int,
    report_progress: ReportProgress,
) -> list[float]:
    """Trains actor and critic of the stable-baselines3 ``policy`` by imitation; returns the actor's error per round.

    The teacher drives in round 1, the actor in all others. Each round learns from all data so far.
    """
    actor = torch.nn.Sequential(policy.mlp_extractor.policy_net, policy.action_net)
    critic = torch.nn.Sequential(policy.mlp_extractor.value_net, policy.value_net)
    data = _ImitationData(robots, environment, plan, seed)
    optimiser = torch.optim.Adam(actor.parameters(), plan.learning_rate)
    errors = []
    for number in range(plan.rounds):
        last = number == plan.rounds - 1
        ticks = plan.ticks * (_LAST if last else 1)
        data.drive(actor if number else None, ticks, 1.0 if last else _NOISY)
        errors.append(data.fit(actor, optimiser, np.concatenate(data.seen), np.concatenate(data.wanted)))
        report_progress("imitation", number + 1, plan.rounds, f"error {errors[-1]:.4f}")
    returns = _discounted(data.reward, discount)
    # First half only: the returns of later ticks are cut off by the end of the round.
    early = np.concatenate(data.seen[-len(returns) :][: len(returns) // 2])
    optimiser = torch.optim.Adam(critic.parameters(), plan.learning_rate)
    data.fit(critic, optimiser, early, returns[: len(returns) // 2].reshape(-1, 1))
    return errors


def _discounted(rewards: list[Float32Array], discount: float) -> Float32Array:
    """Returns the discounted returns from each tick on, (ticks, robots)."""
    later, returns = np.zeros_like(rewards[0]), []
    for reward in reversed(rewards):
        later = reward + discount * later
        returns.append(later)
    return np.stack(returns[::-1]).astype(np.float32)


_SCALING_TICKS = 60
_LEAST_SCALE = 0.05
"""Lower bound of an observation's scale; keeps entries that hardly change from being amplified."""


def train_policy(
    configuration: Configuration,
    weights: Weights,
    out: Path,
    report_progress: ReportProgress = silent,
    device: str = "cpu",
    name: str = "1b",
    penalty: float = 0.0,
    with_filter: bool = True,
) -> tuple[Weights, dict[str, Any]]:
    """Trains a policy by PPO until enough evaluation drives reach their goal, or all steps are used.

    The beginning of a contact costs ``penalty`` of the reward. ``with_filter``: the safety filter corrects each action
    during training; without it, or with ``practice.shelter`` off, the policy itself has to learn to avoid contacts
    (RMA-P). Returns the weights with the best evaluated policy, and a summary with the learning curve. An interrupted
    training resumes from its checkpoint in ``out``; ``name`` is the name of the stage. Raises InputError for weights
    without mu.
    """
    if weights.description.latents and not weights.has("mu"):
        raise InputError("phase 1b: got weights without mu, wanted those of phase 1a; run it first")
    training = _PolicyTraining(configuration, weights, out, report_progress, device, name, penalty, with_filter)
    training.run()
    return training.result()


@final
class _PolicyTraining:
    """One policy training: environment, PPO algorithm, learning curve and checkpoints."""

    def __init__(
        self,
        configuration: Configuration,
        weights: Weights,
        out: Path,
        report_progress: ReportProgress,
        device: str,
        name: str,
        penalty: float,
        with_filter: bool,
    ) -> None:
        self.configuration, self.weights, self.report_progress = configuration, weights, report_progress
        self.phase = configuration.phase_1b
        self.name, self.penalty, self.with_filter, self.best = name, penalty, with_filter, -math.inf
        self.curve: list[dict[str, Any]] = []
        made_from = configuration.digest("phase_1a", "imitation", "phase_1b", "practice")
        digest = f"{self.name} {penalty} {weights.digest} {made_from}"
        self.checkpoint = Checkpoint(out / f"checkpoint_{self.name}.pt", digest)
        self.task = task_of(configuration.robot)
        self.middle, self.scale = _scales(self._make_robots(0))
        known = self.checkpoint.read(_known)
        robots = self._make_robots(known["steps"] if known else 0)
        self.environment = VectorEnvironment(robots, self.middle, self.scale)
        self.algorithm = self._algorithm(training_device(device))
        self.algorithm.set_logger(Logger(None, []))  # the default logger creates a folder
        self.errors = [] if known else self._imitate(robots)
        self.chosen = self.trained()
        if known:
            self._resume(known)

    def _make_robots(self, done: int) -> BatchedEnvironment:
        """Returns the robots to train on; the steps ``done`` shift the seed, so that a resumed training is another."""
        configuration, count = self.configuration, self.phase.cars
        rules: dict[str, Any] = {"penalty": self.penalty, "with_filter": self.with_filter}
        return self.task.make_environment(configuration, self.weights, count, configuration.seed + done, **rules)

    def _imitate(self, robots: Any) -> list[float]:
        """Runs the imitation rounds, if any, and returns the policy's squared error after each."""
        plan, seed = self.configuration.imitation, self.configuration.seed
        if not plan.rounds:
            return []
        policy: Any = self.algorithm.policy
        return _imitate(robots, self.environment, policy, plan, self.phase.discount, seed, self.report_progress)

    def _resume(self, known: dict[str, Any]) -> None:
        policy: Any = self.algorithm.policy
        policy.load_state_dict(known["policy"])
        policy.optimizer.load_state_dict(known["optimiser"])
        self.algorithm.num_timesteps = known["steps"]
        self.curve = known["curve"]
        self.chosen, self.best = self.weights.with_tensors(known["chosen"]), max(map(self._score, self.curve))

    def _algorithm(self, device: torch.device) -> PPO:
        phase = self.phase
        rows = phase.cars * phase.rollout
        return PPO(
            "MlpPolicy",
            self.environment,
            learning_rate=lambda left: phase.learning_rate * max(left, 0.05),
            n_steps=phase.rollout,
            batch_size=min(phase.batch, rows),
            n_epochs=phase.epochs,
            gamma=phase.discount,
            gae_lambda=0.95,
            ent_coef=0.0,
            max_grad_norm=0.5,
            policy_kwargs={
                "net_arch": {"pi": [phase.hidden] * 2, "vf": [phase.hidden] * 2},
                "activation_fn": torch.nn.Tanh,
                "log_std_init": math.log(phase.noise),
            },
            seed=self.configuration.seed,
            device=device,
        )

    def run(self) -> None:
        """Trains until the policy is good enough or all steps are used."""
        left = self.phase.steps - self.algorithm.num_timesteps
        if left > 0 and not self._good_enough():
            self.algorithm.learn(left, _EvaluationCallback(self), reset_num_timesteps=False)

    def _good_enough(self) -> bool:
        return bool(self.curve) and bool(self.curve[-1]["success"] >= self.phase.enough)

    def evaluated(self, weights: Weights, cars: int) -> dict[str, Any]:
        """Evaluates weights on scenes that are not used for training."""
        configuration = self.configuration
        return self.task.evaluate(
            configuration, weights, cars=cars, seed=configuration.seed, with_filter=self.with_filter
        )

    def evaluate_and_save(self) -> bool:
        """Evaluates the policy, updates the best one, writes a checkpoint, and returns whether it is good enough."""
        environment, now = self.environment, self.trained()
        figures = self.evaluated(now, self.phase.evaluation_cars)
        rate = environment.reached / max(environment.ended, 1)
        contacts = environment.contacts / max(environment.ended, 1)
        environment.reached = environment.ended = environment.contacts = 0
        steps = self.algorithm.num_timesteps
        training = {"training_success": rate, "training_contacts": contacts, "noise": self.noise()}
        self.curve.append({"steps": steps, **training, **figures})
        if self._score(figures) >= self.best:
            self.best, self.chosen = self._score(figures), now
        policy: Any = self.algorithm.policy
        self.checkpoint.write(
            steps=steps,
            policy=policy.state_dict(),
            optimiser=policy.optimizer.state_dict(),
            curve=json.dumps(self.curve),
            chosen={name: torch.from_numpy(part.copy()) for name, part in _policy_of(self.chosen).items()},
        )
        note = f"reached {figures['success']:.3f}, contacts {figures['contacts']:.2f}"
        self.report_progress(self.name, steps, self.phase.steps, note)
        return bool(figures["success"] >= self.phase.enough)

    def _score(self, figures: dict[str, Any]) -> float:
        return _score(figures, self.configuration.practice.cost)

    def noise(self) -> float:
        """Returns the current standard deviation of the exploration noise, as a share of half the actions' range."""
        policy: Any = self.algorithm.policy
        return float(policy.log_std.detach().exp().mean())

    def trained(self) -> Weights:
        """Returns the weights with the current policy."""
        policy: Any = self.algorithm.policy
        layers = [policy.mlp_extractor.policy_net[0], policy.mlp_extractor.policy_net[2], policy.action_net]
        tensors = {"observation_middle": self.middle, "observation_scale": self.scale}
        body = getattr(self.environment.robots, "body", None)  # only cars have one
        if body is not None:
            tensors["observation_body"] = body
        for index, layer in enumerate(layers):
            tensors[f"policy.{index}.weight"] = layer.weight.detach().cpu().numpy()
            tensors[f"policy.{index}.bias"] = layer.bias.detach().cpu().numpy()
        return self.weights.with_tensors(tensors)

    def result(self) -> tuple[Weights, dict[str, Any]]:
        """Returns the best evaluated weights and a summary for the training record."""
        figures = self.evaluated(self.chosen, 4 * self.phase.evaluation_cars)
        reported = {"imitation_errors": self.errors} if self.errors else {}
        rule = {"cost": self.configuration.practice.cost, "score": self._score(figures)}
        summary = {"steps": self.algorithm.num_timesteps, **reported, **figures, **rule, "learning_curve": self.curve}
        self.checkpoint.path.unlink(missing_ok=True)
        return self.chosen, summary


@final
class _EvaluationCallback(BaseCallback):
    """Evaluates the policy every few updates, and ends the training when it is good enough."""

    def __init__(self, training: _PolicyTraining) -> None:
        super().__init__()
        self._training = training
        self._updates = 0
        self._good = False

    def _on_step(self) -> bool:
        return not self._good

    def _on_rollout_end(self) -> None:
        self._updates += 1
        if self._updates % self._training.phase.evaluate_every == 0:
            self._good = self._training.evaluate_and_save()


def _known(content: dict[str, Any]) -> dict[str, Any]:
    """Returns a checkpoint's content with the learning curve and the best policy so far as they were written."""
    chosen = {name: part.numpy() for name, part in content["chosen"].items()}
    return {**content, "curve": json.loads(content["curve"]), "chosen": chosen}


def _score(figures: dict[str, Any], cost: float) -> float:
    """Returns the score for selecting the best policy: return - cost x contacts.

    Without a cost it is the number of goals reached, or the share of drives that reach their goal.
    """
    if cost:
        return float(figures["reward"] - cost * figures["contacts"])
    return float(figures.get("goals", figures["success"]))


def _policy_of(weights: Weights) -> dict[str, Float32Array]:
    """Returns the tensors that policy training produces."""
    return {name: part for name, part in weights.tensors.items() if name.startswith(("policy.", "observation_"))}


def _scales(robots: BatchedEnvironment) -> tuple[Float32Array, Float32Array]:
    """Returns mean and standard deviation of each observation entry over random episodes."""
    random = np.random.default_rng(0)
    seen = []
    for tick in range(_SCALING_TICKS):
        if tick % 10 == 0:
            chosen = robots.exploring(random)
        robots.advance(chosen)
        seen.append(robots.observation())
    everything = np.concatenate(seen)
    robots.restart(np.arange(robots.count))
    return everything.mean(axis=0), np.maximum(everything.std(axis=0), _LEAST_SCALE)
