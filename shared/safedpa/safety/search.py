"""The search for an action that keeps all conditions: the quadratic program, posed anew about its solution."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from safedpa.safety.conditions import Conditions, Outcome
from safedpa.safety.quadratic_program import QuadraticProgram

__all__ = ["DecisionError", "search"]

Values = NDArray[np.float64]

_BOUND_TOLERANCE = 1e-6
"""Share of an action's range by which a solution may miss its bounds before it is not believed."""


class DecisionError(Exception):
    """No decision can be computed; the text says why, ``solver`` what the solver said."""

    def __init__(self, reason: str, solver: str = "not run") -> None:
        super().__init__(reason)
        self.solver = solver


def search(
    conditions: Conditions, program: QuadraticProgram, wish: Values, start: Outcome, rounds: int, tolerance: float
) -> tuple[Outcome, str]:
    """The first outcome that keeps all conditions within ``tolerance``, else the least broken one; the solver's word.

    Begins with the tangent at ``start`` and takes at most ``rounds`` tangents. Raises DecisionError when the solver did
    not solve, or its solution is not finite or misses the bounds.
    """
    best, about = None, start
    for _ in range(rounds):
        solution = program.solve(*conditions.linearised(about), wish)
        if not solution.solved:
            raise DecisionError(f"the QP was not solved: {solution.status}", solution.status)
        action = _believed(solution.action, program, solution.status)
        about = conditions.outcome(action)
        if best is None or about.violation < best.violation:
            best = about
        if best.violation <= tolerance:
            break
    assert best is not None
    return best, solution.status


def _believed(action: Values, program: QuadraticProgram, status: str) -> Values:
    if not np.isfinite(action).all():
        raise DecisionError("the QP's solution holds NaN or infinity", status)
    clipped = np.minimum(np.maximum(action, program.low), program.high)
    if (np.abs(clipped - action) > _BOUND_TOLERANCE * program.range).any():
        raise DecisionError("the QP's solution misses the actuator bounds", status)
    return clipped
