"""What a policy is given of the point robots of a task: the benchmark's sensors, or what SafeDPA's own policy gets.

    lidar    o = (sensors, goal, lidar) / scale                                         31 entries
    latent   o = (sensors, goal, lidar) / scale, z cos yaw, z sin yaw, z                37
    equal    o = clip((policy_seen(z, turn) - middle) / scale, -10, 10)                 43

z = phi(history) of the encoder that ships, of what the motors did; ``turn``: where the shortest way turns first. Middle
and scale of ``equal`` are those of SafeDPA's policy.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from safedpa.adaptation.batch_history_estimator import BatchHistoryEstimator
from safedpa.arrays import Float32Array, FloatArray
from safedpa.errors import InputError, did_you_mean
from safedpa_lab.point.beliefs import weights_named
from safedpa_lab.point.plan import INPUTS
from safedpa_sim.point.layout import GOAL_RADIUS
from safedpa_sim.point.observation import entries_seen, policy_seen
from safedpa_sim.point.route_planner import RoutePlanner
from safedpa_sim.point.simulation import actions_of, centre_state
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


@final
class Inputs:
    """One of ``INPUTS``. In each period ``see`` once; ``reset`` the robots that begin again.

    With a ``way``, anyone who keeps it renews it. Raises InputError for other kinds.
    """

    def __init__(self, kind: str, task: PointTask, folder: Path = Path(), way: WayAhead | None = None) -> None:
        entries_of(kind)
        self._kind, self._task, self._own, self._way = kind, task, None, way
        self._histories: BatchHistoryEstimator | None = None
        if kind != "lidar":
            self._weights = weights_named("learned", folder)
            self._histories = BatchHistoryEstimator(self._weights, task.count)
        if kind == "equal" and way is None:
            self._way = self._own = WayAhead(task)

    def see(self) -> Float32Array:
        """(robots, entries) of the robots as they are."""
        if self._histories is not None:
            self._histories.acted(actions_of(self._task.control))  # what led here; of no account at the beginning
            self._histories.see(centre_state(self._task.simulation))
        if self._own is not None:
            self._own.renew()
        return self.look()

    def look(self) -> Float32Array:
        """The same with the latents that were seen last."""
        task = self._task
        if self._histories is None:
            return np.asarray(task.observation() / OBSERVATION_SCALE, dtype=np.float32)
        latent = self._histories.latent
        if self._way is None or self._kind == "latent":
            yaw = task.simulation.pose[2, :, np.newaxis]
            turned = (latent * np.cos(yaw), latent * np.sin(yaw), latent)
            return np.concatenate((task.observation() / OBSERVATION_SCALE, *turned), axis=1).astype(np.float32)
        middle, scale = (self._weights[f"observation_{name}"] for name in ("middle", "scale"))
        scaled: FloatArray = (policy_seen(task, latent, self._way.turn) - middle) / scale
        return scaled.clip(-_LARGEST, _LARGEST).astype(np.float32)

    def reset(self, which: NDArray[np.intp]) -> None:
        """The robots of those indices have been put elsewhere."""
        if self._histories is not None:
            self._histories.reset(which)
