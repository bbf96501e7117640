"""A method at the wheel of all robots of a task: its policy, given its inputs, behind its filter."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from hashlib import sha256
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.errors import InputError
from safedpa.robots.point.goal_seeker import goal_seeking_action
from safedpa_lab.point.baseline_set import baseline_named, seeds_of
from safedpa_lab.point.beliefs import LearnedBelief
from safedpa_lab.point.driven import Driver, PolicyDriver
from safedpa_lab.point.inputs import inputs_of
from safedpa_lab.point.methods import METHODS, PENALISED, SEEKER, Method
from safedpa_lab.point.shield import Shield, shield_of
from safedpa_lab.point.weights import weights_named
from safedpa_sim.point.body_steps import centre_state
from safedpa_sim.point.filtering import around_hazards
from safedpa_sim.point.observation import policy_seen
from safedpa_sim.point.point_model import AbstractPointModel, to_task_action
from safedpa_sim.point.route_planner import RoutePlanner
from safedpa_sim.point.task import PointTask

__all__ = ["ShieldedDriver", "Wheel", "digest_of", "driver_of", "penalised", "training_seeds", "with_weights"]

NominalPolicy = Callable[[FloatArray], NDArray[np.floating[Any]]]


@final
@dataclass(frozen=True)
class Wheel:
    """Where weights are looked for before those that ship, and what is left open by a method's name."""

    models: Path = Path()
    baselines: Path = Path()
    margins: Mapping[str, float] = field(default_factory=dict)
    """m, by filter."""
    seed: int | None = None
    """Of a baseline's training; nothing: the first that there is."""


@final
class ShieldedDriver:
    """A nominal action, of the latents as they are, through the filter."""

    def __init__(self, task: PointTask, shield: Shield, nominal: NominalPolicy) -> None:
        self.task, self.shield, self._nominal = task, shield, nominal
        self.corrected = self.relaxed = np.zeros(task.count, bool)

    def act(self) -> FloatArray:  # noqa: D102
        nominal = self._nominal(self.shield.see(self.task))
        found = self.shield.act(self.task, nominal)
        self.corrected, self.relaxed = found.corrected, found.relaxed
        return found.action


def driver_of(method: Method, task: PointTask, wheel: Wheel) -> Driver:
    """The method at the wheel of a task's robots; weights from the folders, or else those that ship.

    Raises InputError where there are none, or no margin for its filter.
    """
    adapts = method.policy if method.policy not in ("", SEEKER) else "learned"
    if method.baseline:
        policy = baseline_named(method.baseline, wheel.baselines, _seed(method, wheel))
        inputs = inputs_of(policy.inputs, task, wheel.models)
        if not method.filter:
            return PolicyDriver(task, policy, inputs)
        nominal: NominalPolicy = lambda _: policy.act(inputs.see())  # noqa: E731
    elif method.policy == SEEKER:
        nominal = _seeking(task, LearnedBelief(weights_named("learned", wheel.models)))
    else:
        nominal = _learned(task, method.policy, wheel.models)
    if not method.filter:
        return ShieldedDriver(task, shield_of("none", task, adapts=adapts, folder=wheel.models), nominal)
    if method.filter not in wheel.margins:
        raise InputError(f"{method.name}: got no margin for the filter '{method.filter}', wanted one of every filter")
    epsilon = wheel.margins[method.filter]
    shield = shield_of(method.filter, task, epsilon=epsilon, adapts=adapts, folder=wheel.models)
    return ShieldedDriver(task, shield, nominal)


def training_seeds(method: Method, baselines: Path) -> tuple[int | None, ...]:
    """Of which there are policies of a method: each is driven. One of nothing where it is no baseline's."""
    return seeds_of(method.baseline, baselines) if method.baseline else (None,)


def digest_of(method: Method, wheel: Wheel) -> str:
    """Of the weights of a method's policy, where it has any. Raises InputError where there are none."""
    if method.baseline:
        policy = baseline_named(method.baseline, wheel.baselines, _seed(method, wheel))
        parts = (part.tobytes() for _, part in sorted(policy.tensors.items()))
        return sha256(b"".join(parts)).hexdigest()[:16]
    return "" if method.policy == SEEKER else weights_named(method.policy, wheel.models).digest[:16]


def penalised(models: Path) -> tuple[str, ...]:
    """Those of RMA-P's grid that are in the folder or ship."""
    found = []
    for name in PENALISED:
        with contextlib.suppress(InputError):
            weights_named(name, models)
            found.append(name)
    return tuple(found)


def with_weights(models: Path, baselines: Path) -> tuple[str, ...]:
    """Those of ``METHODS`` whose weights are in the folders or ship."""
    task, found = PointTask(1, 0), []
    for name, method in METHODS.items():
        with contextlib.suppress(InputError):
            own = penalised(models) or (method.policy,) if name == "rma_p" else (method.policy,)
            driver_of(replace(method, policy=own[0]), task, Wheel(models, baselines, {method.filter: 0.0}))
            found.append(name)
    return tuple(found)


def _seed(method: Method, wheel: Wheel) -> int:
    if wheel.seed is not None:
        return wheel.seed
    return next(iter(seeds_of(method.baseline, wheel.baselines)), 0)


def _learned(task: PointTask, name: str, models: Path) -> NominalPolicy:
    from safedpa_sim.point.latent_policy import LatentPolicy

    learned, ways = LatentPolicy(weights_named(name, models)), RoutePlanner(task.count)

    def nominal_action(latent: FloatArray) -> FloatArray:
        place, layout = task.simulation.pose[:2].T, task.layout
        turn, _ = ways.first_turns(place, layout.hazards, layout.goal)
        return learned.act(policy_seen(task, latent, turn))

    return nominal_action


def _seeking(task: PointTask, belief: AbstractPointModel) -> NominalPolicy:
    """The robot's own goal seeker, in the wind that the latent stands for."""

    def nominal_action(latent: FloatArray) -> FloatArray:
        state, layout = centre_state(task.simulation), task.layout
        believed = belief.predict(state, latent)
        hazards = around_hazards(layout.hazards, believed.motion).hazards
        found = []
        for robot in range(task.count):
            motion = believed.motion.of(robot)
            found.append(
                goal_seeking_action(state[robot], layout.goal[robot], hazards[robot], motion.wind, float(motion.drag))
            )
        return to_task_action(np.clip(found / believed.scale, -1.0, 1.0))

    return nominal_action
