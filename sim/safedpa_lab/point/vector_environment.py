"""Many point robots as one vectorised environment of stable-baselines3, with the cost beside the reward."""

from __future__ import annotations

from collections import deque
from typing import Any, Final, final

import gymnasium
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from safedpa_sim.point.task import EPISODE_STEPS, PointTask

__all__ = ["OBSERVATION_SCALE", "PointEnvironment"]

Floats = NDArray[np.float32]

OBSERVATION_SCALE: Final = np.array(
    [2.0, 2.0, 10.0, 1.0, 1.0, 1.0, 1.0, 1.0, 3.0, 0.5, 0.5, 0.5, 1.0, 1.0, 1.5] + [1.0] * 16
)
"""What counts as 1 in each entry of the observation: m/s2, m/s, rad/s, magnetic field, m."""
_KEPT = 200
"""Episodes over which their means are told."""


@final
class PointEnvironment(VecEnv):
    """Every robot is one environment. Reward: (reward - weight cost) / (1 + weight), weight 0 unless it is set.

    The cost of the last step of every robot stands in ``cost``; returns and costs of the episodes that ended last in
    ``returns`` and ``costs``. Episodes begin at different steps, so that they do not all end at once.
    """

    def __init__(self, task: PointTask, seed: int = 0) -> None:
        self.task = task
        self.weight = 0.0
        self.cost = np.zeros(task.count)
        self.returns: deque[float] = deque(maxlen=_KEPT)
        self.costs: deque[float] = deque(maxlen=_KEPT)
        self._gained, self._paid = np.zeros(task.count), np.zeros(task.count)
        task.steps[:] = np.random.default_rng(seed).integers(0, EPISODE_STEPS, task.count)
        self._whole = np.zeros(task.count, bool)
        """Whether the episode was seen from its beginning."""
        self._chosen: Floats = np.zeros((task.count, 2), np.float32)
        seen = gymnasium.spaces.Box(-np.inf, np.inf, OBSERVATION_SCALE.shape, np.float32)
        super().__init__(task.count, seen, gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32))

    def reset(self) -> Floats:
        """The observations of all robots (robots, 31)."""
        return self._seen()

    def step_async(self, actions: Floats) -> None:
        """Takes the actions (robots, 2)."""
        self._chosen = actions

    def step_wait(self) -> tuple[Floats, Floats, NDArray[np.bool_], list[dict[str, Any]]]:
        """Observations, rewards, which episodes ended, and notes on those that did."""
        stepped = self.task.advance(self._chosen)
        self.cost = stepped.cost
        self._gained += stepped.reward
        self._paid += stepped.cost
        infos: list[dict[str, Any]] = [{}] * self.num_envs
        observation = self._seen()
        which = np.flatnonzero(stepped.timed_out)
        if len(which):
            for index in which:
                infos[index] = {"terminal_observation": observation[index].copy(), "TimeLimit.truncated": True}
            self._close(which)
            self.task.restart(which)
            observation = self._seen()
        reward = (stepped.reward - self.weight * stepped.cost) / (1.0 + self.weight)
        return observation, reward.astype(np.float32), stepped.timed_out, infos

    def _close(self, which: NDArray[np.intp]) -> None:
        whole = which[self._whole[which]]
        self.returns.extend(self._gained[whole].tolist())
        self.costs.extend(self._paid[whole].tolist())
        self._gained[which] = self._paid[which] = 0.0
        self._whole[which] = True

    def _seen(self) -> Floats:
        seen: Floats = (self.task.observation() / OBSERVATION_SCALE).astype(np.float32)
        return seen

    def close(self) -> None:
        """Nothing is open."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The same attribute for every environment: they share one object."""
        return [getattr(self, attr_name, None)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Sets the attribute of the one object that they share."""
        del indices
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *arguments: Any, indices: Any = None, **named: Any) -> list[Any]:
        """Calls a method of the one object that they share."""
        return [getattr(self, method_name)(*arguments, **named)] * len(list(self._get_indices(indices)))

    def env_is_wrapped(
        self, wrapper_class: type[gymnasium.Wrapper[Any, Any, Any, Any]], indices: Any = None
    ) -> list[bool]:
        """No environment is wrapped."""
        del wrapper_class
        return [False] * len(list(self._get_indices(indices)))
