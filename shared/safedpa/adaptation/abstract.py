"""What an estimator of the latent is, whatever it learns from."""

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
    """Estimates z of one robot from its transitions."""

    quick: ClassVar[bool]
    """Whether it may learn while others wait for the latent."""
    latent: FloatArray
    """The estimate so far, shape (latents,)."""

    @property
    @abstractmethod
    def deviations(self) -> FloatArray:
        """Standard deviation of each entry of the latent; 0 for one that is not estimated."""

    @abstractmethod
    def update(self, state: FloatArray, action: FloatArray, next_state: FloatArray, period: float) -> None:
        """Learns from one transition: state (states,), action in force (actions,), next state one period [s] later.

        Raises InputError when a number is not finite or the period not positive; nothing is learned then.
        """

    def begin_with(self, transitions: Sequence[tuple[FloatArray, FloatArray, FloatArray, float]]) -> None:
        """Takes up a robot that others estimated before, from its last transitions as in ``update``, oldest first.

        Raises InputError as ``update`` does.
        """
        if transitions:
            self.update(*transitions[-1])

    @abstractmethod
    def forget_transient(self) -> None:
        """Takes what comes next as not joined to what came last: after a gap in the ticks."""


def check_transition(state: FloatArray, action: FloatArray, next_state: FloatArray, period: float) -> None:
    """Raises InputError when a transition cannot teach anything."""
    if not all(_is_finite(vector) for vector in (state, action, next_state)):
        raise InputError(f"transition: got {state} under {action} to {next_state}, wanted finite numbers")
    if not (isfinite(period) and period > 0.0):
        raise InputError(f"period: got {period}, wanted a positive number of seconds")


def _is_finite(vector: FloatArray) -> bool:
    """As ``np.isfinite(vector).all()``, quicker: a sum is finite only if every entry is."""
    return isfinite(sum(vector.tolist())) or bool(np.isfinite(vector).all())
