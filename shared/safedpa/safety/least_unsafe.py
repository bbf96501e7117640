"""What to do where no action keeps every condition, or some h is below 0 already: the least unsafe action.

    first    the largest attainable least h_i(x+) / scale_i,
    then     of the rows that this leaves free, the next least one, until all their conditions hold,
    last     the least change of the wish,

each within ``TOLERANCE`` of a scale, and never below 0 where 0 can be attained. The programs are linear, tangent at the
best action known, and are posed anew about their solution; what counts is the model's own prediction for it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from safedpa.safety.conditions import Conditions, Outcome
from safedpa.safety.highest import HighestProgram
from safedpa.safety.program_rows import within
from safedpa.safety.quadratic_program import QuadraticProgram
from safedpa.safety.tangent import Tangent

__all__ = ["TOLERANCE", "least_unsafe"]

Values = NDArray[np.float64]
Action = tuple[float, ...]

TOLERANCE: Final = 2e-3
"""Share of a barrier's scale that is given away for the next aim."""

_ROUNDS: Final = 4
_LEVELS: Final = 4
_TRUE: Final = 1e-6
"""Share of a scale to which a tangent has to foretell h for its optimum to be the optimum."""
_STEPS: Final = (0.5, 0.125)
"""Shares of the way to a solution that are tried where its end is no better."""


def least_unsafe(
    conditions: Conditions,
    program: QuadraticProgram,
    highest: HighestProgram,
    wish: Action,
    known: Sequence[Outcome],
    spread: Sequence[Outcome],
) -> Outcome:
    """The least unsafe outcome found.

    ``known`` are some that were computed already, one at least; ``spread`` those of actions all over their range: what
    the actions can change in h is taken from them. A tangent, which stands in where there are none, would say too much
    where an actuator saturates.
    """
    return _Lift(conditions, program, highest, wish, spread or known[:1]).run([*known, *spread])


@final
class _Lift:
    """One search. The scales stay as they are, so that heights can be compared."""

    def __init__(
        self,
        conditions: Conditions,
        program: QuadraticProgram,
        highest: HighestProgram,
        wish: Action,
        spread: Sequence[Outcome],
    ) -> None:
        self._conditions, self._program, self._highest, self._wish = conditions, program, highest, wish
        self._low, self._range = program.low, program.range
        self._safe = conditions.least_now >= 0.0
        if len(spread) > 1:
            reached = np.array([one.h_next for one in spread])
            self._scales = np.maximum(conditions.sizes, reached.max(axis=0) - reached.min(axis=0))
        else:
            conditions.linearised(spread[0]).all(len(spread[0].h_next))
            self._scales = np.array(conditions.scales)
        self._required = np.array(conditions.required)
        self._held = float((np.array(conditions.h_begin) / self._scales).min())
        """The least height now: what is given away for the next aim is not what the robot has, tick after tick."""

    def run(self, known: Sequence[Outcome]) -> Outcome:
        best = self._best(known[0], known[1:])
        for _ in range(_ROUNDS):
            if best.kept and self._safe:
                break
            about = best
            best, exact = self._improved(about)
            if exact or best is about or self._gain(about, best) < TOLERANCE:
                break
        return best

    def _improved(self, about: Outcome) -> tuple[Outcome, bool]:
        """A better outcome than ``about`` (or itself), and whether the tangent there foretold it."""
        tangent, best, exact = self._conditions.linearised(about), about, False
        for proposed, foretold in self._proposals(tangent, about):
            found = self._conditions.outcome(proposed)
            exact = bool(np.abs(self._height(found) - foretold).max() <= _TRUE)
            better = self._best(best, [found])
            if better is not found and not exact:
                better = self._best(better, [self._conditions.outcome(self._between(about, found, s)) for s in _STEPS])
            best = better
        return best, exact

    def _proposals(self, tangent: Tangent, about: Outcome) -> Iterable[tuple[Action, Values]]:
        """Actions with the heights that the tangent foretells: the highest one, then the nearest as high."""
        slopes = np.array(tangent.all(len(about.h_next))) * self._range / self._scales[:, np.newaxis]
        here = (np.array(about.action) - self._low) / self._range
        heights = self._height(about) - slopes @ here
        moved = np.abs(slopes).sum(axis=1) > 0.0
        if not moved.any():
            return
        found = self._levels(slopes, heights, moved)
        if found is None:
            return
        u, levels = found
        yield self._action(u), heights + slopes @ u
        A, b = (slopes / self._range)[moved], (levels - heights)[moved]
        solution = self._program.solve(A.tolist(), (b + A @ self._low).tolist(), self._wish)
        if solution.solved:
            action = within(solution.action, self._program.sides)
            yield action, heights + slopes @ ((np.array(action) - self._low) / self._range)

    def _levels(self, slopes: Values, heights: Values, moved: NDArray[np.bool_]) -> tuple[Values, Values] | None:
        """u (actions,), and the levels (rows,) that it holds: the highest, then the conditions."""
        wanted = self._required / self._scales
        levels, u = np.full(len(heights), np.nan), None
        levels[~moved] = -np.inf
        for _ in range(_LEVELS):
            free = np.isnan(levels)
            if not free.any():
                break
            which = moved & _matters(slopes, heights, levels)
            found = self._highest.solve(slopes[which], heights[which], levels[which])
            if found is None:
                break
            u = found
            reached = heights + slopes @ u
            least = reached[free].min()
            kept = self._lowered(least)
            levels[free & (reached <= least + TOLERANCE)] = kept
            free = np.isnan(levels)
            if (reached >= wanted)[free].all():
                break
        if u is None:
            return None
        reached = heights + slopes @ u
        free = np.isnan(levels)
        levels[free] = np.minimum(wanted, reached)[free]
        return u, levels

    def _best(self, best: Outcome, others: Iterable[Outcome]) -> Outcome:
        """The best: the highest, within the tolerance what breaks conditions least, then what is nearest the wish."""
        compared = [best, *others]
        if self._safe:  # what keeps all is no longer a question of less or more
            compared = [one for one in compared if one.kept] or compared
        heights = [float(self._height(one).min()) for one in compared]
        level = self._lowered(max(heights))
        good = [one for one, height in zip(compared, heights, strict=True) if height >= level]
        missing = [self._missing(one) for one in good]
        good = [one for one, short in zip(good, missing, strict=True) if short <= min(missing) + TOLERANCE]
        return min(good, key=lambda one: self._program.distance(one.action, self._wish))

    def _lowered(self, height: float) -> float:
        """The least that is as good as ``height``.

        Not below 0 nor below what there is now where that is reached, or missed by rounding alone.
        """
        if -_TRUE < height <= 0.0:
            return height
        lower = height - TOLERANCE if height < 0.0 else max(0.0, height - TOLERANCE)
        return max(lower, min(self._held, height))

    def _height(self, one: Outcome) -> Values:
        """(rows,) h_i(x+) / scale_i."""
        return np.asarray(np.array(one.h_next) / self._scales)

    def _gain(self, about: Outcome, best: Outcome) -> float:
        higher = float(self._height(best).min() - self._height(about).min())
        return max(higher, self._missing(about) - self._missing(best))

    def _missing(self, one: Outcome) -> float:
        """Sum over the rows of what their conditions miss, each as a share of its scale."""
        return float(np.maximum(0.0, -np.array(one.residual) / self._scales).sum())

    def _between(self, one: Outcome, other: Outcome, share: float) -> Action:
        return tuple([a + share * (b - a) for a, b in zip(one.action, other.action, strict=True)])

    def _action(self, u: Values) -> Action:
        return within((self._low + self._range * u).tolist(), self._program.sides)


def _matters(slopes: Values, heights: Values, levels: Values) -> NDArray[np.bool_]:
    """(rows,) which rows some u in [0, 1] makes the least free one, or takes below its level."""
    lowest = heights + np.minimum(slopes, 0.0).sum(axis=1)
    highest = heights + np.maximum(slopes, 0.0).sum(axis=1)
    free = np.isnan(levels)
    return np.asarray(lowest <= np.where(free, highest[free].min(), levels))
