"""Pendulums that start beneath the hazard and have to get upright the long way round: where a policy learns.

Between policy and motor stands an exact stand-in for the safety filter: the torque is limited to what keeps the
corridor, by the simulator's own physics.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, final

import numpy as np
import torch
from numpy.typing import NDArray

from safedpa.networks import LearnedNetworks, Weights
from safedpa.policy.pendulum_observation import observe_pendulum
from safedpa_sim.pendulum.task import AHEAD, LONG_WAY_ROUND, TORQUE, UPRIGHT
from safedpa_sim.training.configuration import Configuration
from safedpa_sim.training.moved import Moved
from safedpa_sim.training.simulator import BatchedCars

__all__ = ["EPISODE_TICKS", "HELD_TICKS", "START", "Swinging", "is_upright"]

Floats = NDArray[np.float32]
Flags = NDArray[np.bool_]

EPISODE_TICKS: Final = 400
"""4 s."""
HELD_TICKS: Final = 50
"""0.5 s; for so long the pendulum has to be upright before that counts."""
START: Final = (0.05, 0.2)
"""rad below the hazard's lower edge, at rest."""
_CLOSE, _SLOW = 0.2, 1.0
"""rad and rad/s; what counts as upright."""
_ETA = 0.5
_TURNS = 0.003
"""Probability per tick that the wind becomes another."""
_STRONGEST = 4.4
"""m/s; against stronger winds the motor does not lift the pendulum."""
_TICK, _TORQUE, _UPRIGHT = 0.005, 0.002, 0.02
"""Rewards, beside the progress in rad: for each tick, the square of the full torque, each tick upright."""


def is_upright(state: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Whether states (..., 2) are at the goal and slow."""
    upright: NDArray[np.bool_] = (np.abs(state[..., 0] - UPRIGHT) < _CLOSE) & (np.abs(state[..., 1]) < _SLOW)
    return upright


@final
@dataclass
class Swinging:
    """``count`` pendulums; the same seed gives the same swings. ``sheltered`` puts the stand-in for the filter before
    each; ``penalty`` is taken off the reward when one enters the hazard; ``calm``: the wind of a swing stays.
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
        count, latents = self.count, self.weights.description.latents
        self.state: Floats = np.zeros((count, 2), dtype=np.float32)
        self.applied: Floats = np.zeros((count, 1), dtype=np.float32)
        self.environment: Floats = np.zeros((count, len(self._pendulums.entries)), dtype=np.float32)
        self.latent: Floats = np.zeros((count, latents), dtype=np.float32)
        self.tick = np.zeros(count, dtype=np.int64)
        self._upright = np.zeros(count, dtype=np.int64)
        self._unsafe = np.zeros(count, dtype=bool)
        self.restart(np.arange(count))

    def restart(self, which: NDArray[np.intp]) -> None:
        """New swings for the pendulums of those indices."""
        count = len(which)
        self.state[which, 0] = LONG_WAY_ROUND[0] + self._random.uniform(*START, count)
        self.state[which, 1] = 0.0
        self.applied[which] = 0.0
        self.tick[which], self._upright[which], self._unsafe[which] = 0, 0, False
        self._change_wind(which)

    def observation(self, which: NDArray[np.intp] | slice = slice(None)) -> Floats:
        """What the policy sees of the pendulums of those indices."""
        goal = np.full(len(self.state[which]), UPRIGHT)
        return observe_pendulum(self.state[which], goal, self.latent[which]).astype(np.float32)

    def exploring(self, random: np.random.Generator) -> Floats:
        """Actions at random, for the scales of what is observed."""
        return random.uniform(-1.0, 1.0, (self.count, 1)).astype(np.float32)

    def advance(self, chosen: Floats) -> Moved:
        """One period under ``chosen`` (count, 1), each entry in [-1, 1] over the range of torques."""
        torque = (TORQUE * np.clip(chosen, -1.0, 1.0)).astype(np.float32)
        before = np.abs(UPRIGHT - self.state[:, 0])
        self.applied = self._limited(torque) if self.sheltered else torque
        self.state = self._after(self.applied)
        self.tick += 1
        unsafe = (self.state[:, 0] < LONG_WAY_ROUND[0]) | (self.state[:, 0] > LONG_WAY_ROUND[1])
        began, self._unsafe = unsafe & ~self._unsafe, unsafe
        upright = is_upright(self.state)
        self._upright = np.where(upright, self._upright + 1, 0)
        progress = before - np.abs(UPRIGHT - self.state[:, 0])
        effort = np.square(self.applied[:, 0] / TORQUE)
        reward = progress - _TICK - _TORQUE * effort + _UPRIGHT * upright - self.penalty * began
        reached = self._upright >= HELD_TICKS
        over = self.tick >= EPISODE_TICKS
        if not self.calm:
            self._change_wind(np.flatnonzero(self._random.random(self.count) < _TURNS))
        return Moved(np.asarray(reward, dtype=np.float32), reached & over, over & ~reached, unsafe, began)

    def _limited(self, torque: Floats) -> Floats:
        """The torque within what keeps (1 - eta) h: s[t+1] rises with it, as good as linearly over one period."""
        lowest, highest = (self._ahead(self._after(np.full_like(torque, bound))) for bound in (-TORQUE, TORQUE))
        now, (low, high) = self._ahead(self.state), LONG_WAY_ROUND
        slope = (highest - lowest) / (2.0 * TORQUE)
        least = ((1.0 - _ETA) * now + _ETA * low - lowest) / slope - TORQUE
        most = ((1.0 - _ETA) * now + _ETA * high - lowest) / slope - TORQUE
        within = np.minimum(np.maximum(torque[:, 0], least), most)
        return np.clip(within, -TORQUE, TORQUE).astype(np.float32)[:, np.newaxis]

    @staticmethod
    def _ahead(state: Floats) -> Floats:
        ahead: Floats = state[:, 0] + AHEAD * state[:, 1]
        return ahead

    def _after(self, torque: Floats) -> Floats:
        tensors = (torch.from_numpy(array) for array in (self.state, torque, self.environment))
        with torch.no_grad():
            following, _ = self._pendulums.advance(*tensors)
        result: Floats = following.numpy()
        return result

    def _change_wind(self, which: NDArray[np.intp]) -> None:
        if not len(which):
            return
        drawn = self._pendulums.draw_environments(len(which), self._generator).numpy()
        drawn = drawn * np.minimum(1.0, _STRONGEST / np.linalg.norm(drawn, axis=1, keepdims=True))
        self.environment[which] = drawn
        if self.latent.shape[1]:
            self.latent[which] = self._networks.encode(drawn)
