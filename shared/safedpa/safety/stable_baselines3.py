"""The filter around a vector environment of stable-baselines3, and a replay buffer of applied actions.

An on-policy learner stores the nominal action with the reward that the applied one earned, which trains it to rely on
the filter; ``penalty`` counters that. An off-policy learner may store the applied action instead:

    SAC("MlpPolicy", GymnasiumSafetyFilter(venv, safe), replay_buffer_class=AppliedActionReplayBuffer)

Needs the extra ``train``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any, final

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv, VecEnvWrapper

from safedpa.errors import InputError
from safedpa.safety.barriers.base import AbstractBarrier
from safedpa.safety.environment_chain import ActionFilter
from safedpa.safety.filter import SafetyFilter

__all__ = ["AppliedActionReplayBuffer", "VecSafetyFilter"]


@final
class VecSafetyFilter(VecEnvWrapper):
    """``GymnasiumSafetyFilter`` around a VecEnv: each of ``infos`` has ``verdict`` and ``applied_action``.

    Raises InputError as that does, and for a SubprocVecEnv, whose environments cannot be inspected: wrap each of them
    instead (``make_vec_env(..., wrapper_class=GymnasiumSafetyFilter, wrapper_kwargs={"safety_filter": safe})``).
    """

    def __init__(
        self,
        venv: VecEnv,
        safety_filter: SafetyFilter,
        state_of: Callable[[Any], Any] | None = None,
        barriers_of: Callable[[Any], Sequence[AbstractBarrier]] | None = None,
        latent_of: Callable[[Any], Any] | None = None,
        *,
        penalty: float = 0.0,
        accounted_for: Sequence[type] = (),
    ) -> None:
        super().__init__(venv)
        if isinstance(venv.unwrapped, SubprocVecEnv):
            raise InputError(
                "SubprocVecEnv: got environments in other processes, which cannot be inspected; wrap each of them: "
                "make_vec_env(..., wrapper_class=GymnasiumSafetyFilter, wrapper_kwargs={'safety_filter': ...})"
            )
        self._action_filter = ActionFilter(
            venv, safety_filter, (state_of, barriers_of, latent_of), penalty, accounted_for
        )
        self._observations: Any = None
        self._decided: list[tuple[Any, Any]] = []

    def reset(self) -> Any:
        """Resets the environments and stores their observations."""
        observations = self.venv.reset()
        self._observations = deepcopy(observations)  # a policy may write into the array that it gets
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """Filters ``actions`` (environments, actions) at the last observations and starts the step."""
        # Filtered here and not in step_wait, because the environments start to move in this call.
        seen = [_of_one(self._observations, index) for index in range(self.num_envs)]
        self._decided = [self._action_filter(one, action) for one, action in zip(seen, actions, strict=True)]
        self.venv.step_async(np.stack([applied for _, applied in self._decided]))

    def step_wait(self) -> Any:
        """Ends the step: observations, rewards, dones, infos."""
        observations, rewards, dones, infos = self.venv.step_wait()
        self._observations = deepcopy(observations)
        for info, (verdict, applied) in zip(infos, self._decided, strict=True):
            info["verdict"], info["applied_action"] = verdict, applied
        penalties = [self._action_filter.penalty(verdict) for verdict, _ in self._decided]
        return observations, rewards - np.array(penalties, dtype=rewards.dtype), dones, infos


class AppliedActionReplayBuffer(ReplayBuffer):
    """A replay buffer that stores ``info["applied_action"]`` in place of the learner's own action."""

    def add(self, obs: Any, next_obs: Any, action: Any, reward: Any, done: Any, infos: list[dict[str, Any]]) -> None:
        """Stores one step of all environments; the applied actions scaled to -1 to 1, as SB3 stores actions.

        Raises InputError if an environment has no filter.
        """
        if any("applied_action" not in info for info in infos):
            raise InputError("infos: got no applied_action, wanted environments inside GymnasiumSafetyFilter")
        # Reward and next observation are results of the applied action; stored with another one they would mislead.
        applied = np.stack([info["applied_action"] for info in infos])
        low, high = self.action_space.low, self.action_space.high
        super().add(obs, next_obs, 2.0 * (applied - low) / (high - low) - 1.0, reward, done, infos)


def _of_one(observations: Any, index: int) -> Any:
    """One environment's observation; None before the first reset."""
    # A Dict space has one array per key, each with the environments first.
    if isinstance(observations, dict):
        return {name: values[index] for name, values in observations.items()}
    return None if observations is None else observations[index]
