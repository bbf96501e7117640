"""Adapter from ``BatchedEnvironment`` to the vectorised environment of stable-baselines3."""

from __future__ import annotations

from typing import Any, final

import gymnasium
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from safedpa_sim.training.environments.policy_task import BatchedEnvironment


class SharedVecEnv(VecEnv):
    """A VecEnv whose environments are one object: each attribute and method is the same for all of them."""

    def close(self) -> None:
        """Does nothing: there are no resources to release."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Returns the attribute once for each environment."""
        return [getattr(self, attr_name, None)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Sets the attribute of the shared object."""
        del indices
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *arguments: Any, indices: Any = None, **named: Any) -> list[Any]:
        """Calls a method of the shared object and returns its result once for each environment."""
        return [getattr(self, method_name)(*arguments, **named)] * len(list(self._get_indices(indices)))

    def env_is_wrapped(
        self, wrapper_class: type[gymnasium.Wrapper[Any, Any, Any, Any]], indices: Any = None
    ) -> list[bool]:
        """Returns False for each environment: none is wrapped."""
        del wrapper_class
        return [False] * len(list(self._get_indices(indices)))


@final
class VectorEnvironment(SharedVecEnv):
    """A VecEnv with one environment per robot; observations are (observation - middle) / scale, actions in [-1, 1].

    When an episode ends, the next one starts at once, as the VecEnv interface requires; the last observation of the
    ended episode is in ``terminal_observation``.
    """

    def __init__(self, robots: BatchedEnvironment, middle: NDArray[np.float32], scale: NDArray[np.float32]) -> None:
        self.robots = robots
        self._middle, self._scale = middle, scale
        self._chosen = np.zeros_like(robots.exploring(np.random.default_rng(0)))
        self.reached = self.ended = self.contacts = 0
        """Counts since the last reset by the training."""
        seen = gymnasium.spaces.Box(-np.inf, np.inf, middle.shape, np.float32)
        super().__init__(robots.count, seen, gymnasium.spaces.Box(-1.0, 1.0, self._chosen.shape[1:], np.float32))

    def reset(self) -> NDArray[np.float32]:
        """Returns the observations of all robots (robots, observations)."""
        return self.scaled_observation()

    def step_async(self, actions: NDArray[np.float32]) -> None:
        """Stores the actions (robots, actions) for ``step_wait``."""
        self._chosen = actions

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Simulates one period; returns observations, rewards, which episodes ended, and infos about those."""
        moved = self.robots.advance(self._chosen)
        ended = moved.reached | moved.timed_out
        infos: list[dict[str, Any]] = [{}] * self.num_envs
        observation = self.scaled_observation()
        which = np.flatnonzero(ended)
        if len(which):
            for index in which:
                infos[index] = {
                    "terminal_observation": observation[index].copy(),
                    "TimeLimit.truncated": bool(moved.timed_out[index]),
                }
            self.robots.restart(which)
            observation[which] = self.scaled_observation(which)
        self.reached += int(moved.reached.sum())
        self.ended += len(which)
        self.contacts += int(moved.began.sum())
        return observation, moved.reward, ended, infos

    def scaled_observation(self, which: NDArray[np.intp] | slice = slice(None)) -> NDArray[np.float32]:
        """Returns the scaled observations of the robots with the given indices, by default of all."""
        return (self.robots.observation(which) - self._middle) / self._scale
