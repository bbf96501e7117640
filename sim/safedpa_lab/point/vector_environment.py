"""Many point robots as one vectorised environment of stable-baselines3, with the cost next to the reward."""

from __future__ import annotations

from collections import deque
from typing import Any, final

import gymnasium
import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import Float32Array
from safedpa_lab.point.inputs import Inputs, WayAhead, entries_of
from safedpa_lab.point.shield import LearningShield, true_shelter
from safedpa_sim.point.task import EPISODE_STEPS, PointTask, StepResult
from safedpa_sim.training.environments.vector_environment import SharedVecEnv

_RETAINED = 200
"""Episodes over which their means are reported."""


@final
class PointEnvironment(SharedVecEnv):
    """Every robot is one environment. Reward: (gained - weight cost) / (1 + weight), weight 0 unless it is set.

    ``inputs`` of ``INPUTS``: what is observed. With the lidar alone the benchmark's reward is gained; else what comes
    nearer along the shortest way, as SafeDPA's own policy learned. While ``filtered`` the filter with the simulated
    physics itself decides. The cost of the last step of every robot stands in ``cost``, of all since ``begin`` in
    ``paid``; the benchmark's returns and costs of the episodes that ended last in ``returns`` and ``costs``. Episodes
    begin at different steps, so that they do not all end at once.
    """

    def __init__(
        self, task: PointTask, seed: int = 0, inputs: str = "lidar", shelter: LearningShield | None = None
    ) -> None:
        self.task = task
        self.weight = 0.0
        self.filtered = False
        self.cost = np.zeros(task.count)
        self.returns: deque[float] = deque(maxlen=_RETAINED)
        self.costs: deque[float] = deque(maxlen=_RETAINED)
        self._gained, self._paid = np.zeros(task.count), np.zeros(task.count)
        task.steps[:] = np.random.default_rng(seed).integers(0, EPISODE_STEPS, task.count)
        self._whole = np.zeros(task.count, bool)
        """Whether the episode was seen from its beginning."""
        self._chosen: Float32Array = np.zeros((task.count, 2), np.float32)
        self._way = None if inputs == "lidar" else WayAhead(task)
        self._inputs = Inputs(inputs, task, way=self._way)
        self._shelter = true_shelter(task) if shelter is None else shelter
        self.last: StepResult
        self.begin()
        seen = gymnasium.spaces.Box(-np.inf, np.inf, (entries_of(inputs),), np.float32)
        super().__init__(task.count, seen, gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32))

    def begin(self) -> None:
        """From here on ``paid`` is counted."""
        self.paid, self.stepped = 0.0, 0

    @property
    def episode_cost(self) -> float:
        """Mean cost of 1000 steps since ``begin``: what an episode costs of the policy as it is now."""
        return EPISODE_STEPS * self.paid / max(self.stepped, 1)

    def reset(self) -> Float32Array:
        """The observations of all robots (robots, entries)."""
        return self._inputs.see()

    def step_async(self, actions: Float32Array) -> None:
        """Takes the actions (robots, 2)."""
        self._chosen = actions

    def step_wait(self) -> tuple[Float32Array, Float32Array, NDArray[np.bool_], list[dict[str, Any]]]:
        """Observations, rewards, which episodes ended, and notes on those that did."""
        stepped = self.task.advance(self._shelter.safe(self._chosen) if self.filtered else self._chosen)
        self.last, self.cost = stepped, stepped.cost
        self._gained += stepped.reward
        self._paid += stepped.cost
        self.paid, self.stepped = self.paid + float(stepped.cost.sum()), self.stepped + self.num_envs
        gained = stepped.reward if self._way is None else self._way.gained(stepped.reached)
        reward = (gained - self.weight * stepped.cost) / (1.0 + self.weight)
        infos: list[dict[str, Any]] = [{}] * self.num_envs
        which = np.flatnonzero(stepped.timed_out)
        if len(which):
            observation = self._inputs.look()
            for index in which:
                infos[index] = {"terminal_observation": observation[index], "TimeLimit.truncated": True}
            self._close(which)
            self._shelter.restart(which)
            self._inputs.reset(which)
            if self._way is not None:
                self._way.renew()
        return self._inputs.see(), reward.astype(np.float32), stepped.timed_out, infos

    def _close(self, which: NDArray[np.intp]) -> None:
        whole = which[self._whole[which]]
        self.returns.extend(self._gained[whole].tolist())
        self.costs.extend(self._paid[whole].tolist())
        self._gained[which] = self._paid[which] = 0.0
        self._whole[which] = True
