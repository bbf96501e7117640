"""The interface of an estimator of the latent."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from math import isfinite
from typing import ClassVar

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.errors import InputError

__all__ = ["AbstractEstimator", "check_transition"]


class AbstractEstimator(ABC):
    """Estimates the latent z of one robot from its transitions."""

    quick: ClassVar[bool]
    """Whether an update is fast enough to precede the publication of the latent."""
    latent: FloatArray
    """Current estimate (latents,)."""

    @property
    @abstractmethod
    def deviations(self) -> FloatArray:
        """Standard deviations of the estimate (latents,); 0 for entries that are not estimated."""

    @abstractmethod
    def update(self, state: FloatArray, action: FloatArray, next_state: FloatArray, period: float) -> None:
        """Updates the estimate with a transition: state (states,), applied action (actions,), next state after
        ``period``.

        Raises InputError and leaves the estimate unchanged if a number is not finite or the period is not positive.
        """

    def begin_with(self, transitions: Sequence[tuple[FloatArray, FloatArray, FloatArray, float]]) -> None:
        """Initialises the estimate from the last transitions of a robot, oldest first.

        Raises InputError as ``update`` does.
        """
        if transitions:
            self.update(*transitions[-1])

    @abstractmethod
    def forget_transient(self) -> None:
        """Resets internal states that connect transitions; call it after a gap in the ticks."""


def check_transition(state: FloatArray, action: FloatArray, next_state: FloatArray, period: float) -> None:
    """Raises InputError for a transition with non-finite values or an invalid period."""
    if not all(_is_finite(vector) for vector in (state, action, next_state)):
        raise InputError(f"transition: got {state} under {action} to {next_state}, wanted finite numbers")
    if not (isfinite(period) and period > 0.0):
        raise InputError(f"period: got {period}, wanted a positive number of seconds")


def _is_finite(vector: FloatArray) -> bool:
    """Same as ``np.isfinite(vector).all()``, but faster."""
    # A finite sum implies finite entries. The sum of finite entries may overflow, hence the second test.
    return isfinite(sum(vector.tolist())) or bool(np.isfinite(vector).all())
