"""The filter as a wrapper of any gymnasium environment with a continuous action. Needs the extra ``gym``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any, final

import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv, VectorWrapper
from gymnasium.vector.utils import iterate

from safedpa.errors import InputError
from safedpa.safety.barriers.base import AbstractBarrier
from safedpa.safety.environment_chain import ActionFilter
from safedpa.safety.filter import SafetyFilter

__all__ = ["GymnasiumSafetyFilter", "GymnasiumVectorSafetyFilter"]


@final
class GymnasiumSafetyFilter(gymnasium.Wrapper):  # type: ignore[misc] # gymnasium is optional and not type-checked here
    """Passes the policy's action through ``safety_filter.decide`` before the environment gets it.

    ``state_of(observation)`` returns the state (states,) of model and barriers (default: the observation itself),
    ``barriers_of(observation)`` this step's barriers (default: the filter's own), and ``latent_of`` the latent.
    ``info["verdict"]`` is the Verdict, and ``info["applied_action"]`` (actions,) what the environment got: a learner
    that stores its own action has the nominal one. ``penalty`` lowers the reward by

        penalty * sum_j ((applied_j - nominal_j) / (action_high_j - action_low_j))^2.

    Around a vector environment it becomes a ``GymnasiumVectorSafetyFilter``, around one of stable-baselines3 a
    ``VecSafetyFilter`` (``safedpa.safety.stable_baselines3``).

    Raises InputError unless the action space is a Box of floats (32 or 64 bits) with one axis, as many entries as the
    filter's actions, and the settings' bounds within its own: otherwise the environment would change the filter's
    action. A wider Box is accepted: an action beyond the settings' bounds is clipped to them, and the verdict says so.
    An observation that is itself the state must be a Box with one axis. A wrapper below the filter that changes actions
    or observations (``RescaleAction``, ``StickyAction``, ``DelayObservation``) is refused too: place it above the
    filter, or name its class in ``accounted_for`` if the model and ``state_of`` account for it.
    """

    def __new__(cls, env: Any = None, *given: Any, **named: Any) -> Any:
        """The wrapper that fits the environment, one or many; a copy is made without an environment."""
        # The wrappers of each library differ by class, so the one name chooses the right one.
        if isinstance(env, VectorEnv):
            return GymnasiumVectorSafetyFilter(env, *given, **named)
        if any(base.__module__ == "stable_baselines3.common.vec_env.base_vec_env" for base in type(env).__mro__):
            from safedpa.safety.stable_baselines3 import VecSafetyFilter

            return VecSafetyFilter(env, *given, **named)
        return super().__new__(cls)

    def __init__(
        self,
        env: Any,
        safety_filter: SafetyFilter,
        state_of: Callable[[Any], Any] | None = None,
        barriers_of: Callable[[Any], Sequence[AbstractBarrier]] | None = None,
        latent_of: Callable[[Any], Any] | None = None,
        *,
        penalty: float = 0.0,
        accounted_for: Sequence[type] = (),
    ) -> None:
        super().__init__(env)
        self.safety_filter = safety_filter
        self._action_filter = ActionFilter(
            env, safety_filter, (state_of, barriers_of, latent_of), penalty, accounted_for
        )
        self._observation: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Resets the environment and stores its observation."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._observation = deepcopy(observation)  # a policy may write into the array that it gets
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Filters ``action`` at the last observation, then steps the environment with the verdict's action."""
        verdict, applied = self._action_filter(self._observation, action)
        observation, reward, terminated, truncated, info = self.env.step(applied)
        self._observation = deepcopy(observation)
        reported = {"verdict": verdict, "applied_action": applied}
        reward = reward - self._action_filter.penalty(verdict)
        return observation, reward, bool(terminated), bool(truncated), {**info, **reported}


@final
class GymnasiumVectorSafetyFilter(VectorWrapper):  # type: ignore[misc] # as above
    """The filter around a vector environment: ``infos`` has one verdict and one applied action for each environment.

    One filter decides for one environment after the other; the functions get one environment's observation. An
    environment that resets itself in the next step, as gymnasium's do, ignores that step's action, and its verdict has
    no meaning.
    """

    def __init__(
        self,
        env: Any,
        safety_filter: SafetyFilter,
        state_of: Callable[[Any], Any] | None = None,
        barriers_of: Callable[[Any], Sequence[AbstractBarrier]] | None = None,
        latent_of: Callable[[Any], Any] | None = None,
        *,
        penalty: float = 0.0,
        accounted_for: Sequence[type] = (),
    ) -> None:
        super().__init__(env)
        self.safety_filter = safety_filter
        self._action_filter = ActionFilter(
            env, safety_filter, (state_of, barriers_of, latent_of), penalty, accounted_for
        )
        self._observations: Any = None

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Resets the environments and stores their observations."""
        observations, infos = self.env.reset(seed=seed, options=options)
        self._observations = deepcopy(observations)  # as above
        return observations, infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Filters ``actions`` (environments, actions), then steps with the verdicts' actions.

        Raises InputError if the numbers of actions and environments differ.
        """
        count = self.num_envs
        try:
            # A scalar action has no length: the message should name the number that was wanted.
            given = len(actions)
        except TypeError as error:
            raise InputError(f"actions: got {actions!r}, wanted {count}, one for each environment") from error
        if given != count:
            raise InputError(f"actions: got {given}, wanted {count}, one for each environment")
        # Before the first reset there is no observation; the filter then falls back to its backup action.
        seen = [None] * count if self._observations is None else iterate(self.observation_space, self._observations)
        verdicts = np.empty(count, dtype=object)
        taken = []
        for index, (observation, action) in enumerate(zip(seen, actions, strict=True)):
            verdicts[index], applied = self._action_filter(observation, action)
            taken.append(applied)
        observations, rewards, terminated, truncated, infos = self.env.step(np.stack(taken))
        self._observations = deepcopy(observations)
        rewards = rewards - np.array([self._action_filter.penalty(verdict) for verdict in verdicts])
        every = np.ones(count, dtype=np.bool_)
        reported = {"verdict": verdicts, "_verdict": every, "applied_action": np.stack(taken), "_applied_action": every}
        return observations, rewards, terminated, truncated, {**infos, **reported}
