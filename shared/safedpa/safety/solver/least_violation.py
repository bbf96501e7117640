"""What to do where no action satisfies every condition, or some h is below 0 already: the least-violation action.

    first    the largest attainable least h_i(x+) / scale_i,
    then     of the rows that this leaves free, the next least one, until all their conditions hold,
    last     the least change of the nominal action,

each within ``TOLERANCE`` of what the actions can change in h_i, and never below 0 where 0 can be attained. The programs
are linear, tangent at the best action known, and are posed again about their solution; what counts is the model's own
prediction for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, isfinite, isnan, nan
from typing import Final, Protocol, final

from safedpa.safety.errors import NotFiniteError
from safedpa.safety.solver.candidates import NEARBY, grid_around
from safedpa.safety.solver.constraints import ActionCandidate, Constraints
from safedpa.safety.solver.linearization import Linearization
from safedpa.safety.solver.qp import QuadraticProgram
from safedpa.safety.solver.qp_scaling import Side, within
from safedpa.safety.solver.sqp import DecisionError

__all__ = ["TOLERANCE", "least_violation"]

Action = tuple[float, ...]

TOLERANCE: Final = 2e-3
"""Share of what the actions can change in an h that is given away for the next aim; the programs give away half."""

_ROUNDING: Final = 1e-12
"""Share of a scale by which the h of two actions may differ that no action changes."""
_SLIGHT: Final = 5e-6
"""Share of what may be given away that always is: else rounding would refuse the nearest of all that are as high."""
_ROUNDS: Final = 4
_LEVELS: Final = 4
_TRUE: Final = 1e-6
"""Share of a scale to which a tangent has to foretell h for its optimum to be the optimum."""
_FEWEST: Final = 5
"""Outcomes from which what the actions can change is read, and no fewer than there are corners of their range: fewer
are not all over it."""
_STEPS: Final = (0.5, 0.125)
"""Shares of the way to a solution that are tried where its end is no better."""


class _MaxMin(Protocol):
    """What is needed of ``HighestProgram``."""

    def solve(
        self, slopes: Sequence[Sequence[float]], heights: Sequence[float], levels: Sequence[float]
    ) -> list[float] | None:
        """u (actions,) with the least free row as high as it can be."""


def least_violation(
    conditions: Constraints,
    program: QuadraticProgram,
    highest: _MaxMin,
    nominal: Action,
    backup: ActionCandidate,
    known: Sequence[ActionCandidate],
) -> tuple[ActionCandidate, tuple[str, ...]]:
    """The least-violation outcome found, and the barriers in question that no action moves within one step.

    ``known`` are some that were computed already, those of actions all over their range among them: what the actions
    can change in h is taken from them, since a tangent would say too much where an actuator saturates. Where a barrier
    that is not kept, or below 0 now, does not depend on the action yet, the ``backup`` stands in for the nominal action: it is
    what is known to be good beyond one step. Raises DecisionError where no action has a finite prediction.
    """
    usable = [one for one in (backup, *known) if one.usable]
    if not usable:
        raise DecisionError("the model or a barrier has no finite number for any action")
    lift = _Lift(conditions, program, highest, nominal, backup, usable)
    return lift.run(usable), lift.stuck


@final
class _CandidateLog:
    """An outcome as it is compared with others, over the rows that actions move."""

    def __init__(self, outcome: ActionCandidate, heights: list[float], least: float, missing: float) -> None:
        self.outcome, self.heights, self.least, self.missing = outcome, heights, least, missing
        """``heights``: h_i(x+) / scale_i, no more than what is enough; the ``least`` of them, infinity if there is
        none; ``missing``: the sum of what conditions miss, each as a share of its scale."""


@final
class _Lift:
    """One search. The scales stay as they are, so that heights can be compared."""

    def __init__(
        self,
        conditions: Constraints,
        program: QuadraticProgram,
        highest: _MaxMin,
        nominal: Action,
        backup: ActionCandidate,
        usable: list[ActionCandidate],
    ) -> None:
        self._conditions, self._program, self._highest = conditions, program, highest
        self._sides: tuple[Side, ...] = program.sides
        self._safe: bool = conditions.least_now >= 0.0
        self._rows: list[int] = []
        """Those that the actions move; what follows is of them alone."""
        self._scales: list[float] = []
        self._given: list[float] = []
        """What may be given away for the next aim, as a share of the scale."""
        self._wanted: list[float] = []
        """What the conditions require, as a share of the scale."""
        self._most_given = _ROUNDING
        self._decided = inf
        """Least h_i(x+) / scale_i of the rows that no action moves."""
        self._held = inf
        """Least height now."""
        stuck = self._divided(usable[0], self._measured_reach(usable))
        names = conditions.barriers.names
        self.stuck: tuple[str, ...] = tuple([names[row % len(names)] for row in stuck])
        self._nominal: Action = tuple(backup.action) if stuck else nominal

    def _measured_reach(self, usable: list[ActionCandidate]) -> list[float]:
        """(rows,) what the actions change in h."""
        reach: list[float] = []
        for row in range(len(usable[0].h_next)):
            low, high = inf, -inf
            for one in usable:
                height = one.h_next[row]
                low = height if height < low else low
                high = height if height > high else high
            reach.append(high - low)
        if len(usable) >= max(_FEWEST, 2 ** len(self._sides)):
            return reach
        tangents = self._conditions.linearised(usable[0]).all(len(reach))
        for row in range(len(reach)):
            change = 0.0
            for column in range(len(self._sides)):
                change += abs(tangents[row][column]) * self._sides[column][2]
            reach[row] = max(reach[row], change)
        return reach

    def _divided(self, one: ActionCandidate, reach: list[float]) -> list[int]:
        """Divides the rows into those that actions move and the others; which of these are not well, whatever is done.

        ``one`` outcome, all the same which, tells of a row that no action moves what becomes of it.
        """
        conditions, stuck = self._conditions, list[int]()
        sizes, begin = conditions.sizes, conditions.h_begin
        for row in range(len(reach)):
            size = max(sizes[row], abs(one.h_next[row]))
            moved = reach[row] > _ROUNDING * size
            scale = max(sizes[row], reach[row]) if moved else size
            given = max(TOLERANCE * reach[row] / scale, _ROUNDING)
            self._most_given = max(self._most_given, given)
            if moved:
                self._rows.append(row)
                self._scales.append(scale)
                self._given.append(given)
                self._wanted.append(conditions.required[row] / scale)
                self._held = min(self._held, begin[row] / scale)
                continue
            self._decided = min(self._decided, one.h_next[row] / scale)
            if begin[row] < 0.0 or one.residual[row] < -_ROUNDING * scale:
                stuck.append(row)
        return stuck

    def run(self, known: list[ActionCandidate]) -> ActionCandidate:
        """The least-violation of what is known and found.

        Where another barrier is the least whatever is done, the others need no more than their conditions; but where
        these cannot all be kept either, the least of them is raised as if there were no other.
        """
        best = self._searched([self._seen(one) for one in known])
        if isfinite(self._decided) and best.missing > _TRUE:
            self._decided = inf
            best = self._searched([self._seen(one) for one in [best.outcome, *known]])
        return best.outcome

    def _seen(self, one: ActionCandidate) -> _CandidateLog:
        h_next, residual, rows, scales, wanted = one.h_next, one.residual, self._rows, self._scales, self._wanted
        heights: list[float] = []
        least, missing, decided = inf, 0.0, self._decided
        for place in range(len(rows)):
            row, scale, enough = rows[place], scales[place], wanted[place]
            height, rest = h_next[row] / scale, residual[row]
            enough = decided if decided > enough else enough  # above it a row is no better
            height = enough if height > enough else height
            heights.append(height)
            least = height if height < least else least
            if rest < 0.0:
                missing -= rest / scale
        return _CandidateLog(one, heights, least, missing)

    def _tried(self, action: Action) -> _CandidateLog:
        return self._seen(self._conditions.outcome(action))

    def _searched(self, known: list[_CandidateLog]) -> _CandidateLog:
        best, exact = self._climbed(self._best(known))
        if exact and self._conditions.affine:
            return best
        seen = self._aside(best)
        upper = self._uppermost([best, *seen])
        if upper is not best and self._gain(best, upper) >= 1.0:
            seen.append(self._climbed(upper)[0])
        return self._best([best, *seen])

    def _climbed(self, best: _CandidateLog) -> tuple[_CandidateLog, bool]:
        """The best that tangents lead to from there, and whether the last one predicted it."""
        exact = False
        for _ in range(_ROUNDS):
            if self._enough(best):
                break
            about = best
            best, exact = self._improved(about)
            if exact or best is about or self._gain(about, best) < 1.0:
                break
        return best, exact

    def _enough(self, one: _CandidateLog) -> bool:
        """What keeps all is no longer a question of less or more."""
        return self._safe and one.outcome.kept

    def _aside(self, best: _CandidateLog) -> list[_CandidateLog]:
        """What moving one entry at a time leads to, by less and less, each time from the uppermost so far."""
        seen: list[_CandidateLog] = []
        for share in NEARBY:
            if self._enough(best):
                break
            tried = [self._tried(one) for one in grid_around(self._sides, best.outcome.action, share)]
            best = self._uppermost([best, *tried])
            seen += tried
        return seen

    def _uppermost(self, others: list[_CandidateLog]) -> _CandidateLog:
        """One that keeps all; else the highest, of equals what breaks conditions least, of equals the first.

        Nothing is given away for the nominal action yet, since a way that leads somewhere begins with little steps.
        """
        usable = [one for one in others if one.outcome.usable]
        top = -inf
        for one in usable:
            if self._enough(one):
                return one
            top = one.least if one.least > top else top
        high = [one for one in usable if one.least >= top - _TRUE]
        fewest = min([one.missing for one in high])
        return next(one for one in high if one.missing <= fewest + _TRUE)

    def _improved(self, about: _CandidateLog) -> tuple[_CandidateLog, bool]:
        """A better outcome than ``about`` (or itself), and whether the tangent there predicted it."""
        best, as_predicted, outcome = about, True, about.outcome
        try:
            tangent = self._conditions.linearised(outcome)
        except NotFiniteError:  # no slopes there
            return about, False
        proposals = self._proposals(tangent, outcome)
        for proposed, heights in proposals:
            found = self._tried(proposed)
            true = found.outcome.usable and self._furthest_from(heights, found.outcome) <= _TRUE
            as_predicted = as_predicted and true
            better = self._best([best, found])
            if better is not found and not true:
                between = [self._tried(self._between(outcome, found.outcome, share)) for share in _STEPS]
                better = self._best([better, *between])
            best = better
        return best, as_predicted and len(proposals) > 0

    def _furthest_from(self, heights: list[float], found: ActionCandidate) -> float:
        """By how much a height is another than predicted, at the most."""
        most = 0.0
        for place in range(len(heights)):
            error = abs(found.h_next[self._rows[place]] / self._scales[place] - heights[place])
            most = error if error > most else most
        return most

    def _proposals(self, tangent: Linearization, about: ActionCandidate) -> list[tuple[Action, list[float]]]:
        """Actions with the heights that the tangent foretells: the highest one, then the nearest as high."""
        slopes: list[list[float]] = []
        bases: list[float] = []
        rows = tangent.all(len(about.h_next)) if self._rows else []
        for place in range(len(self._rows)):
            row, scale = self._rows[place], self._scales[place]
            slope, base = list[float](), about.h_next[row] / scale
            for column in range(len(self._sides)):
                low, _, width = self._sides[column]
                step = rows[row][column] * width / scale
                base -= step * ((about.action[column] - low) / width)
                slope.append(step)
            slopes.append(slope)
            bases.append(base)
        u, levels = self._levels(slopes, bases)
        if not u:
            return []
        action = [side[0] + side[2] * share for side, share in zip(self._sides, u, strict=True)]
        found = [(within(action, self._sides), _reached(slopes, bases, u))]
        nearest = self._nearest(slopes, bases, levels)
        if nearest is not None:
            shares = [(value - side[0]) / side[2] for side, value in zip(self._sides, nearest, strict=True)]
            found.append((nearest, _reached(slopes, bases, shares)))
        return found

    def _nearest(self, slopes: list[list[float]], bases: list[float], levels: list[float]) -> Action | None:
        """The action nearest to the nominal action that holds the levels; None where the program gives up."""
        A: list[list[float]] = []
        b: list[float] = []
        for place in range(len(slopes)):
            row, limit = list[float](), levels[place] - bases[place]
            for column in range(len(self._sides)):
                low, _, width = self._sides[column]
                entry = slopes[place][column] / width
                row.append(entry)
                limit += entry * low
            A.append(row)
            b.append(limit)
        solution = self._program.solve(A, b, self._nominal)
        return within(solution.action, self._sides) if solution.solved else None

    def _levels(self, slopes: list[list[float]], bases: list[float]) -> tuple[list[float], list[float]]:
        """u (actions,), and the levels (rows,) that it holds: the highest, then the conditions. Empty: none found."""
        count, wanted, levels = len(bases), self._wanted, [nan] * len(bases)
        floors, reached, u = list[float](), list[float](), list[float]()
        for _ in range(_LEVELS if count else 0):
            found = self._raised(slopes, bases, levels)
            if not found:
                break
            u, reached = found, _reached(slopes, bases, found)
            least = min([reached[place] for place in range(count) if isnan(levels[place])])
            given = self._given if least <= 0.0 else [min(most, least) for most in self._given]
            lowest = min(self._decided, least)
            first = not floors
            if first:
                floors = [self._lowered(lowest, 0.5 * most) for most in given]
            left = False
            for place in range(count):
                if not isnan(levels[place]):
                    continue
                if reached[place] <= least + 0.5 * given[place]:
                    level = self._lowered(least, 0.5 * given[place])
                    if not first or self._decided <= least:  # the least of all is another: conditions are enough
                        level = min(level, wanted[place])
                    levels[place] = max(level, floors[place])
                elif reached[place] < wanted[place]:
                    left = True
            if not left:
                break
        for place in range(count if floors else 0):
            if isnan(levels[place]):
                levels[place] = min(max(wanted[place], floors[place]), reached[place])
        return u, levels

    def _raised(self, slopes: list[list[float]], bases: list[float], levels: list[float]) -> list[float]:
        """u (actions,) with the least of the free rows as high as it can be; empty where the program gives up."""
        which = _matters(slopes, bases, levels)
        found = self._highest.solve(
            [slopes[place] for place in which], [bases[place] for place in which], [levels[place] for place in which]
        )
        return [] if found is None else found

    def _best(self, others: list[_CandidateLog]) -> _CandidateLog:
        """The best: the highest, within the tolerance what breaks conditions least, then what is nearest the nominal action."""
        compared = [one for one in others if one.outcome.usable]
        if self._safe:
            compared = [one for one in compared if one.outcome.kept] or compared
        top = max([one.least for one in compared])
        levels = [self._lowered(top, given) for given in self._given]
        good = [one for one in compared if _reaches(one.heights, levels)]
        limit = min([one.missing for one in good]) + self._most_given
        best, least = good[0], inf
        for one in good:
            if one.missing <= limit:
                away: float = self._program.distance(one.outcome.action, self._nominal)
                if away < least:
                    best, least = one, away
        return best

    def _gain(self, about: _CandidateLog, best: _CandidateLog) -> float:
        """What was gained, as a share of what may be given away."""
        higher, fewer = best.least - about.least, about.missing - best.missing
        return max(higher, fewer) / self._most_given if isfinite(higher) else 0.0

    def _lowered(self, height: float, given: float) -> float:
        """The least as good as ``height``: not below what the robot has now, nor below 0 where that is reached.

        Else what is given away would add up from one decision to the next. Missed by rounding alone is reached.
        """
        if -_TRUE < height <= 0.0:
            return height
        kept = min(height, self._held) - _SLIGHT * given
        lowered = height - given
        if height >= 0.0 and lowered < 0.0:
            lowered = 0.0
        return max(lowered, kept)

    def _between(self, one: ActionCandidate, other: ActionCandidate, share: float) -> Action:
        return tuple([a + share * (b - a) for a, b in zip(one.action, other.action, strict=True)])


def _reached(slopes: list[list[float]], bases: list[float], u: list[float]) -> list[float]:
    """(rows,) base + slope . u."""
    reached: list[float] = []
    for place in range(len(bases)):
        slope, height = slopes[place], bases[place]
        for column in range(len(u)):
            height += slope[column] * u[column]
        reached.append(height)
    return reached


def _reaches(heights: list[float], levels: list[float]) -> bool:
    for place in range(len(levels)):  # noqa: SIM110 - a generator costs more when compiled
        if heights[place] < levels[place]:
            return False
    return True


def _matters(slopes: list[list[float]], bases: list[float], levels: list[float]) -> list[int]:
    """Places of the rows that some u in [0, 1] makes the least free one, or takes below their level (NaN: free)."""
    lowest, most = bases.copy(), inf
    for place in range(len(bases)):
        highest = bases[place]
        for slope in slopes[place]:
            if slope < 0.0:
                lowest[place] += slope
            else:
                highest += slope
        if isnan(levels[place]) and highest < most:
            most = highest
    matters: list[int] = []
    for place in range(len(bases)):
        level = levels[place]
        if lowest[place] <= (most if isnan(level) else level):
            matters.append(place)
    return matters
