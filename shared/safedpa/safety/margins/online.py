"""The margin of one running robot: calibrated beforehand, and widened online while its coverage is lost."""

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
from safedpa.safety.margins.transition import MarginRamp, min_h_by_kind
from safedpa.safety.prediction.command_history import DelayedPrediction

__all__ = ["HSample", "OnlineMarginMonitor"]


_LEARNING_RATE = 0.002
"""Change of the miss level per step: at 99 % coverage five successive misses give the widest margin, one does not."""
_WINDOW = 500
"""Number of stored errors: 25 s at 20 Hz."""
_LONGER = (
    "A step is {:.3g} times as long as those that the margin was calibrated on: it is taken as many times as wide and "
    "promises nothing; calibrate it at this period."
)


@final
class OnlineMarginMonitor:
    """epsilon by kind of barrier. After each period the predicted h is compared with the measured one:

    error = min(h', H) - min(h, H),   h' = smallest h of the kind at the predicted x, h = smallest at the measured x,

    positive if the model was too optimistic (beyond a dead time see ``HSample``). h' uses the barriers of the last
    decision, which are other functions if they depend on the latent, since that has changed. H is the ``ErrorClip``: a
    step with both above it says nothing about the boundary and is no error. The minimum counts, since it must stay
    above 0: an obstacle that is nearer than predicted, behind one that is nearer still, does no harm.
    """

    def __init__(
        self,
        calibration: MarginCalibration,
        clip: ErrorClip = NO_CLIP,
        ramp: MarginRamp | None = None,
        longer: float = 1.0,
    ) -> None:
        """``longer``: ratio of the steps' period to the calibration's; beyond 1 the margin has no guarantee."""
        self._margins = {
            kind: OnlineMargin(calibrated, calibration.coverage, _LEARNING_RATE, _WINDOW)
            for kind, calibrated in calibration.epsilon.items()
        }
        # A margin without data behind it must not be reported with a coverage.
        self.promised = calibration.coverage if calibration.date != "never" and longer == 1.0 else -1.0
        """Coverage that the margin was calibrated for; -1 without data behind it."""
        self.longer = longer
        """Ratio of the steps' period to the calibration's; 1 for those and shorter ones."""
        self._longer = _LONGER.format(longer) if longer != 1.0 else ""
        self._clip, self._ramp = clip, ramp
        self.learns = True
        """Whether errors change the margins."""
        self.samples: dict[str, HSample] = {}
        """By kind, the sample of the last observed state."""
        self._expected: Sequence[float] | None = None
        self._expected_barriers: Sequence[AbstractBarrier] | None = None

    @property
    def coverage(self) -> float:
        """Share of the last steps in which the margin held, the smallest of all kinds; -1 before the first."""
        smallest = -1.0
        for margin in self._margins.values():
            reported = margin.coverage
            # The smallest over all kinds: the promise holds only if it holds for each.
            if reported is not None and (smallest < 0.0 or reported < smallest):
                smallest = reported
        return smallest

    @property
    def epsilon(self) -> dict[str, float]:
        """The margins in force."""
        online = {kind: margin.value for kind, margin in self._margins.items()}
        return online if self._ramp is None else self._ramp.limited(online)

    @property
    def remark(self) -> str:
        """What the verdict says about the margins in force; empty while they are the calibrated ones, or wider."""
        if self._ramp is None:
            return self._longer
        return " ".join(text for text in (self._longer, self._ramp.sentence) if text)

    def rise(self, state: Sequence[float] | FloatArray, barriers: Sequence[AbstractBarrier], period: float) -> None:
        """Raises the margins towards those of a new model, as far as h at ``state`` (states,) allows; once per tick."""
        if self._ramp is None:
            return
        self._ramp.rise(min_h_by_kind(make_barrier_set(barriers), _floats(state)), period)
        if not self._ramp.waiting:
            self._ramp = None

    def expect(
        self, next_state: Sequence[float] | FloatArray | None, barriers: Sequence[AbstractBarrier] | None = None
    ) -> None:
        """Stores the prediction (states,) for the next measurement; None: there is none.

        ``barriers`` are those of the decision, if they will be others in the next period.
        """
        self._expected = None if next_state is None else _floats(next_state)
        self._expected_barriers = barriers

    def observe(
        self,
        state: Sequence[float] | FloatArray,
        barriers: Sequence[AbstractBarrier],
        *,
        same_scene: bool = True,
        late: DelayedPrediction | None = None,
        others: Sequence[DelayedPrediction] = (),
    ) -> None:
        """Compares the last prediction with the measured ``state`` (states,); call it once per period.

        ``late``: a prediction from before a dead time, used instead of the last one. Its constraint starts from a
        predicted state, so the error of h there counts as well, (1 - eta) times with the opposite sign. If it is not
        the ``same_scene``, the present barriers are used for both: no model can predict what entered the scene.
        ``others`` are predictions under other delays for which the constraints were imposed as well: the one that came
        nearest counts, since its constraint is the one that held.
        """
        found = [self._compare(_floats(state), make_barrier_set(barriers), late, same_scene=same_scene)]
        for other in others:
            self._expected = None
            found.append(self._compare(_floats(state), make_barrier_set(barriers), other, same_scene=same_scene))
        self.samples = found[0]
        lengths = [0 if one is None else one.queued_periods for one in (late, *others)]
        for kind, sample in self.samples.items():
            margin = self._margins.get(kind)
            # The sample is stored in any case, for records; only learning can be switched off.
            if margin is not None and self.learns:
                error = self._smallest_error(kind, [one.get(kind, sample) for one in found], lengths, margin.value)
                # An infinite error comes from a model that overflowed; the decision has refused that state already.
                if error is not None and isfinite(error):
                    margin.update(error)

    def _smallest_error(
        self, kind: str, samples: Sequence[HSample], lengths: Sequence[int], epsilon: float
    ) -> float | None:
        """The smallest error of one step; an error over n periods counts as 1 / (1 + eta n) of it, as margins grow."""
        smallest: float | None = None
        for sample, periods in zip(samples, lengths, strict=True):
            error = self._clip.error(kind, sample, epsilon)
            if error is None:  # far from the boundary under a possible delay: the step says nothing
                return None
            error /= 1.0 + self._clip.eta * periods
            smallest = error if smallest is None or error < smallest else smallest
        return smallest

    def _compare(
        self, state: Sequence[float], barriers: AbstractBarrierSet, late: DelayedPrediction | None, *, same_scene: bool
    ) -> dict[str, HSample]:
        # Used once: a tick without a decision must not be compared with an old prediction.
        expected, self._expected = self._expected, None
        expected = expected if late is None else late.predicted
        if expected is None or len(expected) != len(state) or not barriers.names:
            return {}
        expected_barriers = (
            make_barrier_set(self._expected_barriers)
            if self._expected_barriers is not None and same_scene
            else barriers
        )
        # Other rows than now: they cannot be compared kind by kind.
        if expected_barriers.names != barriers.names:
            expected_barriers = barriers
        tables = [expected_barriers.h_floats(expected), barriers.h_floats(state)]
        if late is not None:
            tables += [expected_barriers.h_floats(late.predicted_prev), barriers.h_floats(late.measured_prev)]
        return {kind: HSample(*(_min_of_rows(h, rows) for h in tables)) for kind, rows in barriers.rows.items()}


def _floats(state: Sequence[float] | FloatArray) -> Sequence[float]:
    """As Python floats: for so few numbers they are faster than an array."""
    # A list is what the callers need already, so converting it would only take time.
    return state.tolist() if isinstance(state, np.ndarray) else state


def _min_of_rows(h: Sequence[float], rows: Iterable[int]) -> float:
    # min() ignores NaN in all but the first place; the sum shows it, except that inf - inf is NaN as well.
    """The minimum of these rows; NaN if any of them is."""
    values = [h[row] for row in rows]
    return min(values) if not isnan(sum(values)) or not any(map(isnan, values)) else nan
