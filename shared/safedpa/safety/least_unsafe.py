"""What to do where no action keeps every condition, or some h is below 0 already: the least unsafe action.

    first    the largest attainable least h_i(x+) / scale_i,
    then     of the rows that this leaves free, the next least one, until all their conditions hold,
    last     the least change of the wish,

each within ``TOLERANCE`` of what the actions can change in h_i, and never below 0 where 0 can be attained. The programs
are linear, tangent at the best action known, and are posed anew about their solution; what counts is the model's own
prediction for it.
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
from safedpa.safety.search import DecisionError
from safedpa.safety.tangent import NotFiniteError, Tangent

__all__ = ["TOLERANCE", "least_unsafe"]

Values = NDArray[np.float64]
Action = tuple[float, ...]

TOLERANCE: Final = 2e-3
"""Share of what the actions can change in an h that is given away for the next aim; the programs give away half."""

_ROUNDING: Final = 1e-12
"""Share of a scale by which the h of two actions may differ that no action changes."""
_SLIGHT: Final = 1e-3
"""Share of what may be given away that always is: else rounding would refuse the nearest of all that are as high."""
_ROUNDS: Final = 4
_LEVELS: Final = 4
_TRUE: Final = 1e-6
"""Share of a scale to which a tangent has to foretell h for its optimum to be the optimum."""
_FEWEST: Final = 5
"""Outcomes from which what the actions can change is read; of fewer they are not all over their range."""
_STEPS: Final = (0.5, 0.125)
"""Shares of the way to a solution that are tried where its end is no better."""


def least_unsafe(
    conditions: Conditions,
    program: QuadraticProgram,
    highest: HighestProgram,
    wish: Action,
    backup: Outcome,
    known: Sequence[Outcome],
) -> tuple[Outcome, tuple[str, ...]]:
    """The least unsafe outcome found, and the barriers in question that no action moves within one step.

    ``known`` are some that were computed already, those of actions all over their range among them: what the actions
    can change in h is taken from them, since a tangent would say too much where an actuator saturates. Where a barrier
    that is not kept, or below 0 now, does not depend on the action yet, the ``backup`` stands in for the wish: it is
    what is known to be good beyond one step. Raises DecisionError where no action has a finite prediction.
    """
    usable = [one for one in (backup, *known) if one.usable]
    if not usable:
        raise DecisionError("the model or a barrier has no finite number for any action")
    lift = _Lift(conditions, program, highest, wish, backup, usable)
    return lift.run(usable), lift.stuck


@final
class _Lift:
    """One search. The scales stay as they are, so that heights can be compared."""

    def __init__(
        self,
        conditions: Conditions,
        program: QuadraticProgram,
        highest: HighestProgram,
        wish: Action,
        backup: Outcome,
        usable: Sequence[Outcome],
    ) -> None:
        self._conditions, self._program, self._highest = conditions, program, highest
        self._low, self._range = program.low, program.range
        self._safe = conditions.least_now >= 0.0
        self._required = np.array(conditions.required)
        reach = self._measured_reach(usable)
        sizes = np.maximum(conditions.sizes, np.abs(usable[0].h_next))
        self._moved = reach > _ROUNDING * sizes
        """(rows,) which h the actions change."""
        self._scales = np.where(self._moved, np.maximum(conditions.sizes, reach), sizes)
        self._given = np.maximum(TOLERANCE * reach / self._scales, _ROUNDING)
        self._decided = float((np.array(usable[0].h_next) / self._scales)[~self._moved].min(initial=np.inf))
        """Least h_i(x+) / scale_i of those that no action moves."""
        self._held = float((np.array(conditions.h_begin) / self._scales)[self._moved].min(initial=np.inf))
        """Least height now."""
        unkept = (np.array(conditions.h_begin) < 0.0) | (np.array(usable[0].residual) < -_ROUNDING * self._scales)
        stuck = unkept & ~self._moved
        names = conditions.barriers.names
        self.stuck: tuple[str, ...] = tuple([names[row % len(names)] for row in np.flatnonzero(stuck).tolist()])
        self._wish = tuple(backup.action) if self.stuck else wish

    def _measured_reach(self, usable: Sequence[Outcome]) -> Values:
        """(rows,) what the actions change in h."""
        reached = np.array([one.h_next for one in usable])
        reach = np.asarray(reached.max(axis=0) - reached.min(axis=0))
        if len(usable) >= _FEWEST:
            return reach
        rows = self._conditions.linearised(usable[0]).all(len(usable[0].h_next))
        return np.asarray(np.maximum(reach, np.abs(np.array(rows)) @ self._range))

    def run(self, known: Sequence[Outcome]) -> Outcome:
        """The least unsafe of what is known and found.

        Where another barrier is the least whatever is done, the others need no more than their conditions; but where
        these cannot all be kept either, the least of them is raised as if there were no other.
        """
        best = self._searched(known)
        if np.isfinite(self._decided) and self._missing(best) > _TRUE:
            self._decided = np.inf
            best = self._searched([best, *known])
        return best

    def _searched(self, known: Sequence[Outcome]) -> Outcome:
        best = self._best(known[0], known[1:])
        for _ in range(_ROUNDS):
            if best.kept and self._safe:
                break
            about = best
            best, exact = self._improved(about)
            if exact or best is about or self._gain(about, best) < 1.0:
                break
        return best

    def _improved(self, about: Outcome) -> tuple[Outcome, bool]:
        """A better outcome than ``about`` (or itself), and whether the tangent there foretold it."""
        best, foretells = about, []
        try:
            tangent = self._conditions.linearised(about)
        except NotFiniteError:  # no slopes there
            return about, False
        for proposed, foretold in self._proposals(tangent, about):
            found = self._conditions.outcome(proposed)
            true = found.usable and bool(np.abs(self._height(found) - foretold)[self._moved].max() <= _TRUE)
            foretells.append(true)
            better = self._best(best, [found])
            if better is not found and not true:
                between = [self._conditions.outcome(self._between(about, found, share)) for share in _STEPS]
                better = self._best(better, between)
            best = better
        return best, bool(foretells) and all(foretells)

    def _proposals(self, tangent: Tangent, about: Outcome) -> Iterable[tuple[Action, Values]]:
        """Actions with the heights that the tangent foretells: the highest one, then the nearest as high."""
        slopes = np.array(tangent.all(len(about.h_next))) * self._range / self._scales[:, np.newaxis]
        here = (np.array(about.action) - self._low) / self._range
        heights = self._height(about) - slopes @ here
        moved = self._moved & (np.abs(slopes).sum(axis=1) > 0.0)
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
        lowest, floor = self._decided, None
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
            least = float(reached[free].min())
            given = 0.5 * (np.minimum(self._given, least) if least > 0.0 else self._given)
            binding = free & (reached <= least + given)
            level = self._lowered(least, given)
            if floor is not None or lowest <= least:  # the least of all is another one: conditions are enough
                level = np.minimum(level, wanted)
            if floor is None:
                floor = self._lowered(min(lowest, least), given)
            levels[binding] = np.maximum(level, floor)[binding]
            free = np.isnan(levels)
            if (reached >= wanted)[free].all():
                break
        if u is None or floor is None:
            return None
        reached = heights + slopes @ u
        free = np.isnan(levels)
        levels[free] = np.minimum(np.maximum(wanted, floor), reached)[free]
        return u, levels

    def _best(self, best: Outcome, others: Iterable[Outcome]) -> Outcome:
        """The best: the highest, within the tolerance what breaks conditions least, then what is nearest the wish."""
        compared = [one for one in (best, *others) if one.usable]
        if self._safe:  # what keeps all is no longer a question of less or more
            compared = [one for one in compared if one.kept] or compared
        heights = [self._wanted_height(one) for one in compared]
        level = self._lowered(max([float(rows.min(initial=np.inf)) for rows in heights]), self._given[self._moved])
        good = [one for one, rows in zip(compared, heights, strict=True) if (rows >= level).all()]
        missing = [self._missing(one) for one in good]
        limit = min(missing) + float(self._given.max())
        good = [one for one, short in zip(good, missing, strict=True) if short <= limit]
        return min(good, key=lambda one: self._program.distance(one.action, self._wish))

    def _wanted_height(self, one: Outcome) -> Values:
        """(rows moved,) h_i(x+) / scale_i; above the least of the others only up to what is required."""
        enough = np.maximum(self._decided, self._required / self._scales)
        return np.asarray(np.minimum(self._height(one), enough)[self._moved])

    def _gain(self, about: Outcome, best: Outcome) -> float:
        """What was gained, as a share of what may be given away."""
        higher = self._wanted_height(best).min(initial=np.inf) - self._wanted_height(about).min(initial=np.inf)
        fewer = self._missing(about) - self._missing(best)
        return float(max(higher, fewer) / self._given.max()) if np.isfinite(higher) else 0.0

    def _lowered(self, height: float, given: Values) -> Values:
        """(rows,) the least as good as ``height``: not below what the robot has now, nor below 0 where that is reached.

        Else what is given away would add up from one decision to the next. Missed by rounding alone is reached.
        """
        if -_TRUE < height <= 0.0:
            return np.full(len(given), height)
        kept = min(height, self._held) - _SLIGHT * given
        return np.maximum(height - given if height < 0.0 else np.maximum(0.0, height - given), kept)

    def _height(self, one: Outcome) -> Values:
        """(rows,) h_i(x+) / scale_i."""
        return np.asarray(np.array(one.h_next) / self._scales)

    def _missing(self, one: Outcome) -> float:
        """Sum over the rows moved of what their conditions miss, each as a share of its scale."""
        return float(np.maximum(0.0, -np.array(one.residual) / self._scales)[self._moved].sum())

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
