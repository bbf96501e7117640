"""Sequential quadratic programming (SQP): the feasible action nearest to the nominal action.

``solve_sqp`` solves the QP of the linearised constraints, evaluates its solution with the model, and linearises again.
``line_search`` and ``backtrack_towards`` move a feasible action back towards the nominal one: where an actuator
saturates or h is curved, a tangent overestimates how far the action has to go.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Protocol

from safedpa.safety.errors import NotFiniteError
from safedpa.safety.solver.constraints import ActionCandidate, Plain
from safedpa.safety.solver.qp_scaling import Side, clip_to_bounds
from safedpa.safety.solver.solution import Solution

__all__ = [
    "DOUBTFUL",
    "FAR",
    "NEEDLESS",
    "SAME",
    "SERVED_WELL",
    "STEP",
    "DecisionError",
    "backtrack_towards",
    "line_search",
    "solve_sqp",
    "tighten",
]

SAME: Final = 1e-8
"""Share of an action's range within which two solutions count as equal; the solver's accuracy is 1e-9."""


SERVED_WELL: Final = 0.1
"""If the violation falls below this share of the last one, the same linearisation is used again."""


MOST_LEFT: Final = 0.75
"""Largest share of the violation that a solution is assumed to leave; it keeps r / (1 - r) bounded."""


NEEDLESS: Final = 0.05
"""If every constraint holds by more than this share of its scale, the linearisation pushed the action too far."""


OVERSHOOT: Final = 0.25
"""Share of the last violation that the next program asks for on top; it grows with every iteration."""


TRIES: Final = 4
"""Number of actions that a line search evaluates."""


LEFT: Final = 0.9
"""Share of the predicted feasible interval that a line search takes, so that it ends on the feasible side."""


DOUBTFUL: Final = 0.02
"""A distant solution with more than this share of its scale to spare may lie on a plateau where an actuator saturates;
a nearer action may then satisfy the constraints as well."""


FAR: Final = 0.1
"""Weighted share of the actions' ranges beyond which a solution counts as distant."""


NEAR: Final = 0.01
"""Share of the interval below which a line search stops."""


AGAIN: Final = 1
"""Rounds of the program after a line search."""


class DecisionError(Exception):
    """No decision can be computed; the text says why, ``solver`` is the solver's status."""

    def __init__(self, reason: str, solver: str = "not run") -> None:
        super().__init__(reason)
        self.solver = solver


class _Linearized(Protocol):
    """What the search needs of a ``Linearization``."""

    def at(self, residual: Plain, action: Plain, overshoot: float) -> tuple[list[list[float]], list[float]]:
        """A and b of A a >= b."""


class _ConstraintEvaluator(Protocol):
    """What the search needs of ``Constraints``."""

    @property
    def saturated(self) -> bool:
        """Whether some column of g is a chord because the actuator saturates there."""

    def evaluate(self, action: Plain) -> ActionCandidate:
        """The candidate of this action."""

    def linearize(self, about: ActionCandidate) -> _Linearized:
        """The constraints linearised about it."""

    def min_scaled_residual(self, found: ActionCandidate) -> float:
        """Its smallest residual as a share of the barrier's scale."""


class _Program(Protocol):
    """What the search needs of a ``QuadraticProgram``."""

    @property
    def sides(self) -> tuple[Side, ...]:
        """Of each action."""

    def solve(self, A: Sequence[Plain], b: Plain, nominal: Plain) -> Solution:
        """The minimiser."""

    def distance(self, action: Plain, nominal: Plain) -> float:
        """Between two actions."""


def solve_sqp(
    constraints: _ConstraintEvaluator, program: _Program, nominal: Plain, start: ActionCandidate, rounds: int
) -> tuple[ActionCandidate, str]:
    """Returns the best candidate found and the solver's status.

    Best: feasible and nearest to the nominal action; if none is feasible, the one with the largest scaled residual.
    Starts with the linearisation at ``start`` and solves the program at most ``rounds`` times, each time with the true
    residual at the last solution, and with a new linearisation unless the old one predicted well (computing it takes
    most of the time). Stops if all constraints hold without excess, if a solution repeats, or if the solver fails. If
    all hold with excess, a line search moves towards the nominal action and the program is solved again from there: at
    the nearest action some constraint binds.
    """
    # Everything below only moves a feasible result nearer to the nominal action.
    best, before, status = _iterate(constraints, program, nominal, start, rounds)
    # An infeasible result is returned as it is; the caller decides between another start and least violation.
    if not best.is_feasible:
        return best, status
    room = constraints.min_scaled_residual(best)
    if room > NEEDLESS:
        nearer = line_search(constraints, constraints.evaluate(clip_to_bounds(nominal, program.sides)), best)
    # On a plateau of a saturated actuator most of the change may be in an entry that has no effect: undo that one
    # first.
    elif (room > DOUBTFUL or constraints.saturated) and program.distance(best.action, nominal) > FAR * FAR:
        back = _undo_largest_change(program, clip_to_bounds(nominal, program.sides), best.action)
        nearer = line_search(constraints, constraints.evaluate(back), best)
    # A jump from infeasible to distant feasible: the boundary lies between the last two iterates.
    elif before is not start and not before.is_feasible and program.distance(best.action, before.action) > FAR * FAR:
        return line_search(constraints, before, best), status
    else:
        return best, status
    if nearer is best:
        return best, status
    # From the boundary one linearisation is accurate enough to slide along it.
    again, _, _ = _iterate(constraints, program, nominal, nearer, AGAIN)
    return _pick_better(constraints, program, nominal, nearer, again), status


def line_search(constraints: _ConstraintEvaluator, last: ActionCandidate, feasible: ActionCandidate) -> ActionCandidate:
    """Returns the feasible action furthest from ``feasible`` towards ``last``.

    Each residual is assumed linear between the last feasible and the last infeasible action (regula falsi).
    """
    if last.is_feasible:
        return last
    end, safe, low, high = last.action, feasible, 0.0, 1.0
    for _ in range(TRIES):
        allowed = (high - low) * _feasible_share(safe, last)
        # What is left to gain is not worth another evaluation of model and barriers.
        if allowed <= NEAR:
            break
        # Aim short of the predicted boundary, to land on the feasible side although no residual is exactly linear.
        share = low + LEFT * allowed
        between = [feasible.action[index] + share * (end[index] - feasible.action[index]) for index in range(len(end))]
        trial = constraints.evaluate(between)
        if trial.is_feasible:
            safe, low = trial, share
        else:
            last, high = trial, share
    return safe


def _feasible_share(feasible: ActionCandidate, infeasible: ActionCandidate) -> float:
    """Share of the interval on which no residual falls below 0, if the residuals are linear on it."""
    # Without finite residuals there is nothing to interpolate: bisect.
    if not infeasible.is_finite:
        return 0.5
    share = 1.0
    for row in range(len(feasible.residual)):
        here, there = feasible.residual[row], infeasible.residual[row]
        if there < 0.0:
            room = here / (here - there) if here > 0.0 else 0.0
            share = room if room < share else share
    return share


def _undo_largest_change(program: _Program, target: Plain, found: Plain) -> list[float]:
    """``found`` with its most expensive entry replaced by that of ``target``."""
    most, entry = -1.0, 0
    for index in range(len(found)):
        other = list(found)
        other[index] = target[index]
        cost = program.distance(other, found)
        if cost > most:
            most, entry = cost, index
    back = list(found)
    back[entry] = target[entry]
    return back


def _iterate(
    constraints: _ConstraintEvaluator, program: _Program, nominal: Plain, start: ActionCandidate, rounds: int
) -> tuple[ActionCandidate, ActionCandidate, str]:
    """Returns the best candidate, the one before the last, and the solver's status."""
    best, before, about, status = start, start, start, "not run"
    tangent = _linearize_or_none(constraints, start)
    fresh, shortfall, overshoot = True, _shortfall(constraints.min_scaled_residual(start)), 0.0
    for index in range(rounds):
        if tangent is None:
            break
        A, b = tangent.at(about.residual, about.action, overshoot)
        solution = program.solve(A, b, nominal)
        status = solution.status
        action = _usable_action(solution, program)
        if action is None:
            break
        before, about = about, constraints.evaluate(action)
        # The start is compared from the second round on only: the first solution replaces an infeasible start in any
        # case.
        best = about if index == 0 else _pick_better(constraints, program, nominal, best, about)
        min_residual = constraints.min_scaled_residual(about)
        if about.is_feasible and min_residual <= NEEDLESS:
            break
        # The linearisation there misled: the best candidate is as good a point to continue from.
        if best.is_feasible and not about.is_feasible:
            break
        # With a new linearisation at the same point the next solution would be the same again.
        if fresh and _is_repeated(program, about, before):
            break
        last, shortfall = shortfall, _shortfall(min_residual)
        fresh = not 0.0 < shortfall < SERVED_WELL * last
        overshoot = tighten(index + 1, last, shortfall)
        if fresh and index + 1 < rounds:
            tangent = _linearize_or_none(constraints, about)
    return best, before, status


def _linearize_or_none(constraints: _ConstraintEvaluator, about: ActionCandidate) -> _Linearized | None:
    """None if model or barrier have no finite values there, or no finite derivatives."""
    try:
        return constraints.linearize(about) if about.is_finite else None
    except NotFiniteError:
        return None


def tighten(solutions: int, last: float, shortfall: float) -> float:
    """Share of the violation to request on top: more with every iteration, and more if the last one gained little.

    A linearisation that left the share r of the violation will leave it again; r / (1 - r) on top compensates for that.
    """
    more = OVERSHOOT * solutions
    # 25 % more than the estimate: r itself is uncertain, and too little would take another iteration.
    left = min(shortfall / last, MOST_LEFT) if last > 0.0 else 0.0
    return max(more, 1.25 * left / (1.0 - left))


def _shortfall(min_residual: float) -> float:
    return -min_residual if min_residual < 0.0 else 0.0


def _is_repeated(program: _Program, one: ActionCandidate, other: ActionCandidate) -> bool:
    sides, here, there = program.sides, one.action, other.action
    for index in range(len(sides)):
        change: float = here[index] - there[index]
        if not abs(change) <= SAME * sides[index][2]:
            return False
    return True


def _pick_better(
    constraints: _ConstraintEvaluator, program: _Program, nominal: Plain, one: ActionCandidate, other: ActionCandidate
) -> ActionCandidate:
    if one.is_feasible and other.is_feasible:
        return other if program.distance(other.action, nominal) < program.distance(one.action, nominal) else one
    if one.is_feasible or other.is_feasible:
        return one if one.is_feasible else other
    return other if constraints.min_scaled_residual(other) > constraints.min_scaled_residual(one) else one


def _usable_action(solution: Solution, program: _Program) -> tuple[float, ...] | None:
    """The solution clipped to the bounds; None if the solver failed or returned NaN.

    How far the solution exceeds the bounds is irrelevant: the clipped action is evaluated with the model.
    """
    if not solution.solved:
        return None
    # x - x is 0 for finite x and NaN otherwise.
    for value in solution.action:
        if value - value != 0.0:
            return None
    return clip_to_bounds(solution.action, program.sides)


STEP: Final = 0.1
"""Share of its range by which an entry must come nearer to be worth an evaluation; closer entries stay as they are."""

_HALVINGS: Final = 5
"""Bisection steps after a first step of ``STEP`` was feasible."""


class _Predicted(Protocol):
    """What backtracking needs of ``Constraints``."""

    def evaluate(self, action: Plain) -> ActionCandidate:
        """The candidate of this action."""


def backtrack_towards(
    constraints: _Predicted, sides: tuple[Side, ...], nominal: Plain, feasible: ActionCandidate
) -> ActionCandidate:
    """Moves entries back towards ``nominal`` (actions,), the furthest first, while all constraints hold."""
    target = clip_to_bounds(nominal, sides)
    for entry in _distant_entries(sides, target, feasible.action):
        feasible = _backtrack_entry(constraints, entry, target[entry], sides[entry][2], feasible)
    return feasible


def _distant_entries(sides: Sequence[Side], target: Plain, action: Plain) -> list[int]:
    """Entries that are further than ``STEP`` from the target, the furthest first."""
    far: list[tuple[float, int]] = []
    for index in range(len(sides)):
        away: float = (action[index] - target[index]) / sides[index][2]
        # Two comparisons instead of abs(): this runs for every corrected action.
        if away > STEP or away < -STEP:
            far.append((-abs(away), index))
    far.sort()
    return [index for _, index in far]


def _backtrack_entry(
    constraints: _Predicted, entry: int, target: float, width: float, feasible: ActionCandidate
) -> ActionCandidate:
    """Moves this entry as near to the target as is feasible, by bisection; unchanged if not one step nearer."""
    start: float = feasible.action[entry]
    low, high = STEP * width / abs(target - start), 1.0
    # The smallest step first: if it is infeasible, the entry is at its boundary and one evaluation was enough.
    best = _at(constraints, feasible, entry, start + low * (target - start))
    if not best.is_feasible:
        return feasible
    for _ in range(_HALVINGS):
        share = 0.5 * (low + high)
        trial = _at(constraints, feasible, entry, start + share * (target - start))
        if trial.is_feasible:
            best, low = trial, share
        else:
            high = share
    return best


def _at(constraints: _Predicted, about: ActionCandidate, entry: int, value: float) -> ActionCandidate:
    action = list(about.action)
    action[entry] = value
    return constraints.evaluate(action)
