"""What the networks of the sensed state make of many point robots: SafeDPA with 17 numbers for the same filter.

They predict what will be sensed; the filter's barriers live in the world. So the prediction is decoded as what is
sensed is, and made affine in the action about none:

    drift = decoded(s + f(s, z)),   gain = d decoded / d s at s + f(s, z) times g(s, z)
"""

from __future__ import annotations

from pathlib import Path
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from safedpa.adaptation.batch_history_estimator import BatchHistoryEstimator
from safedpa.arrays import FloatArray
from safedpa.errors import InputError
from safedpa.networks import LearnedNetworks, Weights, load_weights
from safedpa.safety.barriers.stopping import Motion
from safedpa_lab.point.baseline_set import SHIPPED
from safedpa_lab.point.beliefs import PROBES, motion_of, scale_of
from safedpa_sim.point.body_steps import centre_state, put_state
from safedpa_sim.point.point_model import ACTION_SCALE, PointPrediction
from safedpa_sim.point.sensor_state import SENSED_FRAME, decode_state, decoding_jacobian, sensed, without_goal
from safedpa_sim.point.simulation import PointSimulation
from safedpa_sim.point.task import PointTask

__all__ = ["SensedBelief", "TwoHistories", "sensed_weights"]


_FILE: Final = "point_17.safetensors"
_SETTLING: Final = 3
"""Times that a probe's accelerometer is asked for."""
_PROBE_GOAL: Final = 1.0
"""m ahead of a probe: any place would do."""


def sensed_weights(folder: Path = Path()) -> Weights:
    """Those in the folder, or else those that ship. Raises InputError for weights of another state."""
    own = folder / _FILE
    weights = load_weights(own if own.exists() else SHIPPED / _FILE)
    if weights.description.states != SENSED_FRAME.feature_names:
        raise InputError(f"{weights.source}: got weights of another state, wanted those of --phases 17; train again")
    return weights


@final
class TwoHistories:
    """``BatchHistoryEstimator`` of the filter's state, whose latents the policy gets, and those of what is sensed."""

    def __init__(self, policy: BatchHistoryEstimator, weights: Weights, task: PointTask) -> None:
        self._policy, self._task = policy, task
        self._sensed = BatchHistoryEstimator(weights, task.count, SENSED_FRAME)

    @property
    def latent(self) -> FloatArray:
        """The policy's."""
        return self._policy.latent

    @property
    def sensed_latent(self) -> FloatArray:
        """(robots, 2), of the networks that predict what is sensed."""
        return self._sensed.latent

    def see(self, state: FloatArray) -> FloatArray:
        """The policy's latents at states (robots, 5); the sensors are read as well."""
        self._sensed.see(without_goal(self.seen()))
        return self._policy.see(state)

    def seen(self) -> FloatArray:
        """(robots, 15), now."""
        task = self._task
        return sensed(task.simulation, task.control, task.layout.goal)

    def acted(self, action: FloatArray) -> None:
        """Takes the actions (robots, 2) that act from now on, in N and rad/s."""
        self._policy.acted(action)
        self._sensed.acted(action)

    def reset(self, which: NDArray[np.intp]) -> None:
        """Those robots begin again."""
        self._policy.reset(which)
        self._sensed.reset(which)


@final
class SensedBelief:
    """f and g of what is sensed, decoded; the manoeuvre's motion as for ``LearnedBelief``, at the same probe states.

    What a probe's accelerometer reads depends on the wind, which z encodes: what the networks say that it reads after a
    period without an action. Reading nothing, it would speak of another wind than z does.
    """

    def __init__(self, weights: Weights, histories: TwoHistories, task: PointTask) -> None:
        self.networks = LearnedNetworks(weights, SENSED_FRAME)
        self._histories, self._task = histories, task
        self._probes, self._probe_goal = _probes()

    def predict(self, state: FloatArray, latent: FloatArray) -> PointPrediction:
        """By its own latents, not by ``latent``, which is the policy's."""
        del latent
        own, goal = self._histories.sensed_latent, self._task.layout.goal
        change, gain = self._decoded(self._histories.seen(), goal, own)
        motion = self._motion(own)
        return PointPrediction(state + change, gain, motion, scale_of(motion))

    def _motion(self, latent: FloatArray) -> Motion:
        probes = np.broadcast_to(self._probes, (len(latent), *self._probes.shape)).copy()
        for _ in range(_SETTLING):
            f, _ = self.networks.increment(probes, latent[:, np.newaxis])
            probes[..., :2] += f[..., :2]
        return motion_of(*self._decoded(probes, self._probe_goal, latent[:, np.newaxis]))

    def _decoded(self, seen: FloatArray, goal: FloatArray, latent: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The change (..., 5) of the filter's state without an action, and its slopes (..., 5, 2) over [-1, 1]."""
        f, g = self.networks.increment(seen, latent)
        following = seen + f
        change = decode_state(following, goal) - decode_state(seen, goal)
        change[..., 2] = (change[..., 2] + np.pi) % (2.0 * np.pi) - np.pi
        return change, decoding_jacobian(following) @ (g * ACTION_SCALE)


def _probes() -> tuple[FloatArray, FloatArray]:
    """What is sensed (6, 15) at the probe states, in no wind, and where the goals lie then (6, 2)."""
    simulation = PointSimulation(len(PROBES))
    put_state(simulation, PROBES, np.zeros(len(PROBES)))
    heading = np.stack((np.cos(PROBES[:, 2]), np.sin(PROBES[:, 2])), axis=1)
    goal = centre_state(simulation)[:, :2] + _PROBE_GOAL * heading
    seen = sensed(simulation, np.zeros((2, len(PROBES))), goal)
    return seen, goal
