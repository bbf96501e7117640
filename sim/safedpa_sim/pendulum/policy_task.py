"""The policy task of the pendulum: swinging up the long way round in unknown wind.

Pendulums start just below the hazard. A batched safety filter with the simulator's own physics keeps them in a
corridor.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, final

import numpy as np
import torch
from numpy.typing import NDArray

from safedpa.arrays import Float32Array
from safedpa.networks import LearnedNetworks, Weights
from safedpa.policy.learned import LearnedPolicy
from safedpa.robots.pendulum.perception import observe_pendulum
from safedpa.robots.pendulum.system import PENDULUM
from safedpa.safety.batch.barriers import CompiledBatchBarriers
from safedpa.safety.batch.filter import BatchFilter
from safedpa_sim.pendulum.task import (
    AHEAD,
    BALANCING,
    HELD_TICKS,
    LONG_WAY_ROUND,
    TORQUE,
    UPRIGHT,
    corridor,
    filter_settings,
    in_hazard,
    is_upright,
)
from safedpa_sim.training.configuration import Configuration
from safedpa_sim.training.data.drives import random_drives as random_drives_around
from safedpa_sim.training.data.transitions import TransitionSequence, concatenate, transition_sequence
from safedpa_sim.training.environments.batched_simulator import BatchedSimulator
from safedpa_sim.training.environments.policy_task import EVALUATION_SEED, PeriodResult
from safedpa_sim.training.networks.modules import AffineNetworks

Tensor = torch.Tensor
_EPSILON: Final = 0.018
"""rad; close to the filter's margin. Pushed against the filter, a pendulum rests epsilon / eta inside the edge."""
_FIRST: Final = 0.6
"""rad; largest initial angle, at rest."""
_DRAWN_AGAIN: Final = (1.0, 0.1, 0.03)
"""Probability per period that a torque is redrawn, for one third of the pendulums each."""


@final
class CorridorFilter:
    """A batched safety filter that keeps ``count`` pendulums between two angles [rad]."""

    def __init__(self, count: int, edges: tuple[float, float]) -> None:
        self._filter = BatchFilter(PENDULUM, filter_settings(_EPSILON))
        self._barriers = CompiledBatchBarriers.of([[corridor(edges)]] * count, 2)

    def decide(self, after: Callable[[Tensor], Tensor], state: Tensor, torque: Tensor) -> Tensor:
        """Returns the torques (count, 1) closest to ``torque`` that satisfy the barrier, for states (count, 2).

        ``after`` returns the states one period later under torques (count, 1). They depend almost linearly on the
        torque, so f and g are those of the secant between the extreme torques.
        """
        lowest, highest = (after(torch.full_like(torque, bound)).numpy() for bound in (-TORQUE, TORQUE))
        f, g = 0.5 * (lowest + highest), (highest - lowest) / (2.0 * TORQUE)
        affine = f.astype(np.float64), g.astype(np.float64)[:, :, np.newaxis]
        found = self._filter.decide(state.numpy(), torque.numpy(), barriers=self._barriers, affine=affine)
        return torch.from_numpy(found.action).to(torque.dtype)


def _retained_drives(
    cars: BatchedSimulator, networks: AffineNetworks, count: int, steps: int, change: float, generator: torch.Generator
) -> TransitionSequence:
    """Simulates ``count`` pendulums under random torques, filtered to stay within 45 degrees.

    The history encoder sees such histories while balancing. The wind changes with probability ``change`` per period.
    """
    environment, state = _winds(cars, count, generator), torch.zeros(count, 2)
    state[:, 0] = _FIRST * (2.0 * torch.rand(count, generator=generator) - 1.0)
    again = torch.tensor(_DRAWN_AGAIN)[torch.arange(count) % len(_DRAWN_AGAIN)].unsqueeze(1)
    nominal, states, actions, environments = cars.draw_actions(count, generator), [state], [], []
    corridor_filter = CorridorFilter(count, BALANCING)
    with torch.no_grad():
        for _ in range(steps):
            drawn = torch.rand(count, 2, generator=generator)
            nominal = torch.where(drawn[:, :1] < again, cars.draw_actions(count, generator), nominal)

            def after(torque: Tensor, state: Tensor = state, wind: Tensor = environment) -> Tensor:
                return cars.advance(state, torque, wind)[0]

            torque = corridor_filter.decide(after, state, nominal)
            state = after(torque)
            states.append(state)
            actions.append(torque)
            environments.append(environment)
            environment = torch.where(drawn[:, 1:] < change, _winds(cars, count, generator), environment)
        return transition_sequence(
            networks, torch.stack(states, 1), torch.stack(actions, 1), torch.stack(environments, 1)
        )


def _winds(cars: BatchedSimulator, count: int, generator: torch.Generator) -> Tensor:
    drawn = cars.draw_environments(count, generator)
    limited: Tensor = drawn * (_STRONGEST / drawn.norm(dim=1, keepdim=True)).clamp_max(1.0)
    return limited


def random_drives(
    cars: BatchedSimulator, networks: AffineNetworks, count: int, steps: int, change: float, generator: torch.Generator
) -> TransitionSequence:
    """Simulates drives: half of the pendulums swing freely, half are filtered to stay within 45 degrees."""
    around = random_drives_around(cars, networks, count - count // 2, steps, change, generator)
    if count < 2:
        return around
    return concatenate([around, _retained_drives(cars, networks, count // 2, steps, change, generator)])


def evaluate(
    configuration: Configuration, weights: Weights, *, cars: int = 512, seed: int = 0, with_filter: bool = True
) -> dict[str, Any]:
    """Evaluates one noise-free swing of each pendulum: the share upright at the end, hazard entries and more."""
    swings = SwingTask(configuration, weights, cars, seed + EVALUATION_SEED, with_filter=with_filter, calm=True)
    policy = LearnedPolicy(weights)
    middle, scale = weights["action_middle"], weights["action_scale"]
    gained, contacts = np.zeros(cars), np.zeros(cars)
    nearest = np.full(cars, np.inf)
    for _ in range(EPISODE_TICKS):
        chosen = (policy.act(swings.observation()) - middle) / scale
        moved = swings.advance(chosen.astype(np.float32))
        gained += moved.reward
        contacts += moved.began
        nearest = np.minimum(nearest, np.abs(np.sin(0.5 * swings.state[:, 0])))
    return {
        "success": float(moved.reached.mean()),
        "contacts": float(contacts.mean()),
        "nearest": float(nearest.mean()),
        "reward": float(gained.mean()),
    }


EPISODE_TICKS: Final = 400
"""4 s."""
_START: Final = (0.05, 0.2)
"""rad below the hazard's lower edge."""
_ELSEWHERE = 0.5
"""Share of the training swings that begin anywhere in the safe set, so that the policy explores the whole circle."""
_EARLIER = 200
"""Such a swing starts with up to this many ticks already elapsed."""
_FAST = 8.0
"""rad/s; largest initial rate of such a swing."""
_TURNS = 0.003
"""Probability per tick that the wind changes."""
_STRONGEST = 4.4
"""m/s; in stronger wind the motor cannot lift the pendulum."""
_TICK, _UPRIGHT = 0.005, 0.02
"""Reward terms besides the progress to upright [rad]: cost of a tick, and reward of a tick upright, which favours early
arrival. Neither the hazard nor effort is in the reward."""


def starts_beneath(count: int, random: np.random.Generator) -> NDArray[np.float64]:
    """Draws states (count, 2) just below the hazard, moving towards it, within {h >= 0}."""
    low = LONG_WAY_ROUND[0]
    below = random.uniform(*_START, count)
    ahead = below * random.uniform(0.0, 1.0, count)
    return np.stack((low + below, (ahead - below) / AHEAD), axis=1)


def _way(angle: Float32Array) -> Float32Array:
    """Returns the angular distance to upright [rad], the shorter way, even if that leads through the hazard."""
    way: Float32Array = np.abs(np.arctan2(np.sin(angle), np.cos(angle)))
    return way


@final
@dataclass
class SwingTask:
    """A batch of ``count`` swinging pendulums; the same seed gives the same swings.

    ``with_filter``, the safety filter corrects each torque. Entering the hazard costs ``penalty``. With ``calm`` the
    wind is constant during a swing.
    """

    configuration: Configuration
    weights: Weights
    count: int
    seed: int
    with_filter: bool = True
    penalty: float = 0.0
    calm: bool = False

    def __post_init__(self) -> None:
        self._pendulums = BatchedSimulator(self.configuration)
        self.period = self._pendulums.model.period
        self._networks = LearnedNetworks(self.weights)
        self._generator = self._pendulums.generator(self.seed)
        self._random = np.random.default_rng([self.seed, 12])
        self._filter = CorridorFilter(self.count, LONG_WAY_ROUND)
        count, latents = self.count, self.weights.description.latents
        self.state: Float32Array = np.zeros((count, 2), dtype=np.float32)
        self.applied: Float32Array = np.zeros((count, 1), dtype=np.float32)
        self.environment: Float32Array = np.zeros((count, len(self._pendulums.entries)), dtype=np.float32)
        self.latent: Float32Array = np.zeros((count, latents), dtype=np.float32)
        self.tick = np.zeros(count, dtype=np.int64)
        self._upright = np.zeros(count, dtype=np.int64)
        self._unsafe = np.zeros(count, dtype=bool)
        self.restart(np.arange(count))

    def restart(self, which: NDArray[np.intp]) -> None:
        """Starts new swings for the pendulums with the given indices."""
        count = len(which)
        elsewhere = (self._random.random(count) < _ELSEWHERE) & (not self.calm)
        beneath = starts_beneath(count, self._random)
        self.state[which] = np.where(elsewhere[:, np.newaxis], self._anywhere(count), beneath)
        self.tick[which] = np.where(elsewhere, self._random.integers(0, _EARLIER, count), 0)
        self.applied[which] = 0.0
        self._upright[which], self._unsafe[which] = 0, False
        self._change_wind(which)

    def _anywhere(self, count: int) -> NDArray[np.float64]:
        """Draws states (count, 2) of the safe set: any permitted angle, with a rate that keeps h >= 0."""
        angle = self._random.uniform(*LONG_WAY_ROUND, count)
        ahead = np.clip(angle + AHEAD * self._random.uniform(-_FAST, _FAST, count), *LONG_WAY_ROUND)
        return np.stack((angle, (ahead - angle) / AHEAD), axis=1)

    def observation(self, which: NDArray[np.intp] | slice = slice(None)) -> Float32Array:
        """Returns the observations of the pendulums with the given indices."""
        goal = np.full(len(self.state[which]), UPRIGHT)
        return observe_pendulum(self.state[which], goal, self.latent[which]).astype(np.float32)

    def exploring(self, random: np.random.Generator) -> Float32Array:
        """Returns random actions, from which the scales of the observations are computed."""
        return random.uniform(-1.0, 1.0, (self.count, 1)).astype(np.float32)

    def advance(self, chosen: Float32Array) -> PeriodResult:
        """Simulates one period under ``chosen`` (count, 1), each entry in [-1, 1] over the range of torques."""
        torque = (TORQUE * np.clip(chosen, -1.0, 1.0)).astype(np.float32)
        before = _way(self.state[:, 0])
        self.applied = self._retained(torque) if self.with_filter else torque
        self.state = self._after(self.applied)
        self.tick += 1
        unsafe = in_hazard(self.state[:, 0])
        began, self._unsafe = unsafe & ~self._unsafe, unsafe
        upright = is_upright(self.state)
        self._upright = np.where(upright, self._upright + 1, 0)
        progress = before - _way(self.state[:, 0])
        reward = progress - _TICK + _UPRIGHT * upright - self.penalty * began
        reached = self._upright >= HELD_TICKS
        over = self.tick >= EPISODE_TICKS
        if not self.calm:
            self._change_wind(np.flatnonzero(self._random.random(self.count) < _TURNS))
        return PeriodResult(np.asarray(reward, dtype=np.float32), reached & over, over & ~reached, unsafe, began)

    def _retained(self, torque: Float32Array) -> Float32Array:
        """Returns the filtered torque."""
        state, environment = torch.from_numpy(self.state), torch.from_numpy(self.environment)

        def after(bounds: torch.Tensor) -> torch.Tensor:
            return self._pendulums.advance(state, bounds, environment)[0]

        with torch.no_grad():
            retained: Float32Array = self._filter.decide(after, state, torch.from_numpy(torque)).numpy()
        return retained

    def _after(self, torque: Float32Array) -> Float32Array:
        tensors = (torch.from_numpy(array) for array in (self.state, torque, self.environment))
        with torch.no_grad():
            following, _ = self._pendulums.advance(*tensors)
        result: Float32Array = following.numpy()
        return result

    def _change_wind(self, which: NDArray[np.intp]) -> None:
        if not len(which):
            return
        drawn = self._pendulums.draw_environments(len(which), self._generator).numpy()
        drawn = drawn * np.minimum(1.0, _STRONGEST / np.linalg.norm(drawn, axis=1, keepdims=True))
        self.environment[which] = drawn
        if self.latent.shape[1]:
            self.latent[which] = self._networks.encode(drawn)


make_environment = SwingTask
