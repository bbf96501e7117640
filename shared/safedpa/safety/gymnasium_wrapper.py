"""The filter around any gymnasium environment with a continuous action. Needs the extra ``gym``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, final

import gymnasium
import numpy as np
from numpy.typing import NDArray

from safedpa.errors import InputError
from safedpa.safety.barrier import AbstractBarrier
from safedpa.safety.safety_filter import SafetyFilter

__all__ = ["GymnasiumSafetyFilter"]

Values = NDArray[np.float64]


@final
class GymnasiumSafetyFilter(gymnasium.Wrapper):  # type: ignore[misc] # gymnasium is optional and not type-checked here
    """Hands the policy's action through ``safety_filter.decide`` before the environment sees it.

    ``state_of(observation)`` gives the state (states,) that model and barriers speak of (default: the observation
    itself), ``barriers_of(observation)`` this step's barriers (default: the filter's own), ``latent_of`` the latent.
    ``info["verdict"]`` is the Verdict. Raises InputError unless the action space is a Box with one axis and as many
    entries as the filter's actions.
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
        wanted = (len(safety_filter.settings.action_low),)
        if not isinstance(env.action_space, gymnasium.spaces.Box) or env.action_space.shape != wanted:
            raise InputError(f"action space: got {env.action_space}, wanted a Box of shape {wanted}, as the settings")
        self.safety_filter = safety_filter
        self._state_of, self._barriers_of, self._latent_of = state_of, barriers_of, latent_of
        self._observation: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """As the environment's; remembers the observation."""
        self._observation, info = self.env.reset(seed=seed, options=options)
        return self._observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Filters ``action`` at the last observation, then steps the environment with the verdict's action."""
        seen = self._observation
        verdict = self.safety_filter.decide(
            seen if self._state_of is None else self._state_of(seen),
            action,
            None if self._latent_of is None else self._latent_of(seen),
            barriers=None if self._barriers_of is None else self._barriers_of(seen),
        )
        taken = verdict.action.astype(self.env.action_space.dtype)
        self._observation, reward, terminated, truncated, info = self.env.step(taken)
        return self._observation, reward, bool(terminated), bool(truncated), {**info, "verdict": verdict}
