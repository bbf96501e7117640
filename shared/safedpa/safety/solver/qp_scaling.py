"""The quadratic program's conditions in u = (a - low) / (high - low), and its solution for one or two actions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from safedpa.safety.solver.active_set_2d import QP2D, HardQP2D, SoftQP2D
from safedpa.safety.solver.solution import Solution

__all__ = ["ScaledRow", "Side", "apart", "breakable", "closest", "minimum_violation", "presolve", "within"]

ScaledRow = tuple[list[float], float, int, float]
"""Slopes (actions,), limit, index and reach of a condition: slopes u >= limit, the slopes' sizes summing to 1.

The reach is what the actions can change in the condition, in its own unit: by it slopes and limit are divided.
"""

Side = tuple[float, float, float]
"""Lowest value, highest value and range of an action."""

_BEYOND: Final = 2.0
"""No action within the bounds reaches a limit of more than 1; how far beyond it lies does not matter."""


def presolve(
    A: Sequence[Sequence[float]],
    b: Sequence[float],
    nominal: Sequence[float],
    sides: tuple[Side, ...],
    weights: Sequence[float],
) -> tuple[Solution | None, list[ScaledRow]]:
    """The minimiser of one or two actions where it is certain, and the ``breakable`` rows; None: ask a solver."""
    finite, rows = breakable(A, b, sides)
    if not finite:
        return Solution([side[0] for side in sides], [0.0] * len(b), False, "numbers not finite"), rows
    if not rows:
        return Solution(within(nominal, sides), [0.0] * len(b), True, "not needed"), rows
    if len(sides) > 2:
        return None, rows
    action, slack = closest(rows, nominal, sides, weights), [0.0] * len(b)
    if action is None:
        action = minimum_violation(rows, nominal, sides, weights, slack)
    return None if action is None else Solution(action, slack, True, "solved"), rows


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
    rows: Sequence[ScaledRow], nominal: Sequence[float], sides: tuple[Side, ...], weights: Sequence[float]
) -> list[float] | None:
    """Of one or two actions: the minimiser without slack; None: there is none, or it is not certain."""
    x, y, weight = _wanted(nominal, sides, weights)
    problem = HardQP2D(x, y, weights[0], weight)
    _fill(problem, rows)
    return _action(problem.x, problem.y, sides) if problem.solve() else None


def minimum_violation(
    rows: Sequence[ScaledRow],
    nominal: Sequence[float],
    sides: tuple[Side, ...],
    weights: Sequence[float],
    slack: list[float],
) -> list[float] | None:
    """Of one or two actions: the minimiser with slack, which is written into ``slack``; None: it is not certain."""
    x, y, weight = _wanted(nominal, sides, weights)
    problem = SoftQP2D(x, y, weights[0], weight)
    _fill(problem, rows)
    if not problem.solve():
        return None
    x, y = problem.x, problem.y
    for index in range(len(rows)):
        slopes, limit, place, reach = rows[index]
        missing = limit - slopes[0] * x - (slopes[1] * y if len(slopes) > 1 else 0.0)
        slack[place] = reach * missing if missing > 0.0 else 0.0
    return _action(x, y, sides)


def _fill(problem: QP2D, rows: Sequence[ScaledRow]) -> None:
    for index in range(len(rows)):
        slopes, limit, _, _ = rows[index]
        problem.add(slopes[0], slopes[1] if len(slopes) > 1 else 0.0, limit)


def _wanted(nominal: Sequence[float], sides: tuple[Side, ...], weights: Sequence[float]) -> tuple[float, float, float]:
    """The nominal action in the unit square, and the second one's weight; a single action stands next to one that is nothing."""
    low, _, width = sides[0]
    x: float = (nominal[0] - low) / width
    if len(sides) == 1:
        return x, 0.0, weights[0]
    low, _, width = sides[1]
    return x, (nominal[1] - low) / width, weights[1]


def _action(x: float, y: float, sides: tuple[Side, ...]) -> list[float]:
    """Of one or two actions; exactly the bound where it lies there."""
    low, high, width = sides[0]
    action = [high if x == 1.0 else low + width * x]
    if len(sides) > 1:
        low, high, width = sides[1]
        action.append(high if y == 1.0 else low + width * y)
    return action


def within(action: Sequence[float], sides: tuple[Side, ...]) -> tuple[float, ...]:
    """(actions,) each entry at its bound where it lies beyond."""
    kept: list[float] = []
    for index in range(len(sides)):
        low, high, _ = sides[index]
        value: float = action[index]
        kept.append(low if value < low else high if value > high else value)
    return tuple(kept)


def apart(
    action: Sequence[float], nominal: Sequence[float], sides: tuple[Side, ...], weights: Sequence[float]
) -> float:
    """(action - nominal)' W (action - nominal), W = diag(weights / range^2)."""
    total = 0.0
    for index in range(len(sides)):
        share = (action[index] - nominal[index]) / sides[index][2]
        total += weights[index] * (share * share)
    return total
