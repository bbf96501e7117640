"""The model as the filter asks for it: the next state, and its tangent in the action."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from safedpa.dynamics import AbstractDynamics

__all__ = ["Prediction"]

Values = NDArray[np.float64]


@final
class Prediction:
    """x[t+1] = step(x, a), or f + g a where there is no ``step``; and (f, g) = affine(x) about an action.

    ``affine`` takes (state), (state, latent) and, if it has them, the keywords ``around`` (the action about which to
    linearise) and ``memory``; it returns f (states,) and g (states, actions). ``step`` takes (state, action), (state,
    action, latent) and, if it has it, ``memory``.
    """

    def __init__(self, affine: Callable[..., Any], step: Callable[..., Any] | None = None) -> None:
        self._affine, self._affine_count, self._affine_words = affine, *_accepted(affine, 2)
        self._step = step
        self._step_count, self._step_words = _accepted(step, 3) if step is not None else (0, frozenset())
        self._model: AbstractDynamics | None = None

    @classmethod
    def of_model(cls, model: AbstractDynamics) -> Prediction:
        """The prediction of a model of this project, with what its actuators remember."""
        prediction = cls(model.affine)
        prediction._model = model
        return prediction

    def next_state(self, state: Values, action: Values, latent: Values | None, memory: Any) -> Values:
        """x[t+1] (states,) under ``action`` (actions,)."""
        model = self._model
        if model is not None:
            remembered = model.initial_memory(action) if memory is None else memory
            return np.asarray(model.advance(state, action, remembered, latent)[0])
        if self._step is None:
            f, g = self._tangent(state, action, latent, memory)
            return np.asarray(f + g @ action)
        words = {"memory": memory} if "memory" in self._step_words else {}
        return np.asarray(self._step(*(state, action, latent)[: self._step_count], **words), dtype=np.float64)

    def slopes(self, state: Values, around: Values, latent: Values | None, memory: Any) -> Values:
        """g (states, actions), exact at the action ``around`` (actions,) where ``affine`` accepts it."""
        if self._model is not None:
            return np.asarray(self._model.slopes(state, latent, around, memory))
        return self._tangent(state, around, latent, memory)[1]

    def _tangent(self, state: Values, around: Values, latent: Values | None, memory: Any) -> tuple[Values, Values]:
        offered = {"around": around, "memory": memory}
        words = {word: offered[word] for word in self._affine_words}
        f, g = self._affine(*(state, latent)[: self._affine_count], **words)
        return np.asarray(f, dtype=np.float64), np.asarray(g, dtype=np.float64)


def _accepted(function: Callable[..., Any], most: int) -> tuple[int, frozenset[str]]:
    """How many positional arguments (at most ``most``) and which of the filter's keywords a function takes."""
    parameters = inspect.signature(function).parameters.values()
    words = frozenset(p.name for p in parameters if p.name in ("around", "memory"))
    positional = [
        p for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD) and p.name not in words
    ]
    count = most if any(p.kind is p.VAR_POSITIONAL for p in parameters) else min(most, len(positional))
    return count, words
