"""Inspection of the wrappers below the filter: a wrapper that changes actions or observations makes verdicts false.

The filter predicts with the action that it returns, at the state that it reads from the observation. A wrapper between
filter and environment that rescales, repeats or delays either of them is refused, unless the caller declares that model
and ``state_of`` account for it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from math import isfinite
from typing import Any, Final, final

import gymnasium
import numpy as np
from gymnasium.vector import AsyncVectorEnv, VectorEnv, VectorWrapper

from safedpa.errors import InputError
from safedpa.safety.filter import SafetyFilter
from safedpa.safety.settings import FilterSettings
from safedpa.safety.verdict import Verdict

__all__ = ["ActionFilter", "Reader"]

Reader = Callable[[Any], Any] | None

_LIBRARIES: Final = ("gymnasium", "stable_baselines3")
_TRANSPARENT: Final = frozenset(
    (
        *("Autoreset", "ClipReward", "DictInfoToList", "HumanRendering", "Monitor", "NormalizeReward"),
        *("OrderEnforcing", "PassiveEnvChecker", "RecordEpisodeStatistics", "RecordVideo", "RenderCollection"),
        *("TimeLimit", "TransformReward", "VectorizeTransformReward", "VecCheckNan", "VecMonitor", "VecVideoRecorder"),
    )
)
"""Wrappers of these libraries that pass actions and observations on unchanged."""
_WITHIN_BOUNDS: Final = frozenset(("ClipAction",))
"""Wrappers that change no action within the bounds of the environment, which are compared with the settings."""
_READABLE: Final = frozenset(
    (
        *("AddRenderObservation", "DtypeObservation", "FilterObservation", "FlattenObservation"),
        *("FrameStackObservation", "NormalizeObservation", "RescaleObservation", "ReshapeObservation"),
        *("TimeAwareObservation", "TransformObservation", "VectorizeTransformObservation"),
        *("VecFrameStack", "VecNormalize"),
    )
)
"""Wrappers whose observation still has the present state in it, for ``state_of`` to read."""
_CHANGING: Final = ("step", "step_wait", "step_async", "action", "actions", "observation", "observations")
"""Methods by which a wrapper of the user's own changes actions or observations."""


def _environment_spaces(env: Any, has_state_of: bool, accounted_for: Sequence[type]) -> list[Any]:
    """The action spaces that the filter's action reaches unchanged: that of ``env``, and of what it wraps.

    Raises InputError naming the first wrapper that changes actions or observations and is not ``accounted_for``.
    """
    spaces = []
    accepted = tuple(accounted_for)
    for layer in _layers(env, accepted):
        spaces.append(getattr(layer, "single_action_space", layer.action_space))
        if _is_wrapper(layer) and not isinstance(layer, accepted):
            _check_wrapper(layer, has_state_of)
    return spaces


def _layers(env: Any, accepted: tuple[type, ...]) -> Iterator[Any]:
    """``env`` and everything that it wraps, the outermost first; of a vector environment every part.

    What a wrapper of the ``accepted`` classes wraps is left out: actions may have another unit there, and the user
    stated that the model accounts for it. The other parts of a vector environment are still inspected.
    """
    yield env
    if isinstance(env, accepted):
        return
    if isinstance(env, (gymnasium.Wrapper, VectorWrapper)):
        yield from _layers(env.env, accepted)
    elif _is_wrapper(env):
        yield from _layers(env.venv, accepted)
    elif isinstance(env, AsyncVectorEnv):
        # Its environments live in other processes, so a copy of each is constructed here, inspected and closed.
        for part in (make() for make in env.env_fns):
            yield from _layers(part, accepted)
            part.close()
    else:
        for part in getattr(env, "envs", ()):
            yield from _layers(part, accepted)


def _is_wrapper(layer: Any) -> bool:
    return isinstance(layer, (gymnasium.Wrapper, VectorWrapper)) or (
        # stable-baselines3's vector environments are no gymnasium classes.
        not isinstance(layer, (gymnasium.Env, VectorEnv)) and hasattr(layer, "venv")
    )


def _check_wrapper(layer: Any, has_state_of: bool) -> None:
    kind = type(layer)
    known = kind.__name__ if kind.__module__.split(".")[0] in _LIBRARIES else ""
    if known in _TRANSPARENT or known in _WITHIN_BOUNDS:
        return
    if known in _READABLE or (isinstance(layer, gymnasium.ObservationWrapper) and not known):
        if has_state_of:
            return
        remedy = "give state_of, which reads the state from the observation, or place it above the filter"
    elif not known and not _changes_anything(kind):
        return
    else:
        remedy = (
            "place it above the filter (the filter wraps the environment itself), or name its class in accounted_for "
            "if model and state_of account for it"
        )
    raise InputError(f"{kind.__name__} below the filter: it may change actions or observations; {remedy}")


def _changes_anything(kind: type) -> bool:
    """Whether a wrapper class of the user's own defines one of the methods that change actions or observations."""
    own = (base for base in kind.__mro__ if base.__module__.split(".")[0] not in (*_LIBRARIES, "builtins", "typing"))
    return any(name in vars(base) for base in own for name in _CHANGING)


@final
class ActionFilter:
    """Turns an observation and a nominal action into a verdict and the action for the environment.

    ``read`` has ``state_of``, ``barriers_of`` and ``latent_of``. Raises InputError as ``GymnasiumSafetyFilter`` does.
    """

    def __init__(
        self,
        env: Any,
        safety_filter: SafetyFilter,
        read: tuple[Reader, Reader, Reader],
        penalty: float,
        accounted_for: Sequence[type],
    ) -> None:
        if not isinstance(safety_filter, SafetyFilter):
            raise InputError(f"safety_filter: got {type(safety_filter).__name__}, wanted a SafetyFilter")
        if not (penalty >= 0.0 and isfinite(penalty)):
            raise InputError(f"penalty: got {penalty!r}, wanted a finite number >= 0")
        settings = safety_filter.settings
        self._filter, (self._state_of, self._barriers_of, self._latent_of) = safety_filter, read
        spaces = _environment_spaces(env, self._state_of is not None, accounted_for)
        for space in spaces:
            _check_actions(space, settings)
        if self._state_of is None:
            _check_observations(getattr(env, "single_observation_space", env.observation_space), safety_filter)
        self._type, self._low, self._high, self._penalty = spaces[0].dtype, settings.low, settings.high, penalty

    def __call__(self, observation: Any, action: Any) -> tuple[Verdict, Any]:
        """The verdict at ``observation``, and its action (actions,) in the precision of the environment."""
        verdict = self._filter.decide(
            observation if self._state_of is None else self._state_of(observation),
            action,
            None if self._latent_of is None else self._latent_of(observation),
            barriers=None if self._barriers_of is None else self._barriers_of(observation),
        )
        return verdict, self._rounded(verdict.action)

    def penalty(self, verdict: Verdict) -> float:
        """By how much the reward falls; an action of NaN or text counts as one range away in each entry."""
        if self._penalty == 0.0:
            return 0.0
        if verdict.nominal is None:
            return self._penalty * len(self._low)
        share = (verdict.action - verdict.nominal) / (self._high - self._low)
        return self._penalty * float(share @ share)

    def _rounded(self, action: Any) -> Any:
        # Rounding to 32 bits may lead beyond a bound: one float back, or the environment would clip the action.
        taken = action.astype(self._type)
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
