"""A policy's first lessons: to do as a teacher would, in the states that the policy itself comes to.

Source: DAgger, Ross, Gordon, Bagnell, A Reduction of Imitation Learning and Structured Prediction to No-Regret Online
Learning, AISTATS 2011.
"""

from __future__ import annotations

from typing import Any, Final, Protocol, final

import numpy as np
import torch
from numpy.typing import NDArray

from safedpa_sim.training.configuration import Imitation
from safedpa_sim.training.practice import Practice
from safedpa_sim.training.progress import Tell
from safedpa_sim.training.vector_environment import PracticeEnvironment

__all__ = ["Taught", "imitate"]

Floats = NDArray[np.float32]

_NOISY: Final = 0.5
"""Share of the actions that are disturbed, so that the way back is learned too."""
_LAST: Final = 4
"""Times as long is the last round, of which the critic learns what the policy will gain."""


class Taught(Practice, Protocol):
    """Robots that practise, and a teacher who knows what they cannot."""

    def teacher(self) -> Floats:
        """What the teacher would do (robots, actions), each entry in [-1, 1]."""


@final
class _Lessons:
    """What was seen so far, and what the teacher would have done."""

    def __init__(self, robots: Taught, environment: PracticeEnvironment, plan: Imitation, seed: int) -> None:
        self.robots, self.environment, self.plan = robots, environment, plan
        self.random = np.random.default_rng([seed, 29])
        self.seen: list[Floats] = []
        self.wanted: list[Floats] = []
        self.reward: list[Floats] = []

    def drive(self, actor: torch.nn.Module | None, ticks: int, noisy: float) -> None:
        """The robots under ``actor``, or the teacher; rewards are those of this drive alone."""
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

    def fit(self, network: torch.nn.Module, optimiser: torch.optim.Optimizer, seen: Floats, wanted: Floats) -> float:
        """Steps of Adam on the squared error; the last batch's."""
        inputs, targets, error = torch.from_numpy(seen), torch.from_numpy(wanted), 0.0
        for _ in range(self.plan.updates):
            which = torch.from_numpy(self.random.integers(0, len(inputs), self.plan.batch))
            loss = torch.nn.functional.mse_loss(network(inputs[which]), targets[which])
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimiser.step()
            error = float(loss.detach())
        return error


def imitate(
    robots: Taught,
    environment: PracticeEnvironment,
    policy: Any,
    plan: Imitation,
    discount: float,
    seed: int,
    tell: Tell,
) -> list[float]:
    """Teaches stable-baselines3's ``policy``, actor and critic; the actor's squared error after each round.

    Round 1 is driven by the teacher, the others by the actor; all that was seen so far is learned from each time.
    """
    actor = torch.nn.Sequential(policy.mlp_extractor.policy_net, policy.action_net)
    critic = torch.nn.Sequential(policy.mlp_extractor.value_net, policy.value_net)
    lessons = _Lessons(robots, environment, plan, seed)
    optimiser = torch.optim.Adam(actor.parameters(), plan.learning_rate)
    errors = []
    for number in range(plan.rounds):
        last = number == plan.rounds - 1
        ticks = plan.ticks * (_LAST if last else 1)
        lessons.drive(actor if number else None, ticks, 1.0 if last else _NOISY)
        errors.append(lessons.fit(actor, optimiser, np.concatenate(lessons.seen), np.concatenate(lessons.wanted)))
        tell("imitation", number + 1, plan.rounds, f"error {errors[-1]:.4f}")
    returns = _discounted(lessons.reward, discount)
    early = np.concatenate(lessons.seen[-len(returns) :][: len(returns) // 2])
    optimiser = torch.optim.Adam(critic.parameters(), plan.learning_rate)
    lessons.fit(critic, optimiser, early, returns[: len(returns) // 2].reshape(-1, 1))
    return errors


def _discounted(rewards: list[Floats], discount: float) -> Floats:
    """(ticks, robots): what was gained from each tick on."""
    later, returns = np.zeros_like(rewards[0]), []
    for reward in reversed(rewards):
        later = reward + discount * later
        returns.append(later)
    return np.stack(returns[::-1]).astype(np.float32)
