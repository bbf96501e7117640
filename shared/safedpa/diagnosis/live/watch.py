"""The watch over one robot's model: forecasts against what happened, the band, the evidence, the margin's coverage."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from safedpa.diagnosis.live.band import STRETCH, Band, learned_band, moved
from safedpa.diagnosis.live.errors import stretch_error
from safedpa.diagnosis.live.evidence import Evidence
from safedpa.diagnosis.live.forecasts import Forecast, Forecasts
from safedpa.diagnosis.live.place import place_in_words
from safedpa.dynamics import PhysicsModel

__all__ = ["Decision", "Watch"]

Vector = NDArray[np.float64]

_LEARN = 40
"""Forecasts in which the robot moves, 20 s of them, from which the band is learned."""
_SETTLE = 2
"""Forecasts left out at the start: actuators may remember what nobody saw."""
_COVERED_SECONDS = 20.0
_KEPT = 80


@dataclass(frozen=True)
class Decision:
    """What of the filter's verdict the watch needs."""

    h_now: float
    h_next: float
    margin: float


@final
class Watch:
    """Follows one robot and one model; a new model needs a new watch.

    ``scale`` (states,) is that of the watch before, so that errors of both models are told on one scale; ``period`` [s]
    that of the robot's ticks, by default the model's.
    """

    def __init__(
        self, model: PhysicsModel, horizon: float = 1.0, scale: Vector | None = None, period: float | None = None
    ) -> None:
        self.model = model
        self.horizon = horizon
        self.band: Band | None = None
        """None while it is being learned."""
        self.evidence = Evidence()
        self._forecasts = Forecasts(model, horizon, period)
        self._seen: deque[Forecast] = deque(maxlen=_KEPT)
        self._settling = _SETTLE
        self._judged_until = -1
        self._covered: deque[bool] = deque(maxlen=round(_COVERED_SECONDS / (period or model.period)))
        self._decision: tuple[int, Decision] | None = None
        self._scale = scale

    @property
    def scale(self) -> Vector:
        """Standard deviation of the state's change over the horizon (states,): of the band, or of what was seen."""
        if self._scale is not None:
            return self._scale
        difference = self.model.system.difference
        if len(self._seen) < STRETCH:  # too few to tell a scale from
            return np.zeros(len(self.model.system.state))
        return np.asarray(np.std([difference(item.measured, item.began) for item in self._seen], axis=0))

    @property
    def learned_share(self) -> float:
        """How much of what the band is learned from is there, 0 to 1."""
        return 1.0 if self.band is not None else len(self._seen) / _LEARN

    @property
    def seconds_to_learn(self) -> float:
        """s of driving until the band is known, a forecast begun in every half of the horizon; 0 once it is."""
        return (1.0 - self.learned_share) * _LEARN * 0.5 * self.horizon

    @property
    def error(self) -> float:
        """One-second error of the last stretch, scaled like a report's ``heldout_error``; 0 before the first."""
        recent = list(self._seen)[-STRETCH:]
        return stretch_error(self.model.system, recent, self.scale)

    @property
    def coverage(self) -> float:
        """Share of the last 20 s' steps after which h was not below what was predicted by more than the margin."""
        return sum(self._covered) / len(self._covered) if self._covered else 1.0

    @property
    def where(self) -> str:
        """Where the model fails, in words; empty while there is no evidence that it does."""
        since = self.evidence.since
        if self.band is None or since is None:
            return ""
        after = [item for item in self._seen if item.start >= since]
        return place_in_words(self.model.system, self.band, after, self.horizon)

    def changed_at(self) -> int | None:
        """Start of the first forecast that the change touched: the split of the forecasts by which the logarithms of
        their errors over the band differ most, in the sense of least squares. None without evidence."""
        if self.band is None or self.evidence.since is None:
            return None
        recent = list(self._seen)
        sizes = np.log([max(float(self.band.ratios(self.model.system, item).max()), 1e-3) for item in recent])
        count = np.arange(1, len(sizes))
        before = np.cumsum(sizes)[:-1] / count
        after = (sizes.sum() - np.cumsum(sizes)[:-1]) / count[::-1]
        apart = np.where(after > before, count * count[::-1] * (after - before) ** 2, 0.0)
        return recent[int(apart[:-1].argmax()) + 1].start

    def observe(self, tick: int, state: Vector, applied: Vector, latent: Vector | None) -> None:
        """Takes one tick: state (states,), what was applied since the last one (actions,), the latent (latents,)."""
        for forecast in self._forecasts.observe(tick, state, applied, latent):
            if self._settling > 0:
                self._settling -= 1
            elif moved(self.model.system, forecast):
                self._take(forecast)

    def judge_margin(self, tick: int, decision: Decision | None, *, obeyed: bool = True) -> None:
        """Holds what the filter foresaw one tick ago against h now; None where there is no verdict of it.

        ``obeyed``: whether the filter's action was the one applied since.
        """
        before, self._decision = self._decision, None if decision is None else (tick, decision)
        if decision is None or before is None or before[0] != tick - 1 or not obeyed:
            return
        self._covered.append(decision.h_now >= before[1].h_next - before[1].margin)

    def _take(self, forecast: Forecast) -> None:
        self._seen.append(forecast)
        if self.band is None:
            if len(self._seen) >= _LEARN:
                self.band = learned_band(self.model.system, list(self._seen), self._scale)
                self._scale = self.band.scale
                self._judged_until = forecast.end
        elif forecast.start >= self._judged_until:
            self._judged_until = forecast.end
            ratio = float(self.band.ratios(self.model.system, forecast).max())
            self.evidence.add(ratio, forecast.start)
