"""Robots that practise as a vectorised environment of stable-baselines3."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, final

import gymnasium
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from safedpa_sim.training.practice import Practice

__all__ = ["PracticeEnvironment"]


@final
class PracticeEnvironment(VecEnv):
    """Every robot is one environment; observations are (observation - middle) / scale, actions lie in [-1, 1].

    An episode that ends begins again at once, as the interface asks; ``terminal_observation`` holds what was seen last.
    """

    def __init__(self, practice: Practice, middle: NDArray[np.float32], scale: NDArray[np.float32]) -> None:
        self.practice = practice
        self._middle, self._scale = middle, scale
        self._chosen = np.zeros_like(practice.exploring(np.random.default_rng(0)))
        self.reached = self.ended = self.contacts = 0
        """Counts since they were last set to 0."""
        seen = gymnasium.spaces.Box(-np.inf, np.inf, middle.shape, np.float32)
        super().__init__(practice.count, seen, gymnasium.spaces.Box(-1.0, 1.0, self._chosen.shape[1:], np.float32))

    def reset(self) -> NDArray[np.float32]:
        """The observations of all robots (robots, observations)."""
        return self.scaled_observation()

    def step_async(self, actions: NDArray[np.float32]) -> None:
        """Takes the actions (robots, actions)."""
        self._chosen = actions

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Observations, rewards, which episodes ended, and notes on those that did."""
        moved = self.practice.advance(self._chosen)
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
            self.practice.restart(which)
            observation[which] = self.scaled_observation(which)
        self.reached += int(moved.reached.sum())
        self.ended += len(which)
        self.contacts += int(moved.began.sum())
        return observation, moved.reward, ended, infos

    def scaled_observation(self, which: NDArray[np.intp] | slice = slice(None)) -> NDArray[np.float32]:
        """What the robots of those indices see now, all of them without."""
        return (self.practice.observation(which) - self._middle) / self._scale

    def close(self) -> None:
        """Nothing is open."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The same attribute for every environment: they share one object."""
        return [getattr(self, attr_name, None)] * len(self._indices(indices))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Sets the attribute of the one object that they share."""
        del indices
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *arguments: Any, indices: Any = None, **named: Any) -> list[Any]:
        """Calls a method of the one object that they share."""
        return [getattr(self, method_name)(*arguments, **named)] * len(self._indices(indices))

    def env_is_wrapped(
        self, wrapper_class: type[gymnasium.Wrapper[Any, Any, Any, Any]], indices: Any = None
    ) -> list[bool]:
        """No environment is wrapped."""
        del wrapper_class
        return [False] * len(self._indices(indices))

    def _indices(self, indices: Any) -> Sequence[int]:
        return list(self._get_indices(indices))
