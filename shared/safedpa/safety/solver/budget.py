"""A limit of time or of evaluations for one decision, with the candidates that were evaluated before it ended."""

from __future__ import annotations

from collections.abc import Callable
from math import inf
from typing import Any, final

from safedpa.safety.errors import OutOfBudgetError

__all__ = ["DecisionBudget"]


@final
class DecisionBudget:
    """Counts evaluations and reads the clock; ``candidates`` has what was evaluated, in order.

    ``end`` [s] on ``clock``, and ``evaluations`` of model and barriers together, whichever is reached first.
    """

    def __init__(self, clock: Callable[[], float], end: float = inf, evaluations: float = inf) -> None:
        self._clock, self._end, self._left = clock, end, evaluations
        self.candidates: list[Any] = []

    def spend(self) -> None:
        """Takes one evaluation. Raises OutOfBudgetError if there is none left, or no time."""
        # Checked before each evaluation, because a model step that has begun cannot be interrupted.
        self._left -= 1
        if self._left < 0 or self._clock() >= self._end:
            raise OutOfBudgetError("the deadline has passed")
