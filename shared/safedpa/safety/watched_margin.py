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
from safedpa.safety.margin_change import PhasedMargin, least_by_kind

__all__ = ["WatchedMargin"]

Values = NDArray[np.float64]

_RATE = 0.002
"""Of the miss level per step: at 99 % coverage five misses at once bring the widest margin, a single one does not."""
_WINDOW = 500
"""Errors that are remembered: 25 s at 20 Hz."""


@final
class WatchedMargin:
    """epsilon by kind of barrier. After each period the prediction of h is held against the measurement:

    error = max over the kind's barriers of h'(x predicted) - h(x measured), positive where the model hoped too much.

    h' is h as the last decision had it: another function where h depends on the latent, which changed since.
    """

    def __init__(self, calibration: MarginCalibration, phased: PhasedMargin | None = None) -> None:
        self._margins = {
            kind: OnlineMargin(calibrated, calibration.coverage, _RATE, _WINDOW)
            for kind, calibrated in calibration.epsilon.items()
        }
        self.promised = calibration.coverage if calibration.date != "never" else -1.0
        """Share of the steps that the margin was calibrated for; -1 of one that no data stand behind."""
        self._phased = phased
        self._expected: Sequence[float] | None = None
        self._then: Sequence[AbstractBarrier] | None = None

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
        watched = {kind: margin.value for kind, margin in self._margins.items()}
        return watched if self._phased is None else self._phased.limited(watched)

    @property
    def remark(self) -> str:
        """What a verdict has to say about the margins in force; empty while they are what was calibrated, or wider."""
        return "" if self._phased is None else self._phased.sentence

    def rise(self, state: Sequence[float] | Values, barriers: Sequence[AbstractBarrier], period: float) -> None:
        """Brings more of a new model's margins into force, as h at ``state`` (states,) allows; once per tick."""
        if self._phased is None:
            return
        self._phased.rise(least_by_kind(stacked(barriers), _plain(state)), period)
        if not self._phased.waiting:
            self._phased = None

    def expect(
        self, next_state: Sequence[float] | Values | None, barriers: Sequence[AbstractBarrier] | None = None
    ) -> None:
        """Keeps the prediction (states,) for the next measurement; None: there is none.

        ``barriers`` are those that the decision kept, for barriers that are others by the next period.
        """
        self._expected = None if next_state is None else _plain(next_state)
        self._then = barriers

    def observe(
        self, state: Sequence[float] | Values, barriers: Sequence[AbstractBarrier], *, same_scene: bool = True
    ) -> dict[str, float]:
        """The errors by kind of the last prediction against the measured ``state`` (states,); call it once per period.

        In the ``same_scene`` what was predicted is h by the barriers of then, and what is measured is h by those of
        now: with a latent in h, its change over the period is part of the error. Where something else came into the
        scene, which no model foresees, the barriers of now stand for both.
        """
        expected, self._expected = self._expected, None
        if expected is None or len(expected) != len(state):
            return {}
        stack, then = stacked(barriers), stacked(self._then if self._then is not None and same_scene else barriers)
        if not stack.names:
            return {}
        if then.names != stack.names:
            then = stack
        hoped, measured = then.heights(expected), stack.heights(_plain(state))
        errors = [before - after for before, after in zip(hoped, measured, strict=True)]
        worst = {kind: _largest([errors[row] for row in rows]) for kind, rows in stack.rows.items()}
        for kind, error in worst.items():
            margin = self._margins.get(kind)
            if margin is not None and isfinite(error):
                margin.update(error)
        return worst


def _plain(state: Sequence[float] | Values) -> Sequence[float]:
    """As numbers of Python's own: a few of them are computed with faster than an array."""
    return state.tolist() if isinstance(state, np.ndarray) else state


def _largest(errors: list[float]) -> float:
    """NaN where one is: then the sum is none either."""
    return max(errors) if isfinite(sum(errors)) or not any(map(isnan, errors)) else nan
