"""Models that tell where any action leads, and what is affine about one: for filters that relinearise.

Actions here lie in [-1, 1] over a range of commands: the clean thrust's, which the body never exceeds, or the
benchmark's stock thrust, twenty times as wide, of which the body does what it can.
"""

from __future__ import annotations

from typing import Final, Protocol, final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.networks import LearnedNetworks, Weights
from safedpa_lab.point.beliefs import PROBES, motion_of
from safedpa_lab.point.free_model import FreeModel
from safedpa_sim.point.body import POINT_BODY
from safedpa_sim.point.body_steps import LARGEST_TURN, after_one_period
from safedpa_sim.point.point_model import ACTION_SCALE, PointPrediction, SimulatedPointModel
from safedpa_sim.point.simulation import PointSimulation

__all__ = ["COMMANDS", "ActionModel", "AffineModel", "FreeAction", "SimulatedBody"]


_STOCK: Final = 1.0 / POINT_BODY.force_limit
COMMANDS: Final = {"clean": ACTION_SCALE, "stock": ACTION_SCALE * np.array([_STOCK, 1.0])}
"""N and rad/s that the action 1 asks for, by kind of thrust."""
_NUDGE: Final = 1e-4
"""Of an action, for the simulated body's slopes."""


class ActionModel(Protocol):
    """A model of the robots as they are, of all of them or of some."""

    def see(self, state: FloatArray) -> None:
        """The robots' states (robots, 5) in this period."""

    def about(self, action: FloatArray, which: NDArray[np.intp]) -> PointPrediction:
        """x[t+1] = drift + gain a for robots ``which`` (n,), exact in value and slope at actions (n, 2) in [-1, 1]."""

    def following(self, action: FloatArray, which: NDArray[np.intp]) -> FloatArray:
        """(n, 5): where actions (n, 2) lead."""


@final
class AffineModel:
    """f + g a of learned networks, the same about every action; latents (robots, latents) stay as they are."""

    def __init__(self, weights: Weights, latent: FloatArray, scale: FloatArray) -> None:
        self._networks, self._latent, self._scale = LearnedNetworks(weights), latent, scale

    def see(self, state: FloatArray) -> None:  # noqa: D102
        f, g = self._networks.increment(state, self._latent)
        probes = np.broadcast_to(PROBES, (len(state), *PROBES.shape))
        motion = motion_of(*self._scaled(self._networks.increment(probes, self._latent[:, np.newaxis])))
        range_of_one = np.array([float(np.mean(motion.strongest)), LARGEST_TURN])
        self._believed = PointPrediction(state + f, g * self._scale, motion, range_of_one)

    def about(self, action: FloatArray, which: NDArray[np.intp]) -> PointPrediction:  # noqa: D102
        del action
        return _of(self._believed, which)

    def following(self, action: FloatArray, which: NDArray[np.intp]) -> FloatArray:  # noqa: D102
        return self.about(action, which).next_state(action)

    def _scaled(self, increment: tuple[FloatArray, FloatArray]) -> tuple[FloatArray, FloatArray]:
        return increment[0], increment[1] * self._scale


@final
class FreeAction:
    """H(x, z, a) of free networks, and what its own slope makes of it.

    The manoeuvre's motion at the probe states: wind and drag without an action, the strongest thrust as half of what
    lies between full thrust ahead and astern; an action's worth, by which the manoeuvre becomes one, by the slope at
    rest, so that what the manoeuvre asks for is what saturates.
    """

    def __init__(self, model: FreeModel, latent: FloatArray, scale: FloatArray) -> None:
        self._model, self._latent, self._scale = model, latent, scale

    def see(self, state: FloatArray) -> None:  # noqa: D102
        self._state = state
        probes, latents = np.tile(PROBES, (len(state), 1)), self._latent.repeat(len(PROBES), axis=0)
        shape = (len(state), *PROBES.shape)
        f, slope = self._model.linearised(probes, latents, np.zeros((len(probes), 2)))
        full = np.broadcast_to(self._scale * np.array([1.0, 0.0]), (len(probes), 2))
        ahead, astern = (self._model.increment(probes, latents, sign * full) for sign in (1.0, -1.0))
        reach = np.stack((0.5 * (ahead - astern), np.zeros_like(ahead)), axis=-1)
        self._motion = motion_of(f.reshape(shape), reach.reshape(*shape, 2))
        first = motion_of(f.reshape(shape), (slope * self._scale).reshape(*shape, 2)).strongest
        self._range = np.array([float(max(np.mean(first), np.mean(self._motion.strongest))), LARGEST_TURN])

    def about(self, action: FloatArray, which: NDArray[np.intp]) -> PointPrediction:  # noqa: D102
        state = self._state[which]
        value, slope = self._model.linearised(state, self._latent[which], action * self._scale)
        gain = slope * self._scale
        drift = state + value - np.einsum("rsa,ra->rs", gain, action)
        return PointPrediction(drift, gain, self._motion.of(which), self._range)

    def following(self, action: FloatArray, which: NDArray[np.intp]) -> FloatArray:  # noqa: D102
        state = self._state[which]
        return state + self._model.increment(state, self._latent[which], action * self._scale)


@final
class SimulatedBody:
    """The simulated robots themselves, yaw rates included: slopes by central differences."""

    def __init__(self, simulation: PointSimulation, scale: FloatArray) -> None:
        self._simulation, self._scale = simulation, scale
        self._wind = simulation.force.T / simulation.body.mass

    def see(self, state: FloatArray) -> None:  # noqa: D102
        self._state, self._rate = state, self._simulation.velocity[2].copy()
        reported = SimulatedPointModel(self._simulation).predict(state, np.zeros((len(state), 0)))
        self._motion = reported.motion
        self._range = reported.scale * self._scale / ACTION_SCALE

    def about(self, action: FloatArray, which: NDArray[np.intp]) -> PointPrediction:  # noqa: D102
        nudges = _NUDGE * np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
        around = (action + nudges[:, np.newaxis]).reshape(-1, 2)
        value, *sides = self.following(around, np.tile(which, len(nudges))).reshape(len(nudges), len(which), 5)
        gain = np.stack([(sides[at] - sides[at + 1]) / (2.0 * _NUDGE) for at in (0, 2)], axis=-1)
        drift = value - np.einsum("rsa,ra->rs", gain, action)
        return PointPrediction(drift, gain, self._motion.of(which), self._range)

    def following(self, action: FloatArray, which: NDArray[np.intp]) -> FloatArray:  # noqa: D102
        sent = action * self._scale
        return after_one_period(self._state[which], sent, self._rate[which], self._wind[which])[0]


def _of(believed: PointPrediction, which: NDArray[np.intp]) -> PointPrediction:
    return PointPrediction(believed.drift[which], believed.gain[which], believed.motion.of(which), believed.scale)
