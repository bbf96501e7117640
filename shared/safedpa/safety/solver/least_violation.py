"""The least-violation action: used if no action satisfies every constraint, or if some h is below 0 already.

A lexicographic max-min search:

    first    the largest attainable minimum of h_i(x+) / scale_i,
    then     the same over the rows that remain free, until all their constraints hold,
    last     the least change of the nominal action,

each within ``TOLERANCE`` of what the actions can change in h_i, and never below 0 if 0 can be attained. The programs
are linear, linearised about the best action known, and repeated from their solution; candidates are compared by the
model's own prediction.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, isfinite, isnan, nan
from typing import Final, Protocol, final

from safedpa.safety.errors import NotFiniteError
from safedpa.safety.solver.candidates import STEP_SHARES, grid_around
from safedpa.safety.solver.constraints import ActionCandidate, Constraints
from safedpa.safety.solver.linearization import Linearization
from safedpa.safety.solver.qp import QuadraticProgram
from safedpa.safety.solver.qp_scaling import Side, clip_to_bounds
from safedpa.safety.solver.sqp import DecisionError

__all__ = ["TOLERANCE", "least_violation"]

Action = tuple[float, ...]

TOLERANCE: Final = 2e-3
"""Share of what the actions can change in an h that the next objective may give up; the programs give up half."""

_ROUNDING: Final = 1e-12
"""Relative difference of h up to which a row counts as independent of the action."""
_MIN_TOLERANCE: Final = 5e-6
"""Share of the tolerance that is always given up: rounding would otherwise reject the nearest of equal actions."""
_MAX_ASCENTS: Final = 4
"""Linearisations of one ascent; drives need one or two, and a period has no time for many more."""
_MAX_LEVELS: Final = 4
"""Rounds of the lexicographic program: the later ones fix rows that are far from their constraints."""
_ACCURACY: Final = 1e-6
"""Share of a scale to which a linearisation must predict h for its optimum to be accepted as the optimum."""
_MIN_SAMPLES: Final = 5
"""Candidates, and at least the number of corners, from which the influence of the actions is measured; fewer would not
cover the range."""
_BACKTRACK_SHARES: Final = (0.5, 0.125)
"""Shares of the step to a solution that are tried if the whole step is no improvement."""


class _MaxMin(Protocol):
    """What the search needs of ``MaxMinProgram``."""

    def solve(
        self, gradients: Sequence[Sequence[float]], offsets: Sequence[float], levels: Sequence[float]
    ) -> list[float] | None:
        """u (actions,) that maximises the smallest free row."""


def least_violation(
    constraints: Constraints,
    program: QuadraticProgram,
    maximin_lp: _MaxMin,
    nominal: Action,
    backup: ActionCandidate,
    known: Sequence[ActionCandidate],
) -> tuple[ActionCandidate, tuple[str, ...]]:
    """Returns the least-violation candidate, and names of violated barriers that no action influences in one step.

    ``known`` are candidates computed before, spread over the action range: the influence of the actions on h is
    measured from them, since a linearisation exaggerates it where an actuator saturates. If a violated barrier does not
    depend on the action yet, the ``backup`` replaces the nominal action: it is known to be good beyond one step. Raises
    DecisionError if no action has a finite prediction.
    """
    finite = [one for one in (backup, *known) if one.is_finite]
    if not finite:
        raise DecisionError("the model or a barrier has no finite number for any action")
    lift = _LeastViolationSearch(constraints, program, maximin_lp, nominal, backup, finite)
    return lift.run(finite), lift.uncontrollable


@final
class _ScoredCandidate:
    """A candidate with its objectives, over the rows that actions influence."""

    def __init__(self, candidate: ActionCandidate, scaled_h: list[float], smallest: float, violation: float) -> None:
        self.candidate, self.scaled_h, self.level, self.violation = candidate, scaled_h, smallest, violation
        """``scaled_h``: h_i(x+) / scale_i, capped where more is no better; ``level``: their minimum, infinity without
        rows; ``violation``: the sum of all violations, each as a share of its scale."""


@final
class _LeastViolationSearch:
    """One search. The scales are fixed at its start, so that candidates remain comparable."""

    def __init__(
        self,
        constraints: Constraints,
        program: QuadraticProgram,
        maximin_lp: _MaxMin,
        nominal: Action,
        backup: ActionCandidate,
        finite: list[ActionCandidate],
    ) -> None:
        self._constraints, self._program, self._maximin_lp = constraints, program, maximin_lp
        self._sides: tuple[Side, ...] = program.sides
        self._safe: bool = constraints.min_h_now >= 0.0
        self._rows: list[int] = []
        """Rows that the actions influence; all lists below have one entry for each of them."""
        self._scales: list[float] = []
        self._tolerances: list[float] = []
        """What may be given up for the next objective, as a share of the scale."""
        self._targets: list[float] = []
        """Right-hand sides of the constraints, as a share of the scale."""
        self._max_tolerance = _ROUNDING
        self._fixed_level = inf
        """Smallest h_i(x+) / scale_i of the rows that no action influences."""
        self._level_now = inf
        """Smallest scaled h now."""
        uncontrollable = self._split_rows(finite[0], self._measured_reach(finite))
        names = constraints.barriers.names
        self.uncontrollable: tuple[str, ...] = tuple([names[row % len(names)] for row in uncontrollable])
        # Within one step nothing can be done about an uncontrollable row; the backup is safe over its whole horizon.
        self._nominal: Action = tuple(backup.action) if uncontrollable else nominal

    def _measured_reach(self, finite: list[ActionCandidate]) -> list[float]:
        """(rows,) what the actions change in h."""
        reach: list[float] = []
        for row in range(len(finite[0].h_next)):
            low, high = inf, -inf
            for one in finite:
                value = one.h_next[row]
                low = value if value < low else low
                high = value if value > high else high
            reach.append(high - low)
        if len(finite) >= max(_MIN_SAMPLES, 2 ** len(self._sides)):
            return reach
        # Too few samples to cover the range: the linearisation is an upper estimate, and the larger of both counts.
        rows = self._constraints.linearize(finite[0]).all(len(reach))
        for row in range(len(reach)):
            change = 0.0
            for column in range(len(self._sides)):
                change += abs(rows[row][column]) * self._sides[column][2]
            reach[row] = max(reach[row], change)
        return reach

    def _split_rows(self, one: ActionCandidate, reach: list[float]) -> list[int]:
        """Splits the rows by whether actions influence them; returns those without influence that are violated.

        Any candidate ``one`` shows what becomes of a row without influence.
        """
        constraints, uncontrollable = self._constraints, list[int]()
        base_scales, begin = constraints.base_scales, constraints.h_at_effect
        for row in range(len(reach)):
            size = max(base_scales[row], abs(one.h_next[row]))
            # Relative to the row's own size: an absolute threshold would depend on the unit of h.
            moved = reach[row] > _ROUNDING * size
            scale = max(base_scales[row], reach[row]) if moved else size
            tolerance = max(TOLERANCE * reach[row] / scale, _ROUNDING)
            self._max_tolerance = max(self._max_tolerance, tolerance)
            if moved:
                self._rows.append(row)
                self._scales.append(scale)
                self._tolerances.append(tolerance)
                self._targets.append(constraints.rhs[row] / scale)
                self._level_now = min(self._level_now, begin[row] / scale)
                continue
            self._fixed_level = min(self._fixed_level, one.h_next[row] / scale)
            if begin[row] < 0.0 or one.residual[row] < -_ROUNDING * scale:
                uncontrollable.append(row)
        return uncontrollable

    def run(self, known: list[ActionCandidate]) -> ActionCandidate:
        """The least-violation candidate of those known and found.

        If a row without influence is the minimum, the others need no more than their constraints. But if these cannot
        all be satisfied, their minimum is raised as if that row did not exist.
        """
        best = self._search([self._score(one) for one in known])
        if isfinite(self._fixed_level) and best.violation > _ACCURACY:
            self._fixed_level = inf
            best = self._search([self._score(one) for one in [best.candidate, *known]])
        return best.candidate

    # The inner loops below run some seventy times per search: plain comparisons, no calls of min() and max().
    def _score(self, one: ActionCandidate) -> _ScoredCandidate:
        h_next, residual, rows, scales, targets = one.h_next, one.residual, self._rows, self._scales, self._targets
        scaled_h: list[float] = []
        smallest, violation, fixed_level = inf, 0.0, self._fixed_level
        for index in range(len(rows)):
            row, scale, cap = rows[index], scales[index], targets[index]
            value, rest = h_next[row] / scale, residual[row]
            # More than its constraint, or than the fixed minimum, does not make a row any better.
            cap = fixed_level if fixed_level > cap else cap
            value = cap if value > cap else value
            scaled_h.append(value)
            smallest = value if value < smallest else smallest
            if rest < 0.0:
                violation -= rest / scale
        return _ScoredCandidate(one, scaled_h, smallest, violation)

    def _evaluate(self, action: Action) -> _ScoredCandidate:
        return self._score(self._constraints.evaluate(action))

    def _search(self, known: list[_ScoredCandidate]) -> _ScoredCandidate:
        # Ascent by linearisation first: it needs few evaluations, and for an affine model its result is exact.
        best, exact = self._ascend(self._select(known))
        if exact and self._constraints.affine:
            return best
        scored = self._coordinate_search(best)
        # Samples around it find a ridge that a saturated actuator hides from every linearisation.
        upper = self._max_level([best, *scored])
        if upper is not best and self._gain(best, upper) >= 1.0:
            scored.append(self._ascend(upper)[0])
        return self._select([best, *scored])

    def _ascend(self, best: _ScoredCandidate) -> tuple[_ScoredCandidate, bool]:
        """The best candidate by repeated linearisation, and whether the last linearisation predicted it."""
        exact = False
        for _ in range(_MAX_ASCENTS):
            if self._is_done(best):
                break
            about = best
            best, exact = self._improve(about)
            if exact or best is about or self._gain(about, best) < 1.0:
                break
        return best, exact

    def _is_done(self, one: _ScoredCandidate) -> bool:
        """Whether the candidate is feasible: then there is no violation left to minimise."""
        # With some h below 0 now the aim is to raise h, so a feasible candidate does not end the search.
        return self._safe and one.candidate.is_feasible

    def _coordinate_search(self, best: _ScoredCandidate) -> list[_ScoredCandidate]:
        """Candidates from coordinate steps of decreasing size, each from the best so far."""
        scored: list[_ScoredCandidate] = []
        for share in STEP_SHARES:
            if self._is_done(best):
                break
            neighbours = [self._evaluate(one) for one in grid_around(self._sides, best.candidate.action, share)]
            best = self._max_level([best, *neighbours])
            scored += neighbours
        return scored

    def _max_level(self, others: list[_ScoredCandidate]) -> _ScoredCandidate:
        """A feasible candidate; else the one with the largest level, then the least violation, then the first.

        No tolerance is given up for the nominal action yet: progress along a ridge begins with small steps.
        """
        finite = [one for one in others if one.candidate.is_finite]
        top = -inf
        for one in finite:
            if self._is_done(one):
                return one
            top = one.level if one.level > top else top
        high = [one for one in finite if one.level >= top - _ACCURACY]
        fewest = min([one.violation for one in high])
        return next(one for one in high if one.violation <= fewest + _ACCURACY)

    def _improve(self, about: _ScoredCandidate) -> tuple[_ScoredCandidate, bool]:
        """A better candidate than ``about`` (or itself), and whether the linearisation predicted it."""
        best, as_predicted, candidate = about, True, about.candidate
        try:
            linearization = self._constraints.linearize(candidate)
        except NotFiniteError:  # no derivatives there
            return about, False
        proposals = self._proposals(linearization, candidate)
        for proposed, scaled_h in proposals:
            found = self._evaluate(proposed)
            accurate = found.candidate.is_finite and self._prediction_error(scaled_h, found.candidate) <= _ACCURACY
            as_predicted = as_predicted and accurate
            better = self._select([best, found])
            # A wrong prediction with no gain: the direction may still be right, so shorter steps are tried.
            if better is not found and not accurate:
                between = [
                    self._evaluate(self._between(candidate, found.candidate, share)) for share in _BACKTRACK_SHARES
                ]
                better = self._select([better, *between])
            best = better
        return best, as_predicted and len(proposals) > 0

    def _prediction_error(self, scaled_h: list[float], found: ActionCandidate) -> float:
        """The largest difference between predicted and actual scaled h."""
        most = 0.0
        for index in range(len(scaled_h)):
            error = abs(found.h_next[self._rows[index]] / self._scales[index] - scaled_h[index])
            most = error if error > most else most
        return most

    def _proposals(self, linearization: Linearization, about: ActionCandidate) -> list[tuple[Action, list[float]]]:
        """Actions with their predicted scaled h: the max-min action, then the nearest one that reaches its levels."""
        gradients: list[list[float]] = []
        offsets: list[float] = []
        rows = linearization.all(len(about.h_next)) if self._rows else []
        for index in range(len(self._rows)):
            row, scale = self._rows[index], self._scales[index]
            gradient, offset = list[float](), about.h_next[row] / scale
            for column in range(len(self._sides)):
                low, _, width = self._sides[column]
                # In u of the unit box: all entries of the program then have the same order of magnitude.
                step = rows[row][column] * width / scale
                offset -= step * ((about.action[column] - low) / width)
                gradient.append(step)
            gradients.append(gradient)
            offsets.append(offset)
        u, levels = self._levels(gradients, offsets)
        if not u:
            return []
        action = [side[0] + side[2] * share for side, share in zip(self._sides, u, strict=True)]
        found = [(clip_to_bounds(action, self._sides), _linear_values(gradients, offsets, u))]
        nearest = self._nearest_at_levels(gradients, offsets, levels)
        if nearest is not None:
            shares = [(value - side[0]) / side[2] for side, value in zip(self._sides, nearest, strict=True)]
            found.append((nearest, _linear_values(gradients, offsets, shares)))
        return found

    def _nearest_at_levels(
        self, gradients: list[list[float]], offsets: list[float], levels: list[float]
    ) -> Action | None:
        """The action nearest to the nominal one that reaches the levels; None if the program fails."""
        A: list[list[float]] = []
        b: list[float] = []
        for index in range(len(gradients)):
            row, limit = list[float](), levels[index] - offsets[index]
            for column in range(len(self._sides)):
                low, _, width = self._sides[column]
                entry = gradients[index][column] / width
                row.append(entry)
                limit += entry * low
            A.append(row)
            b.append(limit)
        solution = self._program.solve(A, b, self._nominal)
        # Slack is not inspected: the clipped action is evaluated with the model and compared like any other.
        return clip_to_bounds(solution.action, self._sides) if solution.solved else None

    def _levels(self, gradients: list[list[float]], offsets: list[float]) -> tuple[list[float], list[float]]:
        """u (actions,) and the levels (rows,) to hold: the maximum first, then the constraints. Empty: none found."""
        count, targets, levels = len(offsets), self._targets, [nan] * len(offsets)
        floors, reached, u = list[float](), list[float](), list[float]()
        for _ in range(_MAX_LEVELS if count else 0):
            found = self._solve_maximin(gradients, offsets, levels)
            if not found:
                break
            u, reached = found, _linear_values(gradients, offsets, found)
            smallest = min([reached[index] for index in range(count) if isnan(levels[index])])
            # Above 0 a tolerance must not lead below 0; at or below 0 every row keeps its full tolerance.
            tolerances = self._tolerances if smallest <= 0.0 else [min(most, smallest) for most in self._tolerances]
            lowest = min(self._fixed_level, smallest)
            first = not floors
            if first:
                floors = [self._relax(lowest, 0.5 * most) for most in tolerances]
            left = False
            for index in range(count):
                if not isnan(levels[index]):
                    continue
                # Rows at the minimum are binding: they are fixed at their level, and the next round maximises the rest.
                if reached[index] <= smallest + 0.5 * tolerances[index]:
                    level = self._relax(smallest, 0.5 * tolerances[index])
                    # If another row is the minimum, the constraint itself is enough.
                    if not first or self._fixed_level <= smallest:
                        level = min(level, targets[index])
                    levels[index] = max(level, floors[index])
                elif reached[index] < targets[index]:
                    left = True
            if not left:
                break
        # Rows that were never binding need their constraint only, but no more than the last program attained.
        for index in range(count if floors else 0):
            if isnan(levels[index]):
                levels[index] = min(max(targets[index], floors[index]), reached[index])
        return u, levels

    def _solve_maximin(self, gradients: list[list[float]], offsets: list[float], levels: list[float]) -> list[float]:
        """u (actions,) that maximises the smallest free row; empty if the program fails."""
        # Rows that can never be the minimum are left out: with dozens of obstacles the program stays small.
        which = _relevant_rows(gradients, offsets, levels)
        found = self._maximin_lp.solve(
            [gradients[index] for index in which],
            [offsets[index] for index in which],
            [levels[index] for index in which],
        )
        return [] if found is None else found

    def _select(self, others: list[_ScoredCandidate]) -> _ScoredCandidate:
        """The largest level; within the tolerance the least violation, then the nearest to the nominal action."""
        compared = [one for one in others if one.candidate.is_finite]
        # From a safe state a feasible candidate always wins, whatever its level.
        if self._safe:
            compared = [one for one in compared if one.candidate.is_feasible] or compared
        top = max([one.level for one in compared])
        levels = [self._relax(top, tolerance) for tolerance in self._tolerances]
        good = [one for one in compared if _reach_levels(one.scaled_h, levels)]
        limit = min([one.violation for one in good]) + self._max_tolerance
        best, smallest = good[0], inf
        for one in good:
            if one.violation <= limit:
                away: float = self._program.distance(one.candidate.action, self._nominal)
                if away < smallest:
                    best, smallest = one, away
        return best

    def _gain(self, about: _ScoredCandidate, best: _ScoredCandidate) -> float:
        """The improvement, as a share of the tolerance."""
        higher, fewer = best.level - about.level, about.violation - best.violation
        return max(higher, fewer) / self._max_tolerance if isfinite(higher) else 0.0

    def _relax(self, value: float, tolerance: float) -> float:
        """The lowest level that counts as good as ``value``: not below the present level, nor below 0 if 0 is reached.

        Otherwise the tolerance would add up from one decision to the next. A shortfall by rounding counts as reached.
        """
        if -_ACCURACY < value <= 0.0:
            return value
        bound = min(value, self._level_now) - _MIN_TOLERANCE * tolerance
        lowered = value - tolerance
        if value >= 0.0 and lowered < 0.0:
            lowered = 0.0
        return max(lowered, bound)

    def _between(self, one: ActionCandidate, other: ActionCandidate, share: float) -> Action:
        return tuple([a + share * (b - a) for a, b in zip(one.action, other.action, strict=True)])


def _linear_values(gradients: list[list[float]], offsets: list[float], u: list[float]) -> list[float]:
    """(rows,) offset + gradient . u."""
    reached: list[float] = []
    for index in range(len(offsets)):
        gradient, value = gradients[index], offsets[index]
        for column in range(len(u)):
            value += gradient[column] * u[column]
        reached.append(value)
    return reached


def _reach_levels(scaled_h: list[float], levels: list[float]) -> bool:
    return not any(value < level for value, level in zip(scaled_h, levels, strict=True))


def _relevant_rows(gradients: list[list[float]], offsets: list[float], levels: list[float]) -> list[int]:
    """Indices of rows that some u in [0, 1] makes the smallest free one, or takes below their level (NaN: free)."""
    # Interval arithmetic: a row whose minimum exceeds the smallest maximum of all free rows is never the minimum.
    lowest, most = offsets.copy(), inf
    for index in range(len(offsets)):
        maximum = offsets[index]
        for entry in gradients[index]:
            if entry < 0.0:
                lowest[index] += entry
            else:
                maximum += entry
        if isnan(levels[index]) and maximum < most:
            most = maximum
    relevant: list[int] = []
    for index in range(len(offsets)):
        level = levels[index]
        if lowest[index] <= (most if isnan(level) else level):
            relevant.append(index)
    return relevant
