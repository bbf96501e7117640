"""The margin of every row in one decision: from the settings, overridden by kind by the request."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from numbers import Real
from typing import Any, Final, final

from safedpa.errors import did_you_mean
from safedpa.safety.barriers.base import AbstractBarrierSet
from safedpa.safety.checks.compatibility import known_kinds
from safedpa.safety.solver.sqp import DecisionError

__all__ = ["ActiveMargins"]


_UNSET: Final = (
    "No margin is set for barriers of kind {kinds}: any error of the model counts in full "
    "(calibrate_margin measures one; epsilon=0 accepts this)."
)


@final
class ActiveMargins:
    """epsilon_i by the kind of row i; reuses the result of the last decision if kinds and margins are the same."""

    def __init__(self, settings: Mapping[str, float]) -> None:
        self._settings = settings
        self._last_kinds: tuple[str, ...] = ()
        """Kinds of the rows of the last decision."""
        self._requested: dict[str, float] = {}
        self._margins: dict[str, Any] | None = None
        """Margins by kind of the settings and of the last request, validated."""
        self._last: tuple[list[float], float] | None = None
        self._kinds = {*known_kinds(), "default", *settings}
        """Kinds for which a margin may be requested: these, and all that any decision has had."""
        self.remark = ""
        """A sentence about barriers of the last decision without a margin; empty if there is none."""

    def resolve(self, barriers: AbstractBarrierSet, requested: Any) -> tuple[list[float], float]:
        """Returns epsilon (m,) and the largest of them.

        Raises DecisionError unless ``requested`` is a table by known kinds of finite values >= 0.
        """
        if type(requested) is not dict and not isinstance(requested, Mapping):
            raise DecisionError(f"margin epsilon is no table by kind of barrier, but {type(requested).__name__}")
        if self._last is None or barriers.kinds != self._last_kinds or requested != self._requested:
            self._last = None
            # Kinds are only added: a scene may be empty in this tick, and a margin for its obstacles is still meant.
            self._kinds.update(barriers.kinds)
            if self._margins is None or requested != self._requested:
                # Reset before the validation: after an exception the next call must not reuse the old result.
                self._margins = None
                self._margins, self._requested = self._validated({**self._settings, **requested}), dict(requested)
            epsilon = self._epsilon(barriers, self._margins)
            # A margin of 0 that was set is a decision; one that was never set is a gap.
            unset = () if "default" in self._margins else sorted({*barriers.kinds} - {*self._margins})
            self.remark = _UNSET.format(kinds=", ".join(unset)) if unset else ""
            self._last_kinds, self._last = barriers.kinds, (epsilon, max(epsilon))
        return self._last

    def _validated(self, margins: dict[str, Any]) -> dict[str, Any]:
        for kind, value in margins.items():
            # A margin for an unknown kind is a typing error, and would leave the intended barrier without its margin.
            if kind not in self._kinds:
                raise DecisionError(
                    f"margin epsilon for '{kind}', a kind without barriers: {_suggestion(kind, self._kinds)}"
                )
            if isinstance(value, bool) or not isinstance(value, Real):
                raise DecisionError(f"margin epsilon is not a finite number >= 0: {margins}")
        return margins

    def _epsilon(self, barriers: AbstractBarrierSet, margins: Mapping[str, Any]) -> list[float]:
        epsilon = barriers.per_row(margins, margins.get("default", 0.0))
        if not all(map(isfinite, epsilon)) or min(epsilon) < 0.0:
            raise DecisionError(f"margin epsilon is not a finite number >= 0: {margins}")
        return epsilon


def _suggestion(kind: Any, known: set[str]) -> str:
    return did_you_mean(kind, known) if isinstance(kind, str) else f"known: {', '.join(sorted(known))}"
