"""Scaling and presolve of the quadratic program, and its solution for one or two actions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from safedpa.safety.solver.active_set_2d import QP2D, HardQP2D, SoftQP2D
from safedpa.safety.solver.solution import Solution

__all__ = [
    "ScaledRow",
    "Side",
    "clip_to_bounds",
    "presolve",
    "solve_hard",
    "solve_soft",
    "violable_rows",
    "weighted_distance",
]

ScaledRow = tuple[list[float], float, int, float]
"""Entries (actions,), limit, index and reach of a constraint: entries . u >= limit, the entries' sizes summing to 1.

The reach is what the actions can change in the constraint, in its own unit; entries and limit are divided by it.
"""

Side = tuple[float, float, float]
"""Lowest value, highest value and range of an action."""

_BEYOND: Final = 2.0
"""Cap of a scaled limit. No action reaches a limit above 1, so its exact value has no effect; a cap avoids overflow."""


def presolve(
    A: Sequence[Sequence[float]],
    b: Sequence[float],
    nominal: Sequence[float],
    sides: tuple[Side, ...],
    weights: Sequence[float],
) -> tuple[Solution | None, list[ScaledRow]]:
    """The minimiser for one or two actions if it is proven, and the ``violable_rows``; None: use a solver."""
    finite, rows = violable_rows(A, b, sides)
    # Not finite: no action is better than another, so the program is reported as not solved.
    if not finite:
        return Solution([side[0] for side in sides], [0.0] * len(b), False, "numbers not finite"), rows
    if not rows:
        return Solution(clip_to_bounds(nominal, sides), [0.0] * len(b), True, "not needed"), rows
    if len(sides) > 2:
        return None, rows
    # Hard constraints first: only if they contradict each other is slack paid for.
    action, slack = solve_hard(rows, nominal, sides, weights), [0.0] * len(b)
    if action is None:
        action = solve_soft(rows, nominal, sides, weights, slack)
    return None if action is None else Solution(action, slack, True, "solved"), rows


def violable_rows(
    A: Sequence[Sequence[float]], b: Sequence[float], sides: tuple[Side, ...]
) -> tuple[bool, list[ScaledRow]]:
    """Whether all numbers of A a >= b are finite, and the rows that some action within the bounds violates.

    Rows that no action changes are left out: the program has no influence on them. Raises ValueError if A and b have
    different lengths, or a row has not one entry for each action.
    """
    rows: list[ScaledRow] = []
    count, actions = len(b), len(sides)
    if len(A) != count:
        raise ValueError(f"the program has {len(A)} rows and {count} limits")
    for index in range(count):
        row = A[index]
        if len(row) != actions:
            raise ValueError(f"row {index} has {len(row)} entries for {actions} actions")
        scaled: list[float] = []
        limit: float = b[index]
        minimum, reach = 0.0, 0.0
        for column in range(actions):
            low, _, width = sides[column]
            entry: float = row[column]
            limit -= entry * low
            change = entry * width
            scaled.append(change)
            if change < 0.0:
                minimum += change
                reach -= change
            else:
                reach += change
        # One subtraction each finds NaN and infinity in any of the numbers summed.
        if limit - limit != 0.0 or reach - reach != 0.0:
            return False, rows
        # ``minimum`` is the least that the row takes over the unit box: above the limit no action violates it.
        if minimum < limit and reach > 0.0:
            inverse = 1.0 / reach
            if inverse - inverse != 0.0:  # reach is subnormal: dividing by it overflows
                continue
            for column in range(actions):
                scaled[column] *= inverse
            limit *= inverse
            rows.append((scaled, limit if limit < _BEYOND else _BEYOND, index, reach))
    return True, rows


def solve_hard(
    rows: Sequence[ScaledRow], nominal: Sequence[float], sides: tuple[Side, ...], weights: Sequence[float]
) -> list[float] | None:
    """The minimiser without slack for one or two actions; None if there is none, or it is not proven."""
    x, y, weight = _nominal_in_unit_square(nominal, sides, weights)
    problem = HardQP2D(x, y, weights[0], weight)
    _add_rows(problem, rows)
    return _action(problem.x, problem.y, sides) if problem.solve() else None


def solve_soft(
    rows: Sequence[ScaledRow],
    nominal: Sequence[float],
    sides: tuple[Side, ...],
    weights: Sequence[float],
    slack: list[float],
) -> list[float] | None:
    """The minimiser with slack for one or two actions; writes ``slack``; None if it is not proven."""
    x, y, weight = _nominal_in_unit_square(nominal, sides, weights)
    problem = SoftQP2D(x, y, weights[0], weight)
    _add_rows(problem, rows)
    if not problem.solve():
        return None
    x, y = problem.x, problem.y
    for index in range(len(rows)):
        row, limit, place, reach = rows[index]
        # Slack is recomputed from the action: what the solver paid for it differs by rounding.
        shortfall = limit - row[0] * x - (row[1] * y if len(row) > 1 else 0.0)
        slack[place] = reach * shortfall if shortfall > 0.0 else 0.0
    return _action(x, y, sides)


def _add_rows(problem: QP2D, rows: Sequence[ScaledRow]) -> None:
    for index in range(len(rows)):
        row, limit, _, _ = rows[index]
        problem.add(row[0], row[1] if len(row) > 1 else 0.0, limit)


def _nominal_in_unit_square(
    nominal: Sequence[float], sides: tuple[Side, ...], weights: Sequence[float]
) -> tuple[float, float, float]:
    """The nominal action in the unit square, and the second weight; a second action without effect is added to one."""
    low, _, width = sides[0]
    x: float = (nominal[0] - low) / width
    if len(sides) == 1:
        return x, 0.0, weights[0]
    low, _, width = sides[1]
    return x, (nominal[1] - low) / width, weights[1]


def _action(x: float, y: float, sides: tuple[Side, ...]) -> list[float]:
    """One or two actions from the unit square; at a bound exactly the bound."""
    low, high, width = sides[0]
    # low + width may differ from high by one rounding; an action at its limit must be the limit itself.
    action = [high if x == 1.0 else low + width * x]
    if len(sides) > 1:
        low, high, width = sides[1]
        action.append(high if y == 1.0 else low + width * y)
    return action


def clip_to_bounds(action: Sequence[float], sides: tuple[Side, ...]) -> tuple[float, ...]:
    """Clips each entry of an action (actions,) to its bounds."""
    clipped: list[float] = []
    for index in range(len(sides)):
        low, high, _ = sides[index]
        value: float = action[index]
        clipped.append(low if value < low else high if value > high else value)
    return tuple(clipped)


def weighted_distance(
    action: Sequence[float], nominal: Sequence[float], sides: tuple[Side, ...], weights: Sequence[float]
) -> float:
    """(action - nominal)' W (action - nominal), W = diag(weights / range^2)."""
    total = 0.0
    for index in range(len(sides)):
        share = (action[index] - nominal[index]) / sides[index][2]
        total += weights[index] * (share * share)
    return total
