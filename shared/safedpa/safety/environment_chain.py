"""Inspection of the wrappers below the filter: a wrapper that changes actions or observations makes verdicts false.

The filter predicts with the action that it returns, at the state that it reads from the observation. A wrapper between
filter and environment that rescales, repeats or delays either of them is refused, unless the caller declares that model
and ``state_of`` account for it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final

import gymnasium
from gymnasium.vector import AsyncVectorEnv, VectorEnv, VectorWrapper

from safedpa.errors import InputError

__all__ = ["environment_spaces"]

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


def environment_spaces(env: Any, has_state_of: bool, accounted_for: Sequence[type]) -> list[Any]:
    """The action spaces that the filter's action reaches unchanged: that of ``env``, and of what it wraps.

    Raises InputError naming the first wrapper that changes actions or observations and is not ``accounted_for``.
    """
    spaces = []
    for layer in _layers(env):
        spaces.append(getattr(layer, "single_action_space", layer.action_space))
        if not _is_wrapper(layer):
            continue
        if isinstance(layer, tuple(accounted_for)):
            # Beyond it actions may have another unit, and the caller answers for what they become.
            break
        _check_wrapper(layer, has_state_of)
    return spaces


def _layers(env: Any) -> Iterator[Any]:
    """``env`` and everything that it wraps, the outermost first; of a vector environment every part."""
    yield env
    if isinstance(env, (gymnasium.Wrapper, VectorWrapper)):
        yield from _layers(env.env)
    elif _is_wrapper(env):
        yield from _layers(env.venv)
    elif isinstance(env, AsyncVectorEnv):
        # Its environments live in other processes: one of the same kind is made, looked at and closed.
        for part in (make() for make in env.env_fns):
            yield from _layers(part)
            part.close()
    else:
        for part in getattr(env, "envs", ()):
            yield from _layers(part)


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
