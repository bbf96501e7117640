"""The margin epsilon from measured errors, with a stated coverage."""

from __future__ import annotations

from array import array
from bisect import bisect_left, insort
from math import ceil, inf, isfinite
from typing import final

import numpy as np
from numpy.typing import ArrayLike

from safedpa.errors import InputError

__all__ = ["OnlineMargin", "smallest_sample", "split_conformal_margin"]

_ROUNDING = 1e-9
"""Keeps (n + 1) coverage from being rounded up when it is a whole number but for rounding errors."""


def split_conformal_margin(errors: ArrayLike, coverage: float) -> float:
    """The ceil((n + 1) coverage)-th smallest of n errors (n,): a new one does not exceed it with that probability.

    An error is predicted h minus measured h one step later, positive where the model was over-optimistic. Holds for
    exchangeable errors of any distribution; infinite when n is too small to say, see ``smallest_sample``. Source: Vovk
    et al., Algorithmic Learning in a Random World, 2005. Raises InputError for a coverage outside (0, 1), errors that
    are not finite or not one axis.
    """
    _check_coverage(coverage)
    ordered = np.sort(np.asarray(errors, dtype=np.float64))
    if ordered.ndim != 1 or not np.isfinite(ordered).all():
        raise InputError(f"errors: got shape {ordered.shape} or NaN, wanted one axis of finite numbers")
    rank = _rank(len(ordered), coverage)
    return inf if rank > len(ordered) else float(ordered[rank - 1])


def smallest_sample(coverage: float) -> int:
    """The smallest n from which a finite margin of this coverage follows: ceil(coverage / (1 - coverage))."""
    _check_coverage(coverage)
    return max(1, ceil(coverage / (1.0 - coverage) - _ROUNDING))


@final
class OnlineMargin:
    """Adaptive conformal inference: the margin widens while coverage is lost and falls back to the calibrated one.

    With target alpha = 1 - coverage, alpha[t+1] = alpha[t] + rate (alpha - miss[t]), where miss[t] says that the error
    exceeded the margin; the margin is the (1 - alpha[t])-quantile of the last ``window`` errors, never below the
    calibrated margin. A window that is not full yet is taken as filled up by the calibration, with errors within its
    margin: one miss in the first second says no more than one miss later. Where alpha[t] <= 0 the paper takes infinity,
    which would stop a robot for good: here it is twice the largest error of the window. The share of misses over T
    steps then stays near alpha whatever the errors do.
    Source: Gibbs and Candes, Adaptive conformal inference under distribution shift, 2021. Raises InputError for numbers
    out of range.
    """

    def __init__(self, calibrated: float, coverage: float, rate: float = 0.02, window: int = 200) -> None:
        _check_coverage(coverage)
        if not (isfinite(calibrated) and calibrated >= 0.0):
            raise InputError(f"calibrated margin: got {calibrated}, wanted a finite number >= 0")
        if not 0.0 < rate <= 1.0 or window < 1:
            raise InputError(f"rate {rate}, window {window}: wanted 0 < rate <= 1 and window >= 1")
        self.calibrated, self._target, self._rate = calibrated, 1.0 - coverage, rate
        self._level = self._target
        self._window = window
        self._errors, self._oldest = array("d"), 0
        """The last ones; once there are ``window``, the oldest is overwritten."""
        self._ordered = array("d")
        """The same errors, the smallest first."""
        self._missed, self._longest_ago = bytearray(), 0
        self._misses = 0
        self.value = calibrated
        """The margin in force."""

    @property
    def coverage(self) -> float | None:
        """Share of the last ``window`` errors that did not exceed the margin then in force; None before the first."""
        return 1.0 - self._misses / len(self._missed) if self._missed else None

    def update(self, error: float) -> float:
        """The margin after one more error was seen; an error that is not finite counts as a miss and is not kept."""
        missed = not error <= self.value
        if missed or self._misses or len(self._missed) < self._window:
            self._count(missed)
        self._level += self._rate * (self._target - missed)
        if isfinite(error):
            self._keep(error)
        quantile = self._quantile()
        self.value = quantile if quantile > self.calibrated else self.calibrated
        return self.value

    def _count(self, missed: bool) -> None:
        if len(self._missed) < self._window:
            self._missed.append(missed)
        else:
            self._misses -= self._missed[self._longest_ago]
            self._missed[self._longest_ago] = missed
            self._longest_ago = (self._longest_ago + 1) % self._window
        self._misses += missed

    def _keep(self, error: float) -> None:
        errors, ordered, oldest = self._errors, self._ordered, self._oldest
        if len(errors) < self._window:
            errors.append(error)
        else:
            del ordered[bisect_left(ordered, errors[oldest])]
            errors[oldest] = error
            self._oldest = oldest + 1 if oldest + 1 < self._window else 0
        insort(ordered, error)

    def _quantile(self) -> float:
        if not self._errors:
            return self.calibrated
        if self._level <= 0.0:
            return 2.0 * self._ordered[-1]
        from_above = self._window - _rank(self._window, 1.0 - self._level)
        if from_above >= len(self._errors):
            return self.calibrated
        return self._ordered[-1 - max(from_above, 0)]


def _rank(count: int, coverage: float) -> int:
    return ceil((count + 1) * coverage - _ROUNDING)


def _check_coverage(coverage: float) -> None:
    if not 0.0 < coverage < 1.0:
        raise InputError(f"coverage: got {coverage}, wanted more than 0 and less than 1")
