"""The search for an action that keeps all conditions: the quadratic program, posed anew about its solution."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Protocol

from safedpa.safety.conditions import Outcome, Plain
from safedpa.safety.program_rows import Side
from safedpa.safety.solution import Solution

__all__ = ["NEEDLESS", "SAME", "SERVED_WELL", "TIE", "DecisionError", "search"]

_BOUND_TOLERANCE: Final = 1e-6
"""Share of an action's range by which a solution may miss its bounds before it is not believed."""


SAME: Final = 1e-8
"""Share of an action's range within which a solution is the last one over again; the solver's accuracy is 1e-9."""


SERVED_WELL: Final = 0.1
"""Slopes that brought the violation below this share of the last one are used once more."""


NEEDLESS: Final = 100.0
"""A solution whose every condition is kept by more than this many tolerances (1 cm) was led astray by its slopes."""


TIE: Final = 1e-9
"""Unit of h: by less than this no violation is smaller than another; where an actuator saturates they are the same."""


class DecisionError(Exception):
    """No decision can be computed; the text says why, ``solver`` what the solver said."""

    def __init__(self, reason: str, solver: str = "not run") -> None:
        super().__init__(reason)
        self.solver = solver


class _Drawn(Protocol):
    """What the search needs of a ``Tangent``."""

    def at(self, about: Outcome) -> tuple[list[list[float]], list[float]]:
        """A and b of A a >= b."""


class _Posed(Protocol):
    """What the search needs of ``Conditions``."""

    def outcome(self, action: Plain) -> Outcome:
        """What the action leads to."""

    def linearised(self, about: Outcome) -> _Drawn:
        """The conditions tangent there."""


class _Program(Protocol):
    """What the search needs of a ``QuadraticProgram``."""

    @property
    def sides(self) -> tuple[Side, ...]:
        """Of each action."""

    def solve(self, A: Sequence[Plain], b: Plain, wish: Plain) -> Solution:
        """The minimiser."""

    def distance(self, action: Plain, wish: Plain) -> float:
        """Between two actions."""


def search(
    conditions: _Posed, program: _Program, wish: Plain, start: Outcome, rounds: int, tolerance: float
) -> tuple[Outcome, str]:
    """The best outcome found and the solver's word.

    Best: keeps all conditions within ``tolerance``, and nearest to the wish; if none does, the least broken one. Begins
    with the tangent at ``start`` and poses the program at most ``rounds`` times, anew about its last solution: with the
    true residual there, and with new slopes unless the old ones served well (they cost most). Ends when all conditions
    are kept and none of them needlessly far, or when slopes drawn at a solution lead to it again, as they always would.
    Raises DecisionError when the solver did not solve, or its solution is not finite or misses the bounds.
    """
    tangent = conditions.linearised(start)
    about, status = _posed(conditions, program, tangent, start, wish)
    best, before, fresh = about, start, True
    for _ in range(rounds - 1):
        if about.violation <= tolerance and about.tightest <= NEEDLESS * tolerance:
            break
        if fresh and _same(program, about, before):
            break
        fresh = not tolerance < about.violation < SERVED_WELL * before.violation
        if fresh:
            tangent = conditions.linearised(about)
        before = about
        about, status = _posed(conditions, program, tangent, about, wish)
        best = _better(program, wish, best, about, tolerance)
    return best, status


def _same(program: _Program, one: Outcome, other: Outcome) -> bool:
    sides, here, there = program.sides, one.action, other.action
    for index in range(len(sides)):
        change: float = here[index] - there[index]
        if not abs(change) <= SAME * sides[index][2]:
            return False
    return True


def _better(program: _Program, wish: Plain, one: Outcome, other: Outcome, tolerance: float) -> Outcome:
    if one.violation <= tolerance and other.violation <= tolerance:
        return other if program.distance(other.action, wish) < program.distance(one.action, wish) else one
    return other if other.violation < one.violation - TIE else one


def _posed(conditions: _Posed, program: _Program, tangent: _Drawn, about: Outcome, wish: Plain) -> tuple[Outcome, str]:
    A, b = tangent.at(about)
    solution = program.solve(A, b, wish)
    if not solution.solved:
        raise DecisionError(f"the QP was not solved: {solution.status}", solution.status)
    return conditions.outcome(_believed(solution.action, program, solution.status)), solution.status


def _believed(action: Plain, program: _Program, status: str) -> tuple[float, ...]:
    sides = program.sides
    believed: list[float] = []
    for index in range(len(sides)):
        low, high, width = sides[index]
        value: float = action[index]
        if value - value != 0.0:
            raise DecisionError("the QP's solution holds NaN or infinity", status)
        kept = low if value < low else high if value > high else value
        if abs(value - kept) > _BOUND_TOLERANCE * width:
            raise DecisionError("the QP's solution misses the actuator bounds", status)
        believed.append(kept)
    return tuple(believed)
