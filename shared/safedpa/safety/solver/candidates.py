"""Candidate actions spread over their range, and the solution of the last full least-violation search.

A full search evaluates some seventy actions. It is needed in every tick while a robot stays in the boundary layer of
its margin, where no action satisfies every constraint. At 20 ticks a second each tick runs it. A robot with a shorter
period runs it as often, and in the ticks between reuses the action found, as long as no constraint is violated more
than before.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from math import inf
from typing import Final, Protocol, final

from safedpa.safety.solver.constraints import ActionCandidate, Plain
from safedpa.safety.solver.qp_scaling import Side, clip_to_bounds

__all__ = [
    "MAX_AGE",
    "STEP_SHARES",
    "HeldSolution",
    "action_grid",
    "grid_around",
]

_GRID_POINTS: Final = {1: 9, 2: 5, 3: 3}
"""Values per action by the number of actions, for a model that is not affine in the action."""
_MAX_GRID_ACTIONS: Final = 4
"""Largest number of actions for which all corners are evaluated; with more, 2^n is too many for one period."""
STEP_SHARES: Final = (0.24, 0.12, 0.06, 0.03, 0.015, 0.006)
"""Shares of an entry's range for a coordinate search. It is used where linearisation fails: on the plateau of a
saturated actuator, which hides the ridge beyond, and at kinks of h, such as zero speed."""


def action_grid(sides: tuple[Side, ...], *, affine: bool) -> list[tuple[float, ...]]:
    """An even grid of actions (actions,) with all corners of their range; empty for more than four actions.

    For an ``affine`` model only the corners: the predicted state between them follows by interpolation.
    """
    if len(sides) > _MAX_GRID_ACTIONS:
        return []
    points = 2 if affine else _GRID_POINTS.get(len(sides), 2)
    return list(product(*[_grid_values(low, high, width, points) for low, high, width in sides]))


def grid_around(sides: tuple[Side, ...], action: Sequence[float], share: float) -> list[tuple[float, ...]]:
    """``action`` with each entry moved down and up by this share of its range, clipped to the bounds."""
    neighbours: list[tuple[float, ...]] = []
    for index, (_, _, width) in enumerate(sides):
        for step in (-share * width, share * width):
            other = clip_to_bounds([*action[:index], action[index] + step, *action[index + 1 :]], sides)
            # At its bound a moved entry is clipped back to itself: it needs no second evaluation.
            if other[index] != action[index]:
                neighbours.append(other)
    return neighbours


def _grid_values(low: float, high: float, width: float, points: int) -> list[float]:
    # The last value is ``high`` itself: low + width may differ from it by rounding, and would then lie outside.
    return [*[low + width * index / (points - 1) for index in range(points - 1)], high]


MAX_AGE: Final = 0.05
"""Longest time [s] for which the action of one full search is used: one period at 20 Hz."""

_ROUNDING: Final = 1e-6
"""Relative tolerance of that time: periods such as 0.01 s are not exact in binary."""
_WORSE: Final = 0.01
"""Share by which a violation may have grown since the search, and the h of that row fallen."""


class _ConstraintEvaluator(Protocol):
    """What a held solution needs of ``Constraints``."""

    def evaluate(self, action: Plain) -> ActionCandidate:
        """The candidate of this action."""


@final
class HeldSolution:
    """The action of one robot's last full search; empty at first."""

    def __init__(self) -> None:
        self._solution: ActionCandidate | None = None
        self._seconds = self._last_tick = inf
        """Robot time of the search and of the last tick; infinity makes the first age negative: nothing is reused."""
        self.notice = ""
        """What the verdict says in addition to the violated barriers."""

    def store(self, solution: ActionCandidate, seconds: float, notice: str) -> None:
        """Stores the result of a search at ``seconds``."""
        self._solution, self._seconds, self._last_tick, self.notice = solution, seconds, seconds, notice

    def reuse_if_no_worse(
        self, constraints: _ConstraintEvaluator, sides: Sequence[Side], seconds: float
    ) -> ActionCandidate | None:
        """Evaluates the stored action now; None if a new search is due or the action has become worse.

        Due: the action would be used for longer than ``MAX_AGE`` by the next tick, or the clock was set back. Worse: it
        violates another constraint, violates one by 1 % more, lowers the h of such a row by 1 %, or leads to any h
        below 0. Each row is compared with itself, since residuals of different barriers have different units.
        """
        solution, age, step = self._solution, seconds - self._seconds, seconds - self._last_tick
        self._last_tick = seconds
        # Minus ``step``: the action stays in force until the next tick, which is expected after the same interval.
        if solution is None or not 0.0 < age <= (1.0 + _ROUNDING) * MAX_AGE - step:
            return None
        action = tuple(solution.action)
        # A filter with other bounds may be given this object after a change of settings.
        if len(action) != len(sides) or clip_to_bounds(action, tuple(sides)) != action:
            return None
        now = constraints.evaluate(action)
        return now if now.is_finite and now.min_h_next >= 0.0 and _no_worse(now, solution) else None


def _no_worse(now: ActionCandidate, then: ActionCandidate) -> bool:
    """Whether each row that is violated now was violated then, and by as much."""
    # Another scene has other rows: they cannot be compared, so a new search is due.
    if len(now.residual) != len(then.residual):
        return False
    for row in now.violated_rows:
        # Both residuals are negative: (1 + share) times the old one is the larger violation.
        if row not in then.violated_rows or now.residual[row] < (1.0 + _WORSE) * then.residual[row]:
            return False
        if now.h_next[row] < (1.0 - _WORSE) * then.h_next[row]:
            return False
    return True
