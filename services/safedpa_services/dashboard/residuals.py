"""Predicted against measured states, tick by tick, whichever of the two arrives first."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from safedpa.bus import StateMessage, VerdictMessage
from safedpa.systems import System

__all__ = ["ResidualBook"]

_REMEMBERED_TICKS = 8


class ResidualBook:
    """Residuals r[k+1] = x[k+1] - predicted[k][0] of one robot and one epoch, angles the short way round.

    A pair counts once, and only when the filter's action was in force over the period: the prediction is about that
    action. What is older than a few ticks is forgotten.
    """

    def __init__(self, system: System) -> None:
        self._system = system
        self._predicted: dict[int, tuple[float, ...]] = {}
        self._measured: dict[int, tuple[float, ...]] = {}

    def add_state(self, state: StateMessage) -> tuple[float, ...] | None:
        """The residual of this tick if its prediction has arrived, (states,)."""
        if state.applied_by != "filter" or len(state.values) != len(self._system.state):
            return None
        return self._match(state.tick, self._measured, state.values)

    def add_verdict(self, verdict: VerdictMessage) -> tuple[int, tuple[float, ...]] | None:
        """(tick, residual) of the next tick if its measurement has arrived already."""
        if not verdict.predicted or len(verdict.predicted[0]) != len(self._system.state):
            return None
        residual = self._match(verdict.tick + 1, self._predicted, verdict.predicted[0])
        return None if residual is None else (verdict.tick + 1, residual)

    def _match(
        self, tick: int, own: dict[int, tuple[float, ...]], values: tuple[float, ...]
    ) -> tuple[float, ...] | None:
        own[tick] = values
        measured, predicted = self._measured.get(tick), self._predicted.get(tick)
        for book in (self._measured, self._predicted):
            for old in [known for known in book if known <= tick - _REMEMBERED_TICKS]:
                del book[old]
        if measured is None or predicted is None:
            return None
        del self._measured[tick], self._predicted[tick]
        return self._difference(measured, predicted)

    def _difference(self, measured: Sequence[float], predicted: Sequence[float]) -> tuple[float, ...]:
        with np.errstate(all="ignore"):  # two huge numbers may differ by infinity; the curve then has a gap
            change = self._system.difference(np.array(measured), np.array(predicted))
        return tuple(float(value) for value in change)
