"""The margin of every barrier in one decision: those of the settings, or by kind those that the request names."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from numbers import Real
from typing import Any, final

from safedpa.errors import did_you_mean
from safedpa.safety.barriers.base import AbstractBarrierSet
from safedpa.safety.checks.compatibility import known_kinds
from safedpa.safety.solver.sqp import DecisionError

__all__ = ["ActiveMargins"]


@final
class ActiveMargins:
    """epsilon_i by the kind of barrier i; what the last decision had is kept for the same kinds and numbers."""

    def __init__(self, settings: Mapping[str, float]) -> None:
        self._settings = settings
        self._of: tuple[str, ...] = ()
        """Kinds of the barriers of the last decision."""
        self._asked: dict[str, float] = {}
        self._margins: dict[str, Any] | None = None
        """By kind, of the settings and what was asked for last, if these are such numbers."""
        self._known: tuple[list[float], float] | None = None
        self._kinds = {*known_kinds(), "default", *settings}
        """Of these, and of what was ever in sight, a margin may be asked for."""

    def of(self, barriers: AbstractBarrierSet, asked: Any) -> tuple[list[float], float]:
        """epsilon (m,) and the greatest of them.

        Raises DecisionError unless ``asked`` is a table by kinds that exist, and all are finite and none negative.
        """
        if type(asked) is not dict and not isinstance(asked, Mapping):
            raise DecisionError(f"margin epsilon is no table by kind of barrier, but {type(asked).__name__}")
        if self._known is None or barriers.kinds != self._of or asked != self._asked:
            self._known = None
            self._kinds.update(barriers.kinds)  # which only become more: what was checked once stays known
            if self._margins is None or asked != self._asked:
                self._margins = None
                self._margins, self._asked = self._checked({**self._settings, **asked}), dict(asked)
            epsilon = self._of_each(barriers, self._margins)
            self._of, self._known = barriers.kinds, (epsilon, max(epsilon))
        return self._known

    def _checked(self, margins: dict[str, Any]) -> dict[str, Any]:
        for kind, number in margins.items():
            if kind not in self._kinds:
                raise DecisionError(f"margin epsilon for '{kind}', which no barrier is: {_meant(kind, self._kinds)}")
            if isinstance(number, bool) or not isinstance(number, Real):
                raise DecisionError(f"margin epsilon is not a finite number >= 0: {margins}")
        return margins

    def _of_each(self, barriers: AbstractBarrierSet, margins: Mapping[str, Any]) -> list[float]:
        epsilon = barriers.of_each(margins, margins.get("default", 0.0))
        if not all(map(isfinite, epsilon)) or min(epsilon) < 0.0:
            raise DecisionError(f"margin epsilon is not a finite number >= 0: {margins}")
        return epsilon


def _meant(kind: Any, known: set[str]) -> str:
    return did_you_mean(kind, known) if isinstance(kind, str) else f"known: {', '.join(sorted(known))}"
