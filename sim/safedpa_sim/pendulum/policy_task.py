"""What a pendulum's policy learns: to get upright the long way round, in winds that it does not know.

Pendulums start beneath the hazard. Between policy and motor stands the safety filter, which keeps them within a
corridor by the simulator's own physics: what training is sheltered by.
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
from safedpa_sim.training.drives import random_drives as random_drives_around
from safedpa_sim.training.histories import TransitionSequence, joined, transition_sequence
from safedpa_sim.training.networks import AffineNetworks
from safedpa_sim.training.one_period import PeriodResult
from safedpa_sim.training.simulator import BatchedCars

__all__ = ["EPISODE_TICKS", "CorridorShelter", "SwingTask", "evaluate", "practice", "random_drives", "starts_beneath"]

Tensor = torch.Tensor
_EPSILON: Final = 0.018
"""rad; about the filter's margin. Who leans on the filter comes to rest epsilon / eta inside the edge."""
_FIRST: Final = 0.6
"""rad; largest angle at the start, at rest."""
_DRAWN_AGAIN: Final = (1.0, 0.1, 0.03)
"""Probability per period that a torque is redrawn, for a third of the pendulums each."""


@final
class CorridorShelter:
    """``BatchFilter`` before ``count`` pendulums that are to stay between two angles [rad]."""

    def __init__(self, count: int, edges: tuple[float, float]) -> None:
        self._filter = BatchFilter(PENDULUM, filter_settings(_EPSILON))
        self._barriers = CompiledBatchBarriers.of([[corridor(edges)]] * count, 2)

    def decide(self, after: Callable[[Tensor], Tensor], state: Tensor, torque: Tensor) -> Tensor:
        """The torques (count, 1) nearest to ``torque`` that keep the corridor, for states (count, 2).

        ``after`` tells the states one period later under torques (count, 1): they change with them as good as linearly,
        so f and g are those of the chord from the strongest torque to the other.
        """
        lowest, highest = (after(torch.full_like(torque, bound)).numpy() for bound in (-TORQUE, TORQUE))
        f, g = 0.5 * (lowest + highest), (highest - lowest) / (2.0 * TORQUE)
        affine = f.astype(np.float64), g.astype(np.float64)[:, :, np.newaxis]
        found = self._filter.decide(state.numpy(), torque.numpy(), barriers=self._barriers, affine=affine)
        return torch.from_numpy(found.action).to(torque.dtype)


def _retained_drives(
    cars: BatchedCars, networks: AffineNetworks, count: int, steps: int, change: float, generator: torch.Generator
) -> TransitionSequence:
    """``count`` pendulums for ``steps`` periods; the wind becomes another with probability ``change`` a period.

    Torques at random within 45 degrees: what the history encoder meets while balancing.
    """
    environment, state = _winds(cars, count, generator), torch.zeros(count, 2)
    state[:, 0] = _FIRST * (2.0 * torch.rand(count, generator=generator) - 1.0)
    again = torch.tensor(_DRAWN_AGAIN)[torch.arange(count) % len(_DRAWN_AGAIN)].unsqueeze(1)
    nominal, states, actions, environments = cars.draw_actions(count, generator), [state], [], []
    shelter = CorridorShelter(count, BALANCING)
    with torch.no_grad():
        for _ in range(steps):
            drawn = torch.rand(count, 2, generator=generator)
            nominal = torch.where(drawn[:, :1] < again, cars.draw_actions(count, generator), nominal)

            def after(torque: Tensor, state: Tensor = state, wind: Tensor = environment) -> Tensor:
                return cars.advance(state, torque, wind)[0]

            torque = shelter.decide(after, state, nominal)
            state = after(torque)
            states.append(state)
            actions.append(torque)
            environments.append(environment)
            environment = torch.where(drawn[:, 1:] < change, _winds(cars, count, generator), environment)
        return transition_sequence(
            networks, torch.stack(states, 1), torch.stack(actions, 1), torch.stack(environments, 1)
        )


def _winds(cars: BatchedCars, count: int, generator: torch.Generator) -> Tensor:
    drawn = cars.draw_environments(count, generator)
    limited: Tensor = drawn * (_STRONGEST / drawn.norm(dim=1, keepdim=True)).clamp_max(1.0)
    return limited


_EVALUATION_SEED = 1_000_003
"""Added to the configuration's seed: no swing of the evaluation is trained on."""


def practice(
    configuration: Configuration, weights: Weights, count: int, seed: int, penalty: float, sheltered: bool
) -> SwingTask:
    """Pendulums to train on; ``penalty`` is for entering the hazard, ``sheltered`` by a stand-in for the filter."""
    return SwingTask(configuration, weights, count, seed, sheltered=sheltered, penalty=penalty)


def random_drives(
    cars: BatchedCars,
    networks: AffineNetworks,
    count: int,
    steps: int,
    change: float,
    generator: torch.Generator,
) -> TransitionSequence:
    """Half the pendulums swing all around, half are kept within 45 degrees by an exact stand-in for the filter."""
    around = random_drives_around(cars, networks, count - count // 2, steps, change, generator)
    if count < 2:
        return around
    return joined([around, _retained_drives(cars, networks, count // 2, steps, change, generator)])


def evaluate(
    configuration: Configuration, weights: Weights, *, cars: int = 512, seed: int = 0, sheltered: bool = True
) -> dict[str, Any]:
    """One swing of each pendulum under the policy without noise: the share upright at its end, and hazards entered."""
    swings = SwingTask(configuration, weights, cars, seed + _EVALUATION_SEED, sheltered=sheltered, calm=True)
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
"""Share of the swings that begin anywhere in the safe set, in training: the policy gets to know the whole circle."""
_EARLIER = 200
"""Ticks of which up to so many are over already where a swing begins elsewhere."""
_FAST = 8.0
"""rad/s; largest rate there."""
_TURNS = 0.003
"""Probability per tick that the wind becomes another."""
_STRONGEST = 4.4
"""m/s; against stronger winds the motor does not lift the pendulum."""
_TICK, _UPRIGHT = 0.005, 0.02
"""Rewards, next to the way to upright in rad that was gained: for each tick, each tick upright. Who arrives early gets
more; nothing is said of the hazard, and effort costs nothing."""


def starts_beneath(count: int, random: np.random.Generator) -> NDArray[np.float64]:
    """States (count, 2) just beneath the hazard, moving towards it, within {h >= 0}: s uniform from the edge on."""
    low = LONG_WAY_ROUND[0]
    below = random.uniform(*_START, count)
    ahead = below * random.uniform(0.0, 1.0, count)
    return np.stack((low + below, (ahead - below) / AHEAD), axis=1)


def _way(angle: Float32Array) -> Float32Array:
    """The shorter way to upright [rad]: past the hazard or through it."""
    way: Float32Array = np.abs(np.arctan2(np.sin(angle), np.cos(angle)))
    return way


@final
@dataclass
class SwingTask:
    """``count`` pendulums; the same seed gives the same swings. ``sheltered`` puts the filter before each.

    ``penalty`` is taken off the reward when one enters the hazard; ``calm``: the wind of a swing stays.
    """

    configuration: Configuration
    weights: Weights
    count: int
    seed: int
    sheltered: bool = True
    penalty: float = 0.0
    calm: bool = False

    def __post_init__(self) -> None:
        self._pendulums = BatchedCars(self.configuration)
        self.period = self._pendulums.model.period
        self._networks = LearnedNetworks(self.weights)
        self._generator = self._pendulums.generator(self.seed)
        self._random = np.random.default_rng([self.seed, 12])
        self._shelter = CorridorShelter(self.count, LONG_WAY_ROUND)
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
        """New swings for the pendulums of those indices."""
        count = len(which)
        elsewhere = (self._random.random(count) < _ELSEWHERE) & (not self.calm)
        beneath = starts_beneath(count, self._random)
        self.state[which] = np.where(elsewhere[:, np.newaxis], self._anywhere(count), beneath)
        self.tick[which] = np.where(elsewhere, self._random.integers(0, _EARLIER, count), 0)
        self.applied[which] = 0.0
        self._upright[which], self._unsafe[which] = 0, False
        self._change_wind(which)

    def _anywhere(self, count: int) -> NDArray[np.float64]:
        """States (count, 2) of the safe set: angles all around, and rates with which s stays inside."""
        angle = self._random.uniform(*LONG_WAY_ROUND, count)
        ahead = np.clip(angle + AHEAD * self._random.uniform(-_FAST, _FAST, count), *LONG_WAY_ROUND)
        return np.stack((angle, (ahead - angle) / AHEAD), axis=1)

    def observation(self, which: NDArray[np.intp] | slice = slice(None)) -> Float32Array:
        """What the policy sees of the pendulums of those indices."""
        goal = np.full(len(self.state[which]), UPRIGHT)
        return observe_pendulum(self.state[which], goal, self.latent[which]).astype(np.float32)

    def exploring(self, random: np.random.Generator) -> Float32Array:
        """Actions at random, for the scales of what is observed."""
        return random.uniform(-1.0, 1.0, (self.count, 1)).astype(np.float32)

    def advance(self, chosen: Float32Array) -> PeriodResult:
        """One period under ``chosen`` (count, 1), each entry in [-1, 1] over the range of torques."""
        torque = (TORQUE * np.clip(chosen, -1.0, 1.0)).astype(np.float32)
        before = _way(self.state[:, 0])
        self.applied = self._retained(torque) if self.sheltered else torque
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
        """The torque within what keeps the corridor."""
        state, environment = torch.from_numpy(self.state), torch.from_numpy(self.environment)

        def after(bounds: torch.Tensor) -> torch.Tensor:
            return self._pendulums.advance(state, bounds, environment)[0]

        with torch.no_grad():
            retained: Float32Array = self._shelter.decide(after, state, torch.from_numpy(torque)).numpy()
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
