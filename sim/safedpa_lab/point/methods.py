"""The methods that are compared on the point robot: each a policy, and a filter or none."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, final

import numpy as np
from numpy.typing import NDArray

from safedpa.errors import InputError
from safedpa.robots.point.point_seeker import sought
from safedpa_lab.point.baseline_set import baseline_named
from safedpa_lab.point.beliefs import LearnedBelief
from safedpa_lab.point.driven import Driver, PolicyDriver
from safedpa_lab.point.plan import BASELINES
from safedpa_lab.point.shield import FIXED_DIRECTIONS, Shield, shield_of, weights_named
from safedpa_sim.point.belief import Belief, to_task_action
from safedpa_sim.point.body_steps import centre_state
from safedpa_sim.point.filtering import around_hazards
from safedpa_sim.point.observation import policy_seen
from safedpa_sim.point.task import PointTask
from safedpa_sim.point.way import Ways

__all__ = ["BASELINE_TITLES", "METHODS", "Method", "ShieldedDriver", "driver_of", "with_weights"]

Floats = NDArray[np.float64]
Wish = Callable[[Floats], NDArray[np.floating[Any]]]

BASELINE_TITLES: Final = {
    "ppo": "PPO",
    "trpo": "TRPO",
    "ppo_lagrangian": "PPO-Lagrangian",
    "trpo_lagrangian": "TRPO-Lagrangian",
    "cpo": "CPO",
}


@final
@dataclass(frozen=True)
class Method:
    """One line of the table. ``policy``: a learned model's (by ``adapts``' latent), or a baseline's; ``filter``: whose
    model it believes, empty for none."""

    name: str
    title: str
    policy: str = "learned"
    filter: str = ""


_FIXED: Final = [
    Method(f"fix_{direction}", f"Fix-{direction}", filter=f"fix_{direction}") for direction in FIXED_DIRECTIONS
]
METHODS: Final = {
    method.name: method
    for method in (
        Method("safedpa", "SafeDPA", filter="safedpa"),
        *_FIXED,
        Method("mix", "Mix", filter="mix"),
        Method("physics", "knows all but the wind", filter="physics"),
        Method("oracle", "knows the wind", filter="oracle"),
        Method("unfiltered", "SafeDPA without filter"),
        Method("rma_p", "RMA-P", policy="rma_p"),
        *(Method(name, BASELINE_TITLES[name], policy=name) for name in BASELINES),
        Method("ppo_filtered", "PPO behind SafeDPA's filter", policy="ppo", filter="safedpa"),
        Method("seeker", "goal seeker behind SafeDPA's filter", policy="seeker", filter="safedpa"),
    )
}


@final
class ShieldedDriver:
    """A wish, of the latents as they are, through the filter."""

    def __init__(self, task: PointTask, shield: Shield, wish: Wish) -> None:
        self._task, self._shield, self._wish = task, shield, wish
        self.corrected = self.relaxed = np.zeros(task.count, bool)

    def act(self) -> Floats:  # noqa: D102
        wish = self._wish(self._shield.see(self._task))
        found = self._shield.act(self._task, wish)
        self.corrected, self.relaxed = found.corrected, found.relaxed
        return found.action


def driver_of(method: Method, task: PointTask, models: Path, baselines: Path) -> Driver:
    """The method at the wheel of a task's robots; weights from the folders, or else those that ship.

    Raises InputError where there are none.
    """
    if method.policy in BASELINES:
        policy = baseline_named(method.policy, "wind", baselines)
        if not method.filter:
            return PolicyDriver(task, policy)
        shield = shield_of(method.filter, task, folder=models)
        return ShieldedDriver(task, shield, lambda _: policy.act(task.observation()))
    if method.policy == "seeker":
        shield = shield_of(method.filter, task, folder=models)
        return ShieldedDriver(task, shield, _seeking(task, LearnedBelief(weights_named("learned", models))))
    from safedpa_sim.point.latent_policy import LatentPolicy

    learned = LatentPolicy(weights_named(method.policy, models))
    shield = shield_of(method.filter or "none", task, adapts=method.policy, folder=models)
    ways = Ways(task.count)

    def wish(latent: Floats) -> Floats:
        place, layout = task.simulation.pose[:2].T, task.layout
        turn, _ = ways.first_turns(place, layout.hazards, layout.goal)
        return learned.act(policy_seen(task, latent, turn))

    return ShieldedDriver(task, shield, wish)


def with_weights(models: Path, baselines: Path) -> tuple[str, ...]:
    """Those of ``METHODS`` whose weights are in the folders or ship."""
    task, found = PointTask(1, 0), []
    for name, method in METHODS.items():
        with contextlib.suppress(InputError):
            driver_of(method, task, models, baselines)
            found.append(name)
    return tuple(found)


def _seeking(task: PointTask, belief: Belief) -> Wish:
    """The robot's own goal seeker, in the wind that the latent stands for."""

    def wish(latent: Floats) -> Floats:
        state, layout = centre_state(task.simulation), task.layout
        believed = belief.believed(state, latent)
        hazards = around_hazards(layout.hazards, believed.motion).hazards
        found = []
        for robot in range(task.count):
            motion = believed.motion.of(robot)
            found.append(sought(state[robot], layout.goal[robot], hazards[robot], motion.wind, float(motion.drag)))
        return to_task_action(np.clip(found / believed.scale, -1.0, 1.0))

    return wish
