"""The margin epsilon from measured errors, with a stated coverage: offline (split conformal) and online (adaptive)."""

from __future__ import annotations

from array import array
from bisect import bisect_left, insort
from collections.abc import Sequence
from math import ceil, inf, isfinite
from typing import final

import numpy as np
from numpy.typing import ArrayLike

from safedpa.errors import InputError

__all__ = ["OnlineMargin", "margins_over_drives", "smallest_sample", "split_conformal_margin"]

_ROUNDING = 1e-9
"""Keeps (n + 1) coverage from being rounded up if it is an integer up to rounding errors."""

_FACTOR = 2.0
"""Factor of the margin for each miss once the budget of misses is used up."""
_MAX_MARGIN = 1e12
"""Upper limit of a margin, far above any quantity of a robot; messages carry no larger number."""


def split_conformal_margin(errors: ArrayLike, coverage: float) -> float:
    """The ceil((n + 1) coverage)-th smallest of n errors (n,): a new one does not exceed it with that probability.

    An error is predicted h minus measured h one step later, positive if the model was too optimistic. Holds for
    exchangeable errors of any distribution; infinite if n is too small, see ``smallest_sample``. Source: Vovk et al.,
    Algorithmic Learning in a Random World, 2005. Raises InputError for a coverage outside (0, 1), errors that are not
    finite, or more than one axis.
    """
    _check_coverage(coverage)
    ordered = np.sort(np.asarray(errors, dtype=np.float64))
    # NaN sorts last and would count as a large error; a table of errors must not contain any.
    if ordered.ndim != 1 or not np.isfinite(ordered).all():
        raise InputError(f"errors: got shape {ordered.shape} or NaN, wanted one axis of finite numbers")
    rank = _rank(len(ordered), coverage)
    return inf if rank > len(ordered) else float(ordered[rank - 1])


def margins_over_drives(drives: Sequence[ArrayLike], coverage: float) -> tuple[float, float]:
    """Two margins from the errors (steps,) of each of n drives: (for a step, for a whole drive).

    Neighbouring steps are correlated, and steps of one drive share its scene and its load: drives are exchangeable,
    steps are not. The second margin is the ceil((n + 1) coverage)-th smallest of the drives' largest errors: a new
    drive has no error above it with that probability. The first is the smallest q with

        1 / (n + 1) sum over drives of (share of the drive's errors <= q) >= coverage:

    a random step of a new drive exceeds it with probability at most 1 - coverage. Either is infinite with fewer than
    ``smallest_sample`` drives. Sources: Vovk et al., Algorithmic Learning in a Random World, 2005; Lee, Barber,
    Willett, Distribution-free inference with hierarchical data, 2023. Raises InputError for a coverage outside (0, 1),
    errors that are not finite, and a drive without one.
    """
    _check_coverage(coverage)
    tables = [np.asarray(errors, dtype=np.float64) for errors in drives]
    for table in tables:
        if table.ndim != 1 or not len(table) or not np.isfinite(table).all():
            raise InputError(f"errors of a drive: got shape {table.shape} or NaN, wanted one axis of finite numbers")
    if not tables:
        return inf, inf
    largest = split_conformal_margin([float(table.max()) for table in tables], coverage)
    every = np.concatenate(tables)
    # Each drive has weight 1 however long it is: a long drive must not outvote the others.
    shares = np.concatenate([np.full(len(table), 1.0 / len(table)) for table in tables])
    order = np.argsort(every, kind="stable")
    # The n + 1 counts the new drive as one that exceeds every margin.
    reached = np.cumsum(shares[order]) >= (len(tables) + 1) * coverage - _ROUNDING
    return (float(every[order[int(reached.argmax())]]) if reached.any() else inf), largest


def smallest_sample(coverage: float) -> int:
    """The smallest n that gives a finite margin of this coverage: ceil(coverage / (1 - coverage))."""
    _check_coverage(coverage)
    return max(1, ceil(coverage / (1.0 - coverage) - _ROUNDING))


@final
class OnlineMargin:
    """Adaptive conformal inference: widens the margin while coverage is lost, and returns to the calibrated one.

    With target alpha = 1 - coverage, alpha[t+1] = min(alpha, alpha[t] + rate (alpha - miss[t])), where miss[t] is 1 if
    the error exceeded the margin. The margin is the (1 - alpha[t])-quantile of the last ``window`` errors, never below
    the calibrated margin. A window that is not full counts as filled with errors within the calibrated margin: one miss
    in the first second means no more than one miss later. If alpha[t] <= 0 the paper takes infinity, which would stop a
    robot for good. Here it is the larger of the window's largest error and the calibrated margin, times 2, and times 2
    again with every further miss until alpha[t] > 0.

    Guarantee: if no error is more than 2^k times the larger of the calibrated margin and the largest error of the
    window before it, fewer than alpha n + alpha / rate + max(k, 1) of any n successive errors exceed the margin. Proof:
    since alpha[t] <= alpha, the misses of n steps are at most alpha n + (alpha - alpha[t+n]) / rate. alpha[t] falls to
    0 or below with one miss, and from then on each miss doubles the factor; after k - 1 of them no error exceeds it, so
    alpha[t] > -rate max(k, 1). Errors that grow faster than any k, or are not finite, can miss always. Nothing follows
    about which steps miss, and misses may be consecutive. Source: Gibbs and Candes, Adaptive conformal inference under
    distribution shift, 2021. Raises InputError for parameters out of range.
    """

    def __init__(self, calibrated: float, coverage: float, rate: float = 0.02, window: int = 200) -> None:
        _check_coverage(coverage)
        if not (isfinite(calibrated) and calibrated >= 0.0):
            raise InputError(f"calibrated margin: got {calibrated}, wanted a finite number >= 0")
        if not 0.0 < rate <= 1.0 or window < 1:
            raise InputError(f"rate {rate}, window {window}: wanted 0 < rate <= 1 and window >= 1")
        self.calibrated, self._target, self._rate = calibrated, 1.0 - coverage, rate
        self._level, self._factor = self._target, _FACTOR
        self._window = window
        self._errors, self._oldest = array("d"), 0
        """The last errors; once there are ``window``, the oldest is overwritten."""
        self._ordered = array("d")
        """The same errors in ascending order, so that a quantile is one look-up."""
        self._miss_flags, self._oldest_miss = bytearray(), 0
        self._misses = 0
        self.value = calibrated
        """The margin in force."""

    @property
    def coverage(self) -> float | None:
        """Share of the last ``window`` errors that did not exceed their margin; None before the first."""
        return 1.0 - self._misses / len(self._miss_flags) if self._miss_flags else None

    def update(self, error: float) -> float:
        """Returns the margin after one more error; an error that is not finite counts as a miss and is not stored."""
        missed = not error <= self.value  # also true for NaN
        # Without a miss in a full window the flags are all 0: overwriting one of them changes nothing.
        if missed or self._misses or len(self._miss_flags) < self._window:
            self._record_miss(missed)
        self._update_level(missed, isfinite(error))
        if isfinite(error):
            self._record_error(error)
        quantile = self._quantile()
        self.value = quantile if quantile > self.calibrated else self.calibrated
        return self.value

    def _update_level(self, missed: bool, finite: bool) -> None:
        """Updates alpha, at most to its target: saved-up misses would delay the widening of the margin."""
        exhausted = self._level <= 0.0
        level = self._level + self._rate * (self._target - missed)
        self._level = level if level < self._target else self._target
        # Back to normal: the next loss of coverage starts doubling again from the beginning.
        if self._level > 0.0:
            self._factor = _FACTOR
        # Only an error that was seen can show that the factor is too small; NaN shows nothing.
        elif exhausted and missed and finite:
            self._factor *= _FACTOR

    def _record_miss(self, missed: bool) -> None:
        if len(self._miss_flags) < self._window:
            self._miss_flags.append(missed)
        else:
            self._misses -= self._miss_flags[self._oldest_miss]
            self._miss_flags[self._oldest_miss] = missed
            self._oldest_miss = (self._oldest_miss + 1) % self._window
        self._misses += missed

    def _record_error(self, error: float) -> None:
        errors, ordered, oldest = self._errors, self._ordered, self._oldest
        if len(errors) < self._window:
            errors.append(error)
        else:
            # Removal and insertion in a sorted array take O(window) moves of floats, faster than sorting 500 of them.
            del ordered[bisect_left(ordered, errors[oldest])]
            errors[oldest] = error
            self._oldest = oldest + 1 if oldest + 1 < self._window else 0
        insort(ordered, error)

    def _quantile(self) -> float:
        if not self._errors:
            return self.calibrated
        if self._level <= 0.0:
            return min(self._factor * max(self._ordered[-1], self.calibrated), _MAX_MARGIN)
        # Counted from the largest error, since the empty part of the window lies below all errors.
        from_above = self._window - _rank(self._window, 1.0 - self._level)
        if from_above >= len(self._errors):
            return self.calibrated
        return self._ordered[-1 - max(from_above, 0)]


def _rank(count: int, coverage: float) -> int:
    return ceil((count + 1) * coverage - _ROUNDING)


def _check_coverage(coverage: float) -> None:
    if not 0.0 < coverage < 1.0:
        raise InputError(f"coverage: got {coverage}, wanted more than 0 and less than 1")
