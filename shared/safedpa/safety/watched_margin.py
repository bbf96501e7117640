"""The margin of one running robot: calibrated beforehand, watched and widened while it drives."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite, isnan, nan
from typing import final

import numpy as np
from numpy.typing import NDArray

from safedpa.safety.barrier import AbstractBarrier
from safedpa.safety.calibration import MarginCalibration
from safedpa.safety.car_stack import stacked
from safedpa.safety.margin import OnlineMargin

__all__ = ["WatchedMargin"]

Values = NDArray[np.float64]

_RATE = 0.002
"""Of the miss level per step: at 99 % coverage five misses at once bring the widest margin, a single one does not."""
_WINDOW = 500
"""Errors that are remembered: 25 s at 20 Hz."""


@final
class WatchedMargin:
    """epsilon by kind of barrier. After each period the prediction of h is held against the measurement:

    error = max over the kind's barriers of h(x predicted) - h(x measured), positive where the model hoped too much.
    """

    def __init__(self, calibration: MarginCalibration) -> None:
        self._margins = {
            kind: OnlineMargin(calibrated, calibration.coverage, _RATE, _WINDOW)
            for kind, calibrated in calibration.epsilon.items()
        }
        self.promised = calibration.coverage if calibration.date != "never" else -1.0
        """Share of the steps that the margin was calibrated for; -1 of one that no data stand behind."""
        self._expected: Sequence[float] | None = None

    @property
    def coverage(self) -> float:
        """Share of the last steps in which the margin held, the least of all kinds of barrier; -1 before the first."""
        least = -1.0
        for margin in self._margins.values():
            told = margin.coverage
            if told is not None and (least < 0.0 or told < least):
                least = told
        return least

    @property
    def epsilon(self) -> dict[str, float]:
        """The margins in force."""
        return {kind: margin.value for kind, margin in self._margins.items()}

    def expect(self, next_state: Sequence[float] | Values | None) -> None:
        """Keeps the prediction (states,) for the next measurement; None: there is none."""
        self._expected = None if next_state is None else _plain(next_state)

    def observe(self, state: Sequence[float] | Values, barriers: Sequence[AbstractBarrier]) -> None:
        """Holds the last prediction against the measured ``state`` (states,); call it once per period."""
        expected, self._expected = self._expected, None
        if expected is None or len(expected) != len(state):
            return
        stack = stacked(barriers)
        if not stack.names:
            return
        hoped, measured = stack.heights(expected), stack.heights(_plain(state))
        errors = [before - after for before, after in zip(hoped, measured, strict=True)]
        for kind, rows in stack.rows.items():
            margin = self._margins.get(kind)
            if margin is not None:
                worst = _largest([errors[row] for row in rows])
                if isfinite(worst):
                    margin.update(worst)


def _plain(state: Sequence[float] | Values) -> Sequence[float]:
    """As numbers of Python's own: a few of them are computed with faster than an array."""
    return state.tolist() if isinstance(state, np.ndarray) else state


def _largest(errors: list[float]) -> float:
    """NaN where one is: then the sum is none either."""
    return max(errors) if isfinite(sum(errors)) or not any(map(isnan, errors)) else nan
