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
from safedpa.safety.filter import SafetyFilter
from safedpa.safety.settings import FilterSettings
from safedpa.safety.verdict import Verdict

__all__ = ["GymnasiumSafetyFilter", "GymnasiumVectorSafetyFilter"]

_Reader = Callable[[Any], Any] | None


@final
class GymnasiumSafetyFilter(gymnasium.Wrapper):  # type: ignore[misc] # gymnasium is optional and not type-checked here
    """Passes the policy's action through ``safety_filter.decide`` before the environment gets it.

    ``state_of(observation)`` returns the state (states,) of model and barriers (default: the observation itself),
    ``barriers_of(observation)`` this step's barriers (default: the filter's own), and ``latent_of`` the latent.
    ``info["verdict"]`` is the Verdict. Around a vector environment it becomes a ``GymnasiumVectorSafetyFilter``.

    Raises InputError unless the action space is a Box of floats (32 or 64 bits) with one axis, as many entries as the
    filter's actions, and the settings' bounds within its own: otherwise the environment would change the filter's
    action. A wider Box is accepted: an action beyond the settings' bounds is clipped to them, and the verdict says so.
    An observation that is itself the state must be a Box with one axis.
    """

    def __new__(cls, env: Any = None, *given: Any, **named: Any) -> Any:
        """The wrapper that fits the environment, one or many; a copy is made without an environment."""
        # gymnasium's wrappers differ by class, so the one name chooses the right one.
        if isinstance(env, VectorEnv):
            return GymnasiumVectorSafetyFilter(env, *given, **named)
        return super().__new__(cls)

    def __init__(
        self,
        env: Any,
        safety_filter: SafetyFilter,
        state_of: Callable[[Any], Any] | None = None,
        barriers_of: Callable[[Any], Sequence[AbstractBarrier]] | None = None,
        latent_of: Callable[[Any], Any] | None = None,
    ) -> None:
        super().__init__(env)
        self.safety_filter = safety_filter
        self._action_filter = _ActionFilter(
            safety_filter, (state_of, barriers_of, latent_of), env.action_space, env.observation_space
        )
        self._observation: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Resets the environment and stores its observation."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._observation = deepcopy(observation)  # a policy may write into the array that it gets
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Filters ``action`` at the last observation, then steps the environment with the verdict's action."""
        verdict = self._action_filter.verdict(self._observation, action)
        taken = self._action_filter.action(verdict)
        observation, reward, terminated, truncated, info = self.env.step(taken)
        self._observation = deepcopy(observation)
        return observation, reward, bool(terminated), bool(truncated), {**info, "verdict": verdict}


@final
class GymnasiumVectorSafetyFilter(VectorWrapper):  # type: ignore[misc] # as above
    """The filter around a vector environment: ``infos["verdict"]`` has one verdict for each environment.

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
    ) -> None:
        super().__init__(env)
        self.safety_filter = safety_filter
        self._action_filter = _ActionFilter(
            safety_filter, (state_of, barriers_of, latent_of), env.single_action_space, env.single_observation_space
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
        for index, (observation, action) in enumerate(zip(seen, actions, strict=True)):
            verdicts[index] = self._action_filter.verdict(observation, action)
        taken = np.stack([self._action_filter.action(verdict) for verdict in verdicts])
        observations, rewards, terminated, truncated, infos = self.env.step(taken)
        self._observations = deepcopy(observations)
        reported = {"verdict": verdicts, "_verdict": np.ones(count, dtype=np.bool_)}
        return observations, rewards, terminated, truncated, {**infos, **reported}


@final
class _ActionFilter:
    """Turns an observation and a nominal action into the action for the environment."""

    def __init__(
        self, safety_filter: SafetyFilter, read: tuple[_Reader, _Reader, _Reader], actions: Any, observations: Any
    ) -> None:
        if not isinstance(safety_filter, SafetyFilter):
            raise InputError(f"safety_filter: got {type(safety_filter).__name__}, wanted a SafetyFilter")
        settings = safety_filter.settings
        _check_actions(actions, settings)
        self._filter, (self._state_of, self._barriers_of, self._latent_of) = safety_filter, read
        if self._state_of is None:
            _check_observations(observations, safety_filter)
        self._type, self._low, self._high = actions.dtype, settings.low, settings.high

    def verdict(self, observation: Any, action: Any) -> Verdict:
        """The filter's verdict for the state, latent and barriers of an observation."""
        return self._filter.decide(
            observation if self._state_of is None else self._state_of(observation),
            action,
            None if self._latent_of is None else self._latent_of(observation),
            barriers=None if self._barriers_of is None else self._barriers_of(observation),
        )

    def action(self, verdict: Verdict) -> Any:
        """The verdict's action (actions,) in the environment's precision, rounded towards the inside of the bounds."""
        # Rounding to 32 bits may lead beyond a bound: one float back, or the environment would clip the action.
        taken = verdict.action.astype(self._type)
        taken = np.where(taken > self._high, np.nextafter(taken, self._type.type(-np.inf)), taken)
        return np.where(taken < self._low, np.nextafter(taken, self._type.type(np.inf)), taken)


def _check_actions(space: Any, settings: FilterSettings) -> None:
    wanted = f"wanted a Box of floats of shape ({len(settings.action_low)},), as the settings"
    if not isinstance(space, gymnasium.spaces.Box) or space.shape != (len(settings.action_low),):
        raise InputError(f"action space: got {space}, {wanted}")
    # Integers or 16 bits would round the action by more than the last bit, beyond what the verdict promises.
    if space.dtype not in (np.float32, np.float64):
        raise InputError(
            f"action space: got {space}, {wanted} in 32 or 64 bits: others would round the filter's action"
        )
    low, high = settings.low.astype(space.dtype), settings.high.astype(space.dtype)
    if (low < space.low).any() or (high > space.high).any():
        raise InputError(
            f"action space: got {space}, wanted one that holds the settings' bounds {settings.low.tolist()} to "
            f"{settings.high.tolist()}: the environment would not get the filter's action; narrow the settings' "
            "bounds, or bring the action space to the settings' unit"
        )


def _check_observations(space: Any, safety_filter: SafetyFilter) -> None:
    given_range = safety_filter.tools.state_range
    count = None if given_range is None else len(given_range.names)
    if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1 or count not in (None, space.shape[0]):
        wanted = "one axis" if count is None else f"shape ({count},), as the model's state"
        raise InputError(f"observation space: got {space}, wanted a Box of {wanted}; give state_of")
