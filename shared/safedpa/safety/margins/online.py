"""The margin of one running robot: calibrated beforehand, watched and widened while it drives."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import isfinite, isnan, nan
from typing import final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.safety.barriers.base import AbstractBarrier, AbstractBarrierSet
from safedpa.safety.barriers.stack import make_barrier_set
from safedpa.safety.margins.calibration import MarginCalibration
from safedpa.safety.margins.conformal import OnlineMargin
from safedpa.safety.margins.error_clipping import NO_CLIP, ErrorClip, HSample
from safedpa.safety.margins.transition import MarginRamp, least_by_kind
from safedpa.safety.prediction.command_history import DelayedPrediction

__all__ = ["HSample", "OnlineMarginMonitor"]


_RATE = 0.002
"""Of the miss level per step: at 99 % coverage five misses at once bring the widest margin, a single one does not."""
_WINDOW = 500
"""Errors that are remembered: 25 s at 20 Hz."""
_LONGER = (
    "A step is {:.3g} times as long as those that the margin was calibrated on: it is taken as many times as wide and "
    "promises nothing; calibrate it at this period."
)


@final
class OnlineMarginMonitor:
    """epsilon by kind of barrier. After each period the prediction of h is compared with the measurement:

    error = min(h', H) - min(h, H),   h' = the least h of the kind at x predicted, h = the least at x measured,

    positive where the model hoped too much (past a dead time see ``HSample``). The barriers of h' are those of the last
    decision: other functions where they depend on the latent, which changed since. H is the ``ErrorClip``: a step in
    which both are above it says nothing about the boundary and is no error at all. The least counts, since it is what
    has to stay above 0: a hazard that comes nearer than predicted behind another that is nearer still does no harm.
    """

    def __init__(
        self,
        calibration: MarginCalibration,
        clip: ErrorClip = NO_CLIP,
        phased: MarginRamp | None = None,
        longer: float = 1.0,
    ) -> None:
        """``longer``: how many times as long as the calibration's the steps are; beyond 1 it promises nothing."""
        self._margins = {
            kind: OnlineMargin(calibrated, calibration.coverage, _RATE, _WINDOW)
            for kind, calibrated in calibration.epsilon.items()
        }
        self.promised = calibration.coverage if calibration.date != "never" and longer == 1.0 else -1.0
        """Share of the steps that the margin was calibrated for; -1 of one that no data stand behind."""
        self.longer = longer
        """How many times as long as the calibration's the steps are; 1 for those and shorter ones."""
        self._longer = _LONGER.format(longer) if longer != 1.0 else ""
        self._clip, self._phased = clip, phased
        self.learns = True
        """Whether errors move the margins."""
        self.seen: dict[str, HSample] = {}
        """By kind, what was predicted for the last state that was observed, and what came."""
        self._expected: Sequence[float] | None = None
        self._then: Sequence[AbstractBarrier] | None = None

    @property
    def coverage(self) -> float:
        """Share of the last steps in which the margin held, the least of all kinds of barrier; -1 before the first."""
        least = -1.0
        for margin in self._margins.values():
            reported = margin.coverage
            if reported is not None and (least < 0.0 or reported < least):
                least = reported
        return least

    @property
    def epsilon(self) -> dict[str, float]:
        """The margins in force."""
        watched = {kind: margin.value for kind, margin in self._margins.items()}
        return watched if self._phased is None else self._phased.limited(watched)

    @property
    def remark(self) -> str:
        """What a verdict has to say about the margins in force; empty while they are what was calibrated, or wider."""
        if self._phased is None:
            return self._longer
        return " ".join(text for text in (self._longer, self._phased.sentence) if text)

    def rise(self, state: Sequence[float] | FloatArray, barriers: Sequence[AbstractBarrier], period: float) -> None:
        """Brings more of a new model's margins into force, as h at ``state`` (states,) allows; once per tick."""
        if self._phased is None:
            return
        self._phased.rise(least_by_kind(make_barrier_set(barriers), _plain(state)), period)
        if not self._phased.waiting:
            self._phased = None

    def expect(
        self, next_state: Sequence[float] | FloatArray | None, barriers: Sequence[AbstractBarrier] | None = None
    ) -> None:
        """Keeps the prediction (states,) for the next measurement; None: there is none.

        ``barriers`` are those that the decision kept, for barriers that are others by the next period.
        """
        self._expected = None if next_state is None else _plain(next_state)
        self._then = barriers

    def observe(
        self,
        state: Sequence[float] | FloatArray,
        barriers: Sequence[AbstractBarrier],
        *,
        same_scene: bool = True,
        late: DelayedPrediction | None = None,
    ) -> None:
        """Holds the last prediction against the measured ``state`` (states,); call it once per period.


        ``late``: what was predicted past a dead time, in place of the last prediction. There a condition is posed at a
        state that is predicted itself, so the error of h there counts as well, (1 - eta) times with the other sign.
        Unless it is the ``same_scene`` the barriers of now stand for those of then: what else came into the scene no
        model foresees.
        """
        self.seen = self._heights(_plain(state), make_barrier_set(barriers), late, same_scene=same_scene)
        for kind, seen in self.seen.items():
            margin = self._margins.get(kind)
            if margin is not None and self.learns:
                error = self._clip.error(kind, seen, margin.value)
                if error is not None and isfinite(error):
                    margin.update(error)

    def _heights(
        self, state: Sequence[float], stack: AbstractBarrierSet, late: DelayedPrediction | None, *, same_scene: bool
    ) -> dict[str, HSample]:
        expected, self._expected = self._expected, None
        expected = expected if late is None else late.hoped
        if expected is None or len(expected) != len(state) or not stack.names:
            return {}
        then = make_barrier_set(self._then) if self._then is not None and same_scene else stack
        if then.names != stack.names:
            then = stack
        tables = [then.heights(expected), stack.heights(state)]
        if late is not None:
            tables += [then.heights(late.hoped_before), stack.heights(late.before)]
        return {kind: HSample(*(_least(h, rows) for h in tables)) for kind, rows in stack.rows.items()}


def _plain(state: Sequence[float] | FloatArray) -> Sequence[float]:
    """As numbers of Python's own: a few of them are computed with faster than an array."""
    return state.tolist() if isinstance(state, np.ndarray) else state


def _least(h: Sequence[float], rows: Iterable[int]) -> float:
    """NaN where one is: then the sum is none either."""
    values = [h[row] for row in rows]
    return min(values) if not isnan(sum(values)) or not any(map(isnan, values)) else nan
