"""The quadratic program's conditions in the scaled variables u = (a - low) / (high - low), and its closed form."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, isfinite

from safedpa.safety.nearest import Row, nearest_kept

__all__ = ["ScaledRow", "Side", "breakable", "closest"]

ScaledRow = tuple[list[float], float, int]
"""Slopes (actions,), limit and index of a condition: slopes u >= limit."""

Side = tuple[float, float, float]
"""Lowest value, highest value and range of an action."""

_BOX: list[Row] = [(1.0, 0.0, 0.0, inf), (-1.0, 0.0, -1.0, inf), (0.0, 1.0, 0.0, inf), (0.0, -1.0, -1.0, inf)]
"""0 <= u <= 1 as conditions that no slack can relieve."""


def breakable(
    A: Sequence[Sequence[float]], b: Sequence[float], sides: tuple[Side, ...]
) -> tuple[bool, list[ScaledRow]]:
    """Whether all numbers of A a >= b are finite, and the rows that some action within the bounds breaks."""
    rows: list[ScaledRow] = []
    for index, (slopes, right) in enumerate(zip(A, b, strict=True)):
        scaled: list[float] = []
        limit, below = right, 0.0
        for slope, (low, _, width) in zip(slopes, sides, strict=True):
            limit -= slope * low
            steep = slope * width
            scaled.append(steep)
            if steep < 0.0:
                below += steep
        if not isfinite(limit):  # A low is in it: a number of A that is none as well
            return False, rows
        if below < limit:
            rows.append((scaled, limit, index))
    return True, rows


def closest(
    rows: Sequence[ScaledRow], wish: Sequence[float], sides: tuple[Side, ...], weights: Sequence[float], price: float
) -> list[float] | None:
    """Of one or two actions: the minimiser without slack in closed form; None: ask the solver."""
    low, _, width = sides[0]
    first = (wish[0] - low) / width
    if len(sides) == 1:  # beside a second one that nothing depends on
        conditions = [(slopes[0], 0.0, limit, price) for slopes, limit, _ in rows] + _BOX[:2]
        found = nearest_kept(conditions, (first, 0.0), (weights[0], weights[0]))
        return None if found is None else [low + width * found[0]]
    base, _, reach = sides[1]
    conditions = [(slopes[0], slopes[1], limit, price) for slopes, limit, _ in rows] + _BOX
    found = nearest_kept(conditions, (first, (wish[1] - base) / reach), (weights[0], weights[1]))
    return None if found is None else [low + width * found[0], base + reach * found[1]]
