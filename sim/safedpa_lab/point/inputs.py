"""What a policy is given of the point robots of a task: the benchmark's sensors, or what SafeDPA's own policy gets.

    lidar    o = (sensors, goal, lidar) / scale                                         31 entries
    latent   o = (sensors, goal, lidar) / scale, z cos yaw, z sin yaw, z                37
    equal    o = clip((policy_seen(z, turn) - middle) / scale, -10, 10)                 43

z = phi(history) of the encoder that ships, of what the motors did; ``turn``: where the shortest way turns first. Middle
and scale of ``equal`` are those of SafeDPA's policy.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final, Protocol, final

import numpy as np
from numpy.typing import NDArray

from safedpa.adaptation.batch_history_estimator import BatchHistoryEstimator
from safedpa.arrays import Float32Array, FloatArray
from safedpa.errors import InputError, did_you_mean
from safedpa.networks import Weights
from safedpa_lab.point.beliefs import weights_named
from safedpa_lab.point.plan import INPUTS
from safedpa_sim.point.body_steps import actions_of, centre_state
from safedpa_sim.point.layout import GOAL_RADIUS
from safedpa_sim.point.observation import entries_seen, policy_seen
from safedpa_sim.point.route_planner import RoutePlanner
from safedpa_sim.point.task import GOAL_REWARD, PointTask

OBSERVATION_SCALE: Final = np.array(
    [2.0, 2.0, 10.0, 1.0, 1.0, 1.0, 1.0, 1.0, 3.0, 0.5, 0.5, 0.5, 1.0, 1.0, 1.5] + [1.0] * 16
)
"""What counts as 1 in each entry of the benchmark's: m/s2, m/s, rad/s, magnetic field, m."""
_LATENTS: Final = 2
_LARGEST: Final = 10.0
_JUMP: Final = 0.3
"""m; a way past the other side of a hazard may be longer at once, by no more than this in the reward."""


def entries_of(kind: str) -> int:
    """The number of inputs of a policy. Raises InputError for inputs that are none."""
    sizes = {
        "lidar": len(OBSERVATION_SCALE),
        "latent": len(OBSERVATION_SCALE) + 3 * _LATENTS,
        "equal": entries_seen(_LATENTS),
    }
    if kind not in sizes:
        raise InputError(f"inputs '{kind}': {did_you_mean(kind, INPUTS)}")
    return sizes[kind]


class Inputs(Protocol):
    """In each period ``see`` once; ``reset`` the robots that begin again."""

    def see(self) -> Float32Array:
        """(robots, entries) of the robots as they are."""

    def look(self) -> Float32Array:
        """The same with the latents that were seen last."""

    def reset(self, which: NDArray[np.intp]) -> None:
        """The robots of those indices have been put elsewhere."""


@final
class WayAhead:
    """The robots' shortest ways, kept until ``renew``, and what was gained along them since."""

    def __init__(self, task: PointTask) -> None:
        self._task, self._ways = task, RoutePlanner(task.count)
        self.renew()

    def renew(self) -> None:
        """``turn`` (robots, 2): where the ways turn first; ``left`` (robots,): how long they are [m]."""
        layout = self._task.layout
        self.turn, self.left = self._ways.first_turns(self._task.simulation.pose[:2].T, layout.hazards, layout.goal)

    def gained(self, reached: NDArray[np.bool_]) -> FloatArray:
        """m along the way since the last call or ``renew``; where a goal was reached, what was left to it, and 1."""
        before = self.left
        self.renew()
        gained = np.clip(before - self.left, -_JUMP, _JUMP)
        return np.where(reached, before - GOAL_RADIUS + GOAL_REWARD, gained)


def inputs_of(kind: str, task: PointTask, folder: Path = Path(), way: WayAhead | None = None) -> Inputs:
    """Of one of ``INPUTS``. With a ``way``, anyone who keeps it renews it. Raises InputError for others."""
    entries_of(kind)
    if kind == "lidar":
        return _Sensors(task)
    weights = weights_named("learned", folder)
    return _WithLatent(task, weights) if kind == "latent" else _AsSafeDPA(task, weights, way)


@final
class _Sensors:
    def __init__(self, task: PointTask) -> None:
        self._task = task

    def see(self) -> Float32Array:
        return self.look()

    def look(self) -> Float32Array:
        seen: Float32Array = (self._task.observation() / OBSERVATION_SCALE).astype(np.float32)
        return seen

    def reset(self, which: NDArray[np.intp]) -> None:
        """Nothing is remembered."""


class _Remembering:
    """The latents of the robots of a task, of what their motors did."""

    def __init__(self, task: PointTask, weights: Weights) -> None:
        self._task, self._histories = task, BatchHistoryEstimator(weights, task.count)

    def reset(self, which: NDArray[np.intp]) -> None:
        self._histories.reset(which)

    def _remember(self) -> None:
        self._histories.acted(actions_of(self._task.control))  # what led here; of no account at the beginning
        self._histories.see(centre_state(self._task.simulation))


@final
class _WithLatent(_Remembering):
    def see(self) -> Float32Array:
        self._remember()
        return self.look()

    def look(self) -> Float32Array:
        latent, yaw = self._histories.latent, self._task.simulation.pose[2, :, np.newaxis]
        turned = (latent * np.cos(yaw), latent * np.sin(yaw), latent)
        seen = np.concatenate((self._task.observation() / OBSERVATION_SCALE, *turned), axis=1)
        return seen.astype(np.float32)


@final
class _AsSafeDPA(_Remembering):
    def __init__(self, task: PointTask, weights: Weights, way: WayAhead | None) -> None:
        super().__init__(task, weights)
        self._middle: Any = weights["observation_middle"]
        self._scale: Any = weights["observation_scale"]
        self._own = way is None
        self._way = WayAhead(task) if way is None else way

    def see(self) -> Float32Array:
        self._remember()
        if self._own:
            self._way.renew()
        return self.look()

    def look(self) -> Float32Array:
        seen = policy_seen(self._task, self._histories.latent, self._way.turn)
        scaled: Float32Array = ((seen - self._middle) / self._scale).clip(-_LARGEST, _LARGEST).astype(np.float32)
        return scaled
