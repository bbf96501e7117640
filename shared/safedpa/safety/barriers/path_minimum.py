"""The minimum of h along a path of states, also between them: a thin obstacle is not jumped over.

Between two ticks the state is assumed to move along the straight chord y(t) = (1 - t) a + t b. With an acceleration c
the true path deviates from it by at most c period^2 / 8, which belongs into the margin. A chord is searched where h
might still be below the minimum found: with |dh/dt| up to L, 1.5 times the largest value seen, h is at least

    (h(t1) + h(t2) - L (t2 - t1)) / 2

between two points t1 < t2 (Piyavskii 1972, Shubert 1972). The minimum is refined by Brent's method.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Final, TypeAlias, final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray

__all__ = ["PathMinimum", "PathPoint", "chord_point", "minimum_along"]

PathPoint: TypeAlias = tuple[int, float]
"""Index k of a chord and the share t in [0, 1) on it."""

_GRADIENT_FACTOR: Final = 1.5
"""Factor by which |dh/dt| may exceed the largest value seen."""
_MIN_INTERVAL: Final = 1.0 / 16.0
"""Share of a chord below which an interval is not divided further; Brent's method still refines it."""
_FIRST_SHARES: Final = (0.29, 0.62)
"""First points on a chord; not symmetric, since a minimum in the middle would then show two equal samples."""
_END_STEP: Final = 1e-5
"""Step from an end of a chord that is lower than its samples, to see whether h falls further from there."""
_SHORT_PATH: Final = 4
"""Paths with so few chords show too little of |dh/dt|: all chords are searched."""
_BRENT_TOLERANCE: Final = 1e-9
"""Share of a chord; below it the change of h is rounding error."""
_BRENT_STEPS: Final = 60
"""Golden section alone needs 43 steps to reach the tolerance."""
_GOLDEN: Final = 0.3819660112501051
"""(3 - sqrt(5)) / 2."""


@final
@dataclass(frozen=True)
class PathMinimum:
    """The minimum (m,) of each h and its point; ``size`` (m,) > 0: largest |h| on the path."""

    values: FloatArray
    points: tuple[PathPoint, ...]
    size: FloatArray


def chord_point(path: Sequence[FloatArray], point: PathPoint) -> FloatArray:
    """The state (states,) at a point of a path."""
    k, share = point
    if share == 0.0:
        return path[k]
    state = (1.0 - share) * path[k] + share * path[k + 1]
    # Read-only, since a user's h gets it.
    state.flags.writeable = False
    return state


def minimum_along(h: Callable[[FloatArray], FloatArray], path: Sequence[FloatArray], always: int = 0) -> PathMinimum:
    """Returns the minimum of each h_i (m,) on a path of states; its first ``always`` chords are searched in any case.

    Of several equal minima the first counts. If h is NaN at a point that was evaluated, the minimum is NaN.
    """
    table = np.array([h(state) for state in path])
    values = table.min(axis=0)
    has_nan = np.isnan(values)

    def checked_h(state: FloatArray) -> FloatArray:
        found = h(state)
        np.logical_or(has_nan, np.isnan(found), out=has_nan)
        return found

    points: list[PathPoint] = [(int(k), 0.0) for k in table.argmin(axis=0)]
    # At rest the backup repeats states bit for bit: those chords have no interior.
    moving = np.array([a is not b and a.tobytes() != b.tobytes() for a, b in pairwise(path)], dtype=bool)
    for k in _candidate_chords(table, moving, values, always):
        _search_chord(checked_h, path, k, table, values, points)
    values[has_nan] = np.nan  # comparisons with NaN are false, so the search itself would not notice it
    # Never 0: the caller divides by it.
    size = np.abs(table).max(axis=0)
    return PathMinimum(values, tuple(points), np.where(size > 0.0, size, 1.0))


def _candidate_chords(table: FloatArray, moving: NDArray[np.bool_], values: FloatArray, always: int) -> list[int]:
    """Chords on which h might be below all ticks, judged by |dh/dt| there and on both neighbours."""
    if len(moving) <= _SHORT_PATH:
        return np.flatnonzero(moving).tolist()
    change = np.abs(table[1:] - table[:-1])
    grad_bound = change.copy()
    np.maximum(grad_bound[1:], change[:-1], out=grad_bound[1:])
    np.maximum(grad_bound[:-1], change[1:], out=grad_bound[:-1])
    # Neighbours are included: a valley on one chord bends the chords next to it.
    lower = (0.5 * (table[:-1] + table[1:]) - 0.5 * _GRADIENT_FACTOR * grad_bound < values).any(axis=1)
    first = np.arange(len(moving)) < always
    return np.flatnonzero((lower | first) & moving).tolist()


def _search_chord(
    h: Callable[[FloatArray], FloatArray],
    path: Sequence[FloatArray],
    k: int,
    table: FloatArray,
    values: FloatArray,
    points: list[PathPoint],
) -> None:
    """Lowers ``values`` and moves ``points`` to the minima of one chord."""
    shares = np.array((0.0, *_FIRST_SHARES, 1.0))
    rows = np.array((table[k], *(h(chord_point(path, (k, share))) for share in _FIRST_SHARES), table[k + 1]))
    # All midpoints of a round are evaluated together, so that the bound uses the largest |dh/dt| known.
    while (middles := _candidate_midpoints(shares, rows, values)).size:
        shares = np.concatenate((shares, middles))
        rows = np.concatenate((rows, [h(chord_point(path, (k, share))) for share in middles.tolist()]))
        order = np.argsort(shares)
        shares, rows = shares[order], rows[order]
    for row in range(rows.shape[1]):
        curve = partial(_h_on_chord, h, path, k, row)
        bracket = _bracket(shares, rows[:, row], curve, float(values[row]))
        if bracket is not None:
            share, low = _brent_minimum(curve, *bracket)
            if low < values[row]:
                values[row], points[row] = low, (k, share)


def _bracket(
    shares: FloatArray, column: FloatArray, curve: Callable[[float], float], least: float
) -> tuple[tuple[float, float, float], float] | None:
    """A point between two higher ones and the value there, if a value below ``least`` may be near it; else None."""
    at = int(column.argmin())
    steps = np.abs(np.diff(column[max(at - 1, 0) : at + 2]))
    if not column[at] - _GRADIENT_FACTOR * steps.max() < least:
        return None
    if 0 < at < len(shares) - 1:
        return (float(shares[at - 1]), float(shares[at]), float(shares[at + 1])), float(column[at])
    # The lowest sample is an end. One more sample close to it shows whether the curve falls further inside.
    end, neighbour = float(shares[at]), float(shares[1 if at == 0 else at - 1])
    alongside = end + _END_STEP * (neighbour - end)
    value = curve(alongside)
    if value >= column[at]:
        return None
    return (min(end, neighbour), alongside, max(end, neighbour)), value


def _h_on_chord(
    h: Callable[[FloatArray], FloatArray], path: Sequence[FloatArray], k: int, row: int, share: float
) -> float:
    return float(h(chord_point(path, (k, share)))[row])


def _candidate_midpoints(shares: FloatArray, rows: FloatArray, values: FloatArray) -> FloatArray:
    """Midpoints of the intervals in which some value might be below the minimum found."""
    widths = shares[1:] - shares[:-1]
    gradient = (np.abs(rows[1:] - rows[:-1]) / widths[:, np.newaxis]).max(axis=0)
    bound = 0.5 * (rows[:-1] + rows[1:]) - 0.5 * _GRADIENT_FACTOR * gradient * widths[:, np.newaxis]
    floor = np.minimum(values, rows.min(axis=0))
    open_ = (bound < floor).any(axis=1) & (widths > _MIN_INTERVAL)
    middles: FloatArray = 0.5 * (shares[1:] + shares[:-1])[open_]
    return middles


def _brent_minimum(
    curve: Callable[[float], float], bracket: tuple[float, float, float], lowest: float
) -> tuple[float, float]:
    """The minimum of a curve between the ends of a bracket around a lower point, and where it is.

    Source: Brent, Algorithms for Minimization without Derivatives, 1973, chapter 5.
    """
    low, best, high = bracket
    value = second_value = third_value = lowest
    second = third = best
    step = last = 0.0
    for _ in range(_BRENT_STEPS):
        # Brent's stopping rule: neither end of the bracket is further than two tolerances from the best point.
        middle = 0.5 * (low + high)
        if abs(best - middle) <= 2.0 * _BRENT_TOLERANCE - 0.5 * (high - low):
            break
        r = (best - second) * (value - third_value)
        q = (best - third) * (value - second_value)
        p = (best - third) * q - (best - second) * r
        q = 2.0 * (q - r)
        p, q = (-p, q) if q > 0.0 else (p, -q)
        if q != 0.0 and abs(p) < abs(0.5 * q * last) and q * (low - best) < p < q * (high - best):
            last, step = step, p / q
            if min(best + step - low, high - best - step) < 2.0 * _BRENT_TOLERANCE:
                step = float(np.copysign(_BRENT_TOLERANCE, middle - best))
        else:
            last = (high if best < middle else low) - best
            step = _GOLDEN * last
        tried = best + (step if abs(step) >= _BRENT_TOLERANCE else np.copysign(_BRENT_TOLERANCE, step))
        found = curve(float(tried))
        if found <= value:
            low, high = (best, high) if tried >= best else (low, best)
            third, third_value, second, second_value = second, second_value, best, value
            best, value = float(tried), found
            continue
        low, high = (low, float(tried)) if tried >= best else (float(tried), high)
        if found <= second_value or second == best:
            third, third_value, second, second_value = second, second_value, float(tried), found
        elif found <= third_value or third in (best, second):
            third, third_value = float(tried), found
    return best, value
