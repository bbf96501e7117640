"""Scripted outcomes, slopes and solutions for tests of the search."""

from safedpa.safety import Solution
from safedpa.safety.solver.constraints import ActionCandidate

GIVEN_UP = Solution((0.0,), (0.0,), False, "max iter reached")


def outcome(action: float, *residual: float, unsafe: bool = False) -> ActionCandidate:
    """Each barrier's scale is 1."""
    broken = [row for row, value in enumerate(residual) if value < 0.0]
    h_next = [-1.0 if unsafe else 0.0] * len(residual)
    return ActionCandidate((action,), [0.0], h_next, list(residual), broken)


def about(*action: float) -> ActionCandidate:
    return ActionCandidate(action, [0.0], [0.0], [0.0], [])


class Gradients:
    """Of one condition, 1 of the first action; its limit follows from the residual."""

    def at(self, residual: list[float], action: tuple[float, ...], overshoot: float):
        return [[1.0]], [action[0] - (1.0 + overshoot * (residual[0] < 0.0)) * residual[0]]


def solution(*action: float) -> Solution:
    return Solution(action, (0.0,), True, "solved")
