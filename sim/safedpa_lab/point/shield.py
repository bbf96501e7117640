"""The safety filter of one method before all robots of a task, with the histories and latents that belong to it.

What the networks of the sensed state make of many point robots: SafeDPA with 17 numbers for the same filter.

They predict what will be sensed; the filter's barriers live in the world. So the prediction is decoded as what is
sensed is, and made affine in the action about none:

    drift = decoded(s + f(s, z)),   gain = d decoded / d s at s + f(s, z) times g(s, z)
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final, final

import numpy as np
from numpy.typing import NDArray

from safedpa.adaptation.batch_history_estimator import BatchHistoryEstimator
from safedpa.arrays import FloatArray
from safedpa.errors import InputError, did_you_mean
from safedpa.networks import LearnedNetworks, Weights, load_weights
from safedpa.safety.barriers.stopping import Motion
from safedpa_lab.point.baseline_set import SHIPPED
from safedpa_lab.point.beliefs import PROBES, LearnedBelief, from_task_action, motion_of, scale_of, weights_named
from safedpa_sim.point.filtering import (
    ACTION_SCALE,
    AbstractPointModel,
    FilteredActions,
    PointFilter,
    PointPrediction,
    SimulatedPointModel,
    to_task_action,
)
from safedpa_sim.point.observation import SENSED_FRAME, decode_state, decoding_jacobian, sensed, without_goal
from safedpa_sim.point.policy_task import EPSILON as TRAINING_EPSILON
from safedpa_sim.point.simulation import PointSimulation, centre_state, put_state
from safedpa_sim.point.task import PointTask

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


EPSILON: Final = 0.005
"""m; where no one measured one: of a diagnosed model, and while moments are drawn behind the truth."""
FIXED_DIRECTIONS: Final = (45, 135, 225, 315)
METHODS: Final = (
    "safedpa",
    "safedpa_17",
    *(f"fix_{direction}" for direction in FIXED_DIRECTIONS),
    "mix",
    "oracle",
    "physics",
    "none",
)
"""Whose model the filter believes: learned with the latent; learned of what is sensed; of one force alone; of all at
once; the truth; the truth but for the wind; no filter."""


Adaptation = BatchHistoryEstimator | TwoHistories


@final
class Shield:
    """Each period ``see`` the robots, then ``act``; ``reset`` those that begin a new episode.

    ``belief`` nothing: nominal actions pass as they are. ``adaptation`` nothing: latents of no entries.
    """

    def __init__(
        self, count: int, belief: AbstractPointModel | None, adaptation: Adaptation | None, epsilon: float = EPSILON
    ) -> None:
        self._belief, self._adaptation, self._filter = belief, adaptation, PointFilter(epsilon)
        self._nothing = np.zeros((count, 0))
        self._state: FloatArray | None = None
        self._believed: PointPrediction | None = None

    def reset(self, which: NDArray[np.intp]) -> None:
        """The robots of those indices have been put elsewhere: forget their histories."""
        if self._adaptation is not None:
            self._adaptation.reset(which)
        self._state = self._believed = None

    def see(self, task: PointTask) -> FloatArray:
        """The latents (robots, latents) of the robots as they are; twice in a period changes nothing."""
        if self._state is None:
            self._state = centre_state(task.simulation)
            if self._adaptation is not None:
                self._adaptation.see(self._state)
        return self.latent

    @property
    def latent(self) -> FloatArray:
        """What was seen last."""
        return self._nothing if self._adaptation is None else self._adaptation.latent

    def believes(self, task: PointTask) -> PointPrediction:
        """What the filter's model says of the robots as they are. Raises InputError where there is no filter."""
        if self._belief is None:
            raise InputError("shield: got no filter, wanted one whose model can be asked")
        self.see(task)
        if self._believed is None:
            state = centre_state(task.simulation) if self._state is None else self._state
            self._believed = self._belief.predict(state, self.latent)
        return self._believed

    def act(self, task: PointTask, nominal: NDArray[np.floating]) -> FilteredActions:
        """Safe actions of ``PointTask`` for nominal actions (robots, 2) of it, to be carried out at once."""
        self.see(task)
        scaled = from_task_action(np.asarray(nominal, dtype=np.float64))
        chosen = self._safe(task, scaled)
        self.acted(chosen.action)
        return FilteredActions(to_task_action(chosen.action), chosen.corrected, chosen.relaxed)

    def acted(self, action: FloatArray) -> None:
        """Actions (robots, 2) in [-1, 1] over the range of commands are being carried out."""
        if self._adaptation is not None:
            self._adaptation.acted(action * ACTION_SCALE)
        self._state = self._believed = None

    def _safe(self, task: PointTask, nominal: FloatArray) -> FilteredActions:
        if self._belief is None:
            unchanged = np.zeros(len(nominal), bool)
            return FilteredActions(nominal, unchanged, unchanged)
        state = centre_state(task.simulation) if self._state is None else self._state
        return self._filter.decide(state, nominal, task.layout.hazards, self.believes(task))


def shield_of(
    method: str, task: PointTask, *, adapts: str = "learned", epsilon: float = EPSILON, folder: Path = Path()
) -> Shield:
    """The filter of one of ``METHODS`` for the robots of a task.

    ``adapts`` names the weights whose phi gives the latents, for the filter of SafeDPA and for any policy; nothing: no
    latents. Raises InputError for a method or a model that there is none of.
    """
    if method not in METHODS:
        raise InputError(f"method '{method}': {did_you_mean(method, METHODS)}")
    adaptation = BatchHistoryEstimator(weights_named(adapts, folder), task.count) if adapts else None
    if method in ("safedpa", "safedpa_17") and adaptation is None:
        raise InputError(f"method '{method}': got no model to adapt with, wanted adapts='learned' or another with phi")
    if method == "safedpa_17" and adaptation is not None:
        weights = sensed_weights(folder)
        histories = TwoHistories(adaptation, weights, task)
        return Shield(task.count, SensedBelief(weights, histories, task), histories, epsilon)
    return Shield(task.count, _belief(method, adapts, task, folder), adaptation, epsilon)


def _belief(method: str, adapts: str, task: PointTask, folder: Path) -> AbstractPointModel | None:
    if method == "none":
        return None
    if method in ("oracle", "physics"):
        return SimulatedPointModel(task.simulation, wind=method == "oracle")
    return LearnedBelief(weights_named(adapts if method == "safedpa" else method, folder))


DIRECTIONS: Final = 24
"""Of the wind, evenly around."""


@final
class LearningShield:
    """A method's filter before robots that learn: what is carried out is the shield's.

    With a ``force`` [N] each episode has a wind towards one of the directions, drawn from ``seed`` in the order of the
    beginnings: anyone who begins at the same steps meets the same. Without one episodes are as the task draws them.
    """

    def __init__(self, task: PointTask, shield: Shield, force: float | None = None, seed: int = 0) -> None:
        self._task, self._shield, self._force = task, shield, force
        self._random = np.random.default_rng([seed, 71])
        self.corrected = self.relaxed = np.zeros(task.count, bool)
        """(robots,): where the last action is not the nominal action; where not every condition could be kept."""
        self._blow(np.arange(task.count))

    def safe(self, chosen: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        """Actions (robots, 2) of ``PointTask`` for those that were chosen, to be carried out at once."""
        found = self._shield.act(self._task, chosen)
        self.corrected, self.relaxed = found.corrected, found.relaxed
        return found.action

    def restart(self, which: NDArray[np.intp]) -> None:
        """New episodes for the robots of those indices; the filter forgets what it knew of the old ones."""
        self._task.restart(which)
        self._blow(which)
        self._shield.reset(which)

    def _blow(self, which: NDArray[np.intp]) -> None:
        if self._force is not None:
            towards = 2.0 * np.pi / DIRECTIONS * self._random.integers(0, DIRECTIONS, len(which))
            self._task.simulation.force[:, which] = self._force * np.stack((np.cos(towards), np.sin(towards)))


def true_shelter(task: PointTask) -> LearningShield:
    """The filter that knows the simulated physics: a stand-in of SafeDPA's filter in training."""
    return LearningShield(task, Shield(task.count, SimulatedPointModel(task.simulation), None, TRAINING_EPSILON))
