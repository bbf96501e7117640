"""The margin of every barrier in one decision: those of the settings, or by kind those that the request names."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import final

from safedpa.safety.barrier import AbstractStack, Barriers
from safedpa.safety.search import DecisionError

__all__ = ["Margins"]


@final
class Margins:
    """epsilon_i by the kind of barrier i; what the last decision had is kept for the same barriers and numbers."""

    def __init__(self, settings: Mapping[str, float]) -> None:
        self._settings = settings
        self._barriers: AbstractStack = Barriers(())
        self._asked: dict[str, float] = {}
        self._known: tuple[list[float], float] | None = None

    def of(self, barriers: AbstractStack, asked: Mapping[str, float]) -> tuple[list[float], float]:
        """epsilon (m,) and the greatest of them; raises DecisionError unless all are finite and none negative."""
        if self._known is None or barriers is not self._barriers or asked != self._asked:
            self._known = None
            epsilon = self._checked(barriers, {**self._settings, **asked})
            self._barriers, self._asked, self._known = barriers, dict(asked), (epsilon, max(epsilon))
        return self._known

    def _checked(self, barriers: AbstractStack, margins: Mapping[str, float]) -> list[float]:
        epsilon = barriers.of_each(margins, margins.get("default", 0.0))
        if not all(map(isfinite, epsilon)) or min(epsilon) < 0.0:
            raise DecisionError(f"margin epsilon is not a finite number >= 0: {margins}")
        return epsilon
