"""The least value of h along a path of states, between its states too: a thin obstacle is not jumped over.

Between two ticks the state is taken to move along the straight chord y(t) = (1 - t) a + t b; with an acceleration c
the true path leaves it by c period^2 / 8 at most, which belongs into the margin. On a chord h is looked at where it
might still be less than the least value found: with slopes up to L, half as much again as the steepest seen, it is at
least

    (h(t1) + h(t2) - L (t2 - t1)) / 2

between two places t1 < t2 (Piyavskii 1972, Shubert 1972). What is found is polished by Brent's parabolas.
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

__all__ = ["PathMinimum", "Place", "chord_point", "minimum_along"]

Place: TypeAlias = tuple[int, float]
"""Chord k and the share t in [0, 1) of it."""

_STEEPER: Final = 1.5
"""By so much h may be steeper than was seen."""
_NARROWEST: Final = 1.0 / 16.0
"""Share of a chord that is looked at no closer, but for the polishing."""
_FIRST: Final = (0.29, 0.62)
"""Places on a chord that are looked at first: not symmetrical, since what lies in the middle would look level."""
_ALONGSIDE: Final = 1e-5
"""Share of an interval, next to an end of a chord that is lower than its samples, at which h is looked at again."""
_FEW: Final = 4
"""Chords of a path so short tell too little of how steep h is: all of them are looked at."""
_POLISHED: Final = 1e-9
_MOST_POLISHING: Final = 60
_GOLDEN: Final = 0.3819660112501051


@final
@dataclass(frozen=True)
class PathMinimum:
    """h (m,) at its least and where that is, one place for each value; ``size`` (m,) > 0: largest |h| on the path."""

    values: FloatArray
    places: tuple[Place, ...]
    size: FloatArray


def chord_point(path: Sequence[FloatArray], place: Place) -> FloatArray:
    """The state (states,) at a place of a path."""
    k, share = place
    if share == 0.0:
        return path[k]
    point = (1.0 - share) * path[k] + share * path[k + 1]
    point.flags.writeable = False
    return point


def minimum_along(h: Callable[[FloatArray], FloatArray], path: Sequence[FloatArray], always: int = 0) -> PathMinimum:
    """The least h_i (m,) on a path of states; its first ``always`` chords are looked into in any case.

    Of several places with the same least value the first counts. Where h is NaN at a place that was looked at, so is
    the least.
    """
    table = np.array([h(state) for state in path])
    values = table.min(axis=0)
    lost = np.isnan(values)

    def looked(state: FloatArray) -> FloatArray:
        found = h(state)
        np.logical_or(lost, np.isnan(found), out=lost)
        return found

    places: list[Place] = [(int(k), 0.0) for k in table.argmin(axis=0)]
    moving = np.array([a is not b and a.tobytes() != b.tobytes() for a, b in pairwise(path)], dtype=bool)
    for k in _open_chords(table, moving, values, always):
        _look_between(looked, path, k, table, values, places)
    values[lost] = np.nan  # no comparison tells it
    size = np.abs(table).max(axis=0)
    return PathMinimum(values, tuple(places), np.where(size > 0.0, size, 1.0))


def _open_chords(table: FloatArray, moving: NDArray[np.bool_], values: FloatArray, always: int) -> list[int]:
    """Chords on which h might be less than at every tick, judged by how steep it is there and on both neighbours."""
    if len(moving) <= _FEW:
        return np.flatnonzero(moving).tolist()
    change = np.abs(table[1:] - table[:-1])
    steepest = change.copy()
    np.maximum(steepest[1:], change[:-1], out=steepest[1:])
    np.maximum(steepest[:-1], change[1:], out=steepest[:-1])
    lower = (0.5 * (table[:-1] + table[1:]) - 0.5 * _STEEPER * steepest < values).any(axis=1)
    first = np.arange(len(moving)) < always
    return np.flatnonzero((lower | first) & moving).tolist()


def _look_between(
    h: Callable[[FloatArray], FloatArray],
    path: Sequence[FloatArray],
    k: int,
    table: FloatArray,
    values: FloatArray,
    places: list[Place],
) -> None:
    """Lowers ``values`` and moves ``places`` to what one chord holds."""
    shares = np.array((0.0, *_FIRST, 1.0))
    rows = np.array((table[k], *(h(chord_point(path, (k, share))) for share in _FIRST), table[k + 1]))
    while (middles := _open_middles(shares, rows, values)).size:
        shares = np.concatenate((shares, middles))
        rows = np.concatenate((rows, [h(chord_point(path, (k, share))) for share in middles.tolist()]))
        order = np.argsort(shares)
        shares, rows = shares[order], rows[order]
    for row in range(rows.shape[1]):
        curve = partial(_height, h, path, k, row)
        bracket = _bracket(shares, rows[:, row], curve, float(values[row]))
        if bracket is not None:
            share, low = _polished(curve, *bracket)
            if low < values[row]:
                values[row], places[row] = low, (k, share)


def _bracket(
    shares: FloatArray, column: FloatArray, curve: Callable[[float], float], least: float
) -> tuple[tuple[float, float, float], float] | None:
    """A place between two higher ones, and the value there, if less than ``least`` may lie around it; else None."""
    at = int(column.argmin())
    steps = np.abs(np.diff(column[max(at - 1, 0) : at + 2]))
    if not column[at] - _STEEPER * steps.max() < least:
        return None
    if 0 < at < len(shares) - 1:
        return (float(shares[at - 1]), float(shares[at]), float(shares[at + 1])), float(column[at])
    end, neighbour = float(shares[at]), float(shares[1 if at == 0 else at - 1])
    alongside = end + _ALONGSIDE * (neighbour - end)  # is the end a valley's foot, or does a valley begin there?
    value = curve(alongside)
    if value >= column[at]:
        return None
    return (min(end, neighbour), alongside, max(end, neighbour)), value


def _height(h: Callable[[FloatArray], FloatArray], path: Sequence[FloatArray], k: int, row: int, share: float) -> float:
    return float(h(chord_point(path, (k, share)))[row])


def _open_middles(shares: FloatArray, rows: FloatArray, values: FloatArray) -> FloatArray:
    """The middles of the intervals in which some value might be less than what was found."""
    widths = shares[1:] - shares[:-1]
    steep = (np.abs(rows[1:] - rows[:-1]) / widths[:, np.newaxis]).max(axis=0)
    bound = 0.5 * (rows[:-1] + rows[1:]) - 0.5 * _STEEPER * steep * widths[:, np.newaxis]
    floor = np.minimum(values, rows.min(axis=0))
    open_ = (bound < floor).any(axis=1) & (widths > _NARROWEST)
    middles: FloatArray = 0.5 * (shares[1:] + shares[:-1])[open_]
    return middles


def _polished(
    curve: Callable[[float], float], bracket: tuple[float, float, float], lowest: float
) -> tuple[float, float]:
    """The least value of a curve between the ends of a bracket around a lower place, and where it is.

    Source: Brent, Algorithms for Minimization without Derivatives, 1973, chapter 5.
    """
    low, best, high = bracket
    value = second_value = third_value = lowest
    second = third = best
    step = last = 0.0
    for _ in range(_MOST_POLISHING):
        middle = 0.5 * (low + high)
        if abs(best - middle) <= 2.0 * _POLISHED - 0.5 * (high - low):
            break
        r = (best - second) * (value - third_value)
        q = (best - third) * (value - second_value)
        p = (best - third) * q - (best - second) * r
        q = 2.0 * (q - r)
        p, q = (-p, q) if q > 0.0 else (p, -q)
        if q != 0.0 and abs(p) < abs(0.5 * q * last) and q * (low - best) < p < q * (high - best):
            last, step = step, p / q
            if min(best + step - low, high - best - step) < 2.0 * _POLISHED:
                step = float(np.copysign(_POLISHED, middle - best))
        else:
            last = (high if best < middle else low) - best
            step = _GOLDEN * last
        tried = best + (step if abs(step) >= _POLISHED else np.copysign(_POLISHED, step))
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
