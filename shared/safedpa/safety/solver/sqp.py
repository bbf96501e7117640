"""The search for an action that satisfies all conditions: the quadratic program, posed again about its solution.

An action that satisfies all conditions, brought back towards the nominal action one entry at a time.

Tangents say how far an action has to go, and where an actuator saturates or h bends they say too much: the action found
keeps all, and one of its entries stands somewhere on a plateau on which it changes nothing. An action that is the
nearest has no entry that could come nearer by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Protocol

from safedpa.safety.errors import NotFiniteError
from safedpa.safety.solver.constraints import ActionCandidate, Plain
from safedpa.safety.solver.qp_scaling import Side, within
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
    "search",
    "tighten",
]

SAME: Final = 1e-8
"""Share of an action's range within which a solution is the last one over again; the solver's accuracy is 1e-9."""


SERVED_WELL: Final = 0.1
"""Slopes that brought what is missing below this share of the last are used again."""


MOST_LEFT: Final = 0.75
"""Share of what was missing that a solution is taken to leave at most."""


NEEDLESS: Final = 0.05
"""A solution whose every condition is satisfied by more than this share of its scale was led astray by its slopes."""


OVERSHOOT: Final = 0.25
"""Share of what the last solution misses that the next program asks for on top; each one after it again as much."""


TRIES: Final = 4
"""Actions that are tried on the way to the nominal action."""


LEFT: Final = 0.9
"""Share that is gone of the way on which the room would be used up: to end on the kept side."""


DOUBTFUL: Final = 0.02
"""A solution that far from the nominal action, kept by more than this share of its scale, may lie where an actuator saturates and
nothing is lost by coming nearer."""


FAR: Final = 0.1
"""Weighted share of the actions' ranges."""


NEAR: Final = 0.01
"""Share of the way that is not worth a try."""


AGAIN: Final = 1
"""How often the program is posed from there."""


class DecisionError(Exception):
    """No decision can be computed; the text says why, ``solver`` what the solver said."""

    def __init__(self, reason: str, solver: str = "not run") -> None:
        super().__init__(reason)
        self.solver = solver


class _Drawn(Protocol):
    """What the search needs of a ``Tangent``."""

    def at(self, residual: Plain, action: Plain, overshoot: float) -> tuple[list[list[float]], list[float]]:
        """A and b of A a >= b."""


class _SearchConstraints(Protocol):
    """What the search needs of ``Conditions``."""

    @property
    def saturated(self) -> bool:
        """Whether some slope was that of a chord, since the actuator saturates there."""

    def outcome(self, action: Plain) -> ActionCandidate:
        """What the action leads to."""

    def linearised(self, about: ActionCandidate) -> _Drawn:
        """The conditions tangent there."""

    def tightest(self, found: ActionCandidate) -> float:
        """Its least residual, as a share of the barrier's scale."""


class _Program(Protocol):
    """What the search needs of a ``QuadraticProgram``."""

    @property
    def sides(self) -> tuple[Side, ...]:
        """Of each action."""

    def solve(self, A: Sequence[Plain], b: Plain, nominal: Plain) -> Solution:
        """The minimiser."""

    def distance(self, action: Plain, nominal: Plain) -> float:
        """Between two actions."""


def search(
    conditions: _SearchConstraints, program: _Program, nominal: Plain, start: ActionCandidate, rounds: int
) -> tuple[ActionCandidate, str]:
    """The best outcome found and the solver's word.

    Best: satisfies all conditions, and nearest to the nominal action; if none does, the least broken one. Begins with the tangent at
    ``start`` and poses the program at most ``rounds`` times, again about its last solution: with the true residual
    there, and with new slopes unless the old ones served well (they cost most). Ends when all conditions are satisfied and
    none of them needlessly far, when slopes drawn at a solution lead to it again, as they always would, or when the
    solver gives up. Where all are still kept needlessly far, the way from there to the nominal action is gone as far as they
    allow, and the program posed again: the nearest action has a condition that binds.
    """
    best, before, status = _posed(conditions, program, nominal, start, rounds)
    if not best.kept:
        return best, status
    room = conditions.tightest(best)
    if room > NEEDLESS:
        nearer = line_search(conditions, conditions.outcome(within(nominal, program.sides)), best)
    elif (room > DOUBTFUL or conditions.saturated) and program.distance(best.action, nominal) > FAR * FAR:
        back = _furthest_back(program, within(nominal, program.sides), best.action)
        nearer = line_search(conditions, conditions.outcome(back), best)
    elif before is not start and not before.kept and program.distance(best.action, before.action) > FAR * FAR:
        return line_search(conditions, before, best), status
    else:
        return best, status
    if nearer is best:
        return best, status
    again, _, _ = _posed(conditions, program, nominal, nearer, AGAIN)
    return _better(conditions, program, nominal, nearer, again), status


def line_search(conditions: _SearchConstraints, last: ActionCandidate, kept: ActionCandidate) -> ActionCandidate:
    """The furthest action found on the way from a kept one to the ``last`` that is still kept.

    Each residual is taken to change along a straight line, again between the last action kept and the last not kept.
    """
    if last.kept:
        return last
    end, safe, low, high = last.action, kept, 0.0, 1.0
    for _ in range(TRIES):
        allowed = (high - low) * _allowed(safe, last)
        if allowed <= NEAR:
            break
        share = low + LEFT * allowed
        between = [kept.action[index] + share * (end[index] - kept.action[index]) for index in range(len(end))]
        tried = conditions.outcome(between)
        if tried.kept:
            safe, low = tried, share
        else:
            last, high = tried, share
    return safe


def _allowed(kept: ActionCandidate, broken: ActionCandidate) -> float:
    """Share of the way between two outcomes on which no residual that is straight on it falls below 0."""
    if not broken.usable:
        return 0.5
    share = 1.0
    for row in range(len(kept.residual)):
        here, there = kept.residual[row], broken.residual[row]
        if there < 0.0:
            room = here / (here - there) if here > 0.0 else 0.0
            share = room if room < share else share
    return share


def _furthest_back(program: _Program, wanted: Plain, found: Plain) -> list[float]:
    """``found`` with the entry that costs most as it is wanted."""
    most, entry = -1.0, 0
    for index in range(len(found)):
        other = list(found)
        other[index] = wanted[index]
        cost = program.distance(other, found)
        if cost > most:
            most, entry = cost, index
    back = list(found)
    back[entry] = wanted[entry]
    return back


def _posed(
    conditions: _SearchConstraints, program: _Program, nominal: Plain, start: ActionCandidate, rounds: int
) -> tuple[ActionCandidate, ActionCandidate, str]:
    """The program, posed again about its solution: the best one, the one before the last, and the solver's word."""
    best, before, about, status = start, start, start, "not run"
    tangent = _tangent(conditions, start)
    fresh, missing, overshoot = True, _missing(conditions.tightest(start)), 0.0
    for index in range(rounds):
        if tangent is None:
            break
        A, b = tangent.at(about.residual, about.action, overshoot)
        solution = program.solve(A, b, nominal)
        status = solution.status
        action = _believed(solution, program)
        if action is None:
            break
        before, about = about, conditions.outcome(action)
        best = about if index == 0 else _better(conditions, program, nominal, best, about)
        tightest = conditions.tightest(about)
        if about.kept and tightest <= NEEDLESS:
            break
        if best.kept and not about.kept:  # the slopes there led astray: what was kept is as good a place to go on from
            break
        if fresh and _same(program, about, before):
            break
        last, missing = missing, _missing(tightest)
        fresh = not 0.0 < missing < SERVED_WELL * last
        overshoot = tighten(index + 1, last, missing)
        if fresh and index + 1 < rounds:
            tangent = _tangent(conditions, about)
    return best, before, status


def _tangent(conditions: _SearchConstraints, about: ActionCandidate) -> _Drawn | None:
    """None where the model or a barrier has no numbers there, or no slopes."""
    try:
        return conditions.linearised(about) if about.usable else None
    except NotFiniteError:
        return None


def tighten(solutions: int, last: float, missing: float) -> float:
    """The share of what is missing to ask for on top: more with every solution, and where the last brought little.

    Slopes that left the share r of what was missing will leave it again: r / (1 - r) on top makes up for that.
    """
    more = OVERSHOOT * solutions
    left = min(missing / last, MOST_LEFT) if last > 0.0 else 0.0
    return max(more, 1.25 * left / (1.0 - left))


def _missing(tightest: float) -> float:
    return -tightest if tightest < 0.0 else 0.0


def _same(program: _Program, one: ActionCandidate, other: ActionCandidate) -> bool:
    sides, here, there = program.sides, one.action, other.action
    for index in range(len(sides)):
        change: float = here[index] - there[index]
        if not abs(change) <= SAME * sides[index][2]:
            return False
    return True


def _better(
    conditions: _SearchConstraints, program: _Program, nominal: Plain, one: ActionCandidate, other: ActionCandidate
) -> ActionCandidate:
    if one.kept and other.kept:
        return other if program.distance(other.action, nominal) < program.distance(one.action, nominal) else one
    if one.kept or other.kept:
        return one if one.kept else other
    return other if conditions.tightest(other) > conditions.tightest(one) else one


def _believed(solution: Solution, program: _Program) -> tuple[float, ...] | None:
    """The solution within the actuators' bounds; None where the solver gave up or it is no number.

    How far it missed the bounds does not matter: what counts is what the model predicts for the action itself.
    """
    if not solution.solved:
        return None
    for value in solution.action:
        if value - value != 0.0:
            return None
    return within(solution.action, program.sides)


STEP: Final = 0.1
"""Share of an entry's range that it is tried to come nearer by; what is nearer than that to its nominal action is left alone."""

_HALVINGS: Final = 5
"""Of the way on which an entry that came nearer by a step is followed."""


class _Predicted(Protocol):
    """What is needed of ``Conditions``."""

    def outcome(self, action: Plain) -> ActionCandidate:
        """What the action leads to."""


def backtrack_towards(
    conditions: _Predicted, sides: tuple[Side, ...], nominal: Plain, kept: ActionCandidate
) -> ActionCandidate:
    """``retained``, or what satisfies all conditions with entries nearer to the ``nominal`` (actions,), the furthest first."""
    wanted = within(nominal, sides)
    for entry in _far_entries(sides, wanted, kept.action):
        kept = _entry_back(conditions, entry, wanted[entry], sides[entry][2], kept)
    return kept


def _far_entries(sides: Sequence[Side], wanted: Plain, action: Plain) -> list[int]:
    """Those further than a step from what is wanted, the furthest first."""
    far: list[tuple[float, int]] = []
    for index in range(len(sides)):
        away: float = (action[index] - wanted[index]) / sides[index][2]
        if away > STEP or away < -STEP:
            far.append((-abs(away), index))
    far.sort()
    return [index for _, index in far]


def _entry_back(
    conditions: _Predicted, entry: int, wanted: float, width: float, kept: ActionCandidate
) -> ActionCandidate:
    """With this entry as near to what is wanted as keeps all, to a few halvings; ``retained`` if not a step nearer."""
    start: float = kept.action[entry]
    low, high = STEP * width / abs(wanted - start), 1.0
    best = _at(conditions, kept, entry, start + low * (wanted - start))
    if not best.kept:
        return kept
    for _ in range(_HALVINGS):
        share = 0.5 * (low + high)
        tried = _at(conditions, kept, entry, start + share * (wanted - start))
        if tried.kept:
            best, low = tried, share
        else:
            high = share
    return best


def _at(conditions: _Predicted, about: ActionCandidate, entry: int, value: float) -> ActionCandidate:
    action = list(about.action)
    action[entry] = value
    return conditions.outcome(action)
