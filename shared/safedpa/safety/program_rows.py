"""The quadratic program's conditions in the scaled variables u = (a - low) / (high - low), and its closed form."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from safedpa.safety.nearest import NearestKept
from safedpa.safety.solution import Solution

__all__ = ["ScaledRow", "Side", "apart", "breakable", "closest", "cornered", "solved_at_once", "within"]

ScaledRow = tuple[list[float], float, int, float]
"""Slopes (actions,), limit, index and reach of a condition: slopes u >= limit, the slopes' sizes summing to 1.

The reach is what the actions can change in the condition, in its own unit: by it slopes and limit are divided.
"""

Side = tuple[float, float, float]
"""Lowest value, highest value and range of an action."""

_BEYOND: Final = 2.0
"""No action within the bounds reaches a limit of more than 1; how far beyond it lies does not matter."""


def solved_at_once(
    A: Sequence[Sequence[float]],
    b: Sequence[float],
    wish: Sequence[float],
    sides: tuple[Side, ...],
    weights: Sequence[float],
) -> tuple[Solution | None, list[ScaledRow]]:
    """The minimiser where it needs no slack and one or two actions have it in closed form, and the ``breakable`` rows.

    None: ask a solver.
    """
    finite, rows = breakable(A, b, sides)
    if not finite:
        return Solution([side[0] for side in sides], [0.0] * len(b), False, "numbers not finite"), rows
    if not rows:
        return Solution(within(wish, sides), [0.0] * len(b), True, "not needed"), rows
    if len(sides) > 2:
        return None, rows
    action = closest(rows, wish, sides, weights)
    return None if action is None else Solution(action, [0.0] * len(b), True, "solved"), rows


def breakable(
    A: Sequence[Sequence[float]], b: Sequence[float], sides: tuple[Side, ...]
) -> tuple[bool, list[ScaledRow]]:
    """Whether all numbers of A a >= b are finite, and the rows that some action within the bounds breaks.

    Rows that no action changes are left out: whether they are kept is not for the program to say. Raises ValueError
    when they are not as many as their limits, or a row has not one slope for each action.
    """
    rows: list[ScaledRow] = []
    count, actions = len(b), len(sides)
    if len(A) != count:
        raise ValueError(f"the program has {len(A)} rows and {count} limits")
    for index in range(count):
        slopes = A[index]
        if len(slopes) != actions:
            raise ValueError(f"row {index} has {len(slopes)} slopes for {actions} actions")
        scaled: list[float] = []
        limit: float = b[index]
        below, reach = 0.0, 0.0
        for column in range(actions):
            low, _, width = sides[column]
            slope: float = slopes[column]
            limit -= slope * low
            steep = slope * width
            scaled.append(steep)
            if steep < 0.0:
                below += steep
                reach -= steep
            else:
                reach += steep
        if limit - limit != 0.0 or reach - reach != 0.0:  # not finite
            return False, rows
        if below < limit and reach > 0.0:
            inverse = 1.0 / reach
            if inverse - inverse != 0.0:  # the smallest of numbers
                continue
            for column in range(actions):
                scaled[column] *= inverse
            limit *= inverse
            rows.append((scaled, limit if limit < _BEYOND else _BEYOND, index, reach))
    return True, rows


def closest(
    rows: Sequence[ScaledRow], wish: Sequence[float], sides: tuple[Side, ...], weights: Sequence[float]
) -> list[float] | None:
    """Of one or two actions: the minimiser without slack in closed form; None: ask the solver."""
    low, _, width = sides[0]
    base, reach, weight, aside = 0.0, 1.0, weights[0], 0.0
    single = len(sides) == 1  # beside a second one that nothing depends on
    if not single:
        base, _, reach = sides[1]
        weight, aside = weights[1], (wish[1] - base) / reach
    problem = NearestKept((wish[0] - low) / width, aside, weights[0], weight)
    for index in range(len(rows)):
        slopes, limit, _, _ = rows[index]
        problem.add(slopes[0], 0.0 if single else slopes[1], limit)
    if not problem.solve():
        return None
    return [low + width * problem.x] if single else [low + width * problem.x, base + reach * problem.y]


def cornered(
    rows: Sequence[ScaledRow],
    wish: Sequence[float],
    sides: tuple[Side, ...],
    weights: Sequence[float],
    linear: float,
    quadratic: float,
) -> list[int] | None:
    """Of two actions: the corner of their range, 0 and 1 for lowest and highest, that is the minimiser with slack.

    There a row misses s_i >= 0 and pulls with its price, linear + 2 quadratic s_i where s_i > 0 and nothing else; the
    corner is the minimiser if the sum of all pulls, the wish's among them, leads out of the range or nowhere in every
    entry: the Karush-Kuhn-Tucker conditions of a convex program. None: no corner is, or some price lies in between.
    """
    (low, _, width), (base, _, reach) = sides
    x, y = (wish[0] - low) / width, (wish[1] - base) / reach
    for right in range(2):
        for upper in range(2):
            across, along = 2.0 * weights[0] * (x - right), 2.0 * weights[1] * (y - upper)
            for index in range(len(rows)):
                slopes, limit, _, _ = rows[index]
                missing = limit - slopes[0] * right - slopes[1] * upper
                if missing > 0.0:
                    price = linear + 2.0 * quadratic * missing
                    across += price * slopes[0]
                    along += price * slopes[1]
            if (across >= 0.0 if right else across <= 0.0) and (along >= 0.0 if upper else along <= 0.0):
                return [right, upper]
    return None


def within(action: Sequence[float], sides: tuple[Side, ...]) -> tuple[float, ...]:
    """(actions,) each entry at its bound where it lies beyond."""
    kept: list[float] = []
    for index in range(len(sides)):
        low, high, _ = sides[index]
        value: float = action[index]
        kept.append(low if value < low else high if value > high else value)
    return tuple(kept)


def apart(action: Sequence[float], wish: Sequence[float], sides: tuple[Side, ...], weights: Sequence[float]) -> float:
    """(action - wish)' W (action - wish), W = diag(weights / range^2)."""
    total = 0.0
    for index in range(len(sides)):
        share = (action[index] - wish[index]) / sides[index][2]
        total += weights[index] * (share * share)
    return total
