"""The watch over one robot's model: forecasts against what happened, the band, the evidence, the margin's coverage.

The sequential test: has the error left its band for good?

In each second that the robot drives, one forecast that overlaps no other is inside its band (0), outside (1) or beyond
twice the band (2). The null hypothesis is that, whatever went before,

    P(outside or beyond | past) <= 5 %   and   P(beyond | past) <= 1 %

Then e = 1 - s + s (0, 12.5 or 50), the last factor by what happened, has a mean of at most 1 for every stake s in
[0, 1], and M[n] = (M[n-1] + 1) e[n] (Shiryaev and Roberts) is an e-detector: M[n] - n is a supermartingale. By Doob's
inequality P(M reaches 1/alpha within n seconds) <= n alpha, and a false finding is n = 1/alpha seconds away on average
at the least. No independence is assumed: that seconds of one drive resemble each other is what the 5 and 1 % leave room
for; a band learned from n forecasts is left far more seldom.

Source: Shin, Ramdas and Rinaldo, E-detectors: a nonparametric framework for sequential change detection, 2023.

The band is what the model's error usually is, learned from a stretch of driving.

For each channel c the band reaches to

    edge_c (1 + V / 2),   edge_c = 1.5 max(largest |error_c| / (1 + V / 2) of the learned forecasts, 0.04 scale_c)

V is how much the commands moved during a forecast, over what they did on average: a model errs more in transients, and
a stretch of quiet driving must not make the next manoeuvre look like a fault. scale is the standard deviation of the
state's change over the horizon; an error below a twenty-fifth of that is no one's concern.

The largest of n exchangeable scores is exceeded by the next one with probability 1 / (n + 1), whatever their
distribution (split conformal prediction with a normalised score: Lei et al., Distribution-free predictive inference
for regression, 2018); the factor 1.5 is for the fact that seconds of one drive are not exchangeable.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, log
from typing import Final, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.dynamics import PhysicsModel
from safedpa.live.forecasts import Forecast, ForecastTracker, channel_errors, channels, stretch_error
from safedpa.systems import System

__all__ = [
    "ALPHA",
    "BEYOND",
    "EDetector",
    "ErrorBand",
    "ModelMonitor",
    "VerdictFacts",
    "describe_conditions",
    "has_moved",
    "learned_band",
]


_STRETCH: Final = 10
"""Forecasts of one second, begun every half second, whose common error is told: five seconds."""

_INFLATION = 1.5
_CONCERN = 0.04
_TRANSIENT = 0.5
_MOVED = 0.05
"""In the unit of some state's entry (m, rad, m/s, ...): less in a second is being stationary."""


@dataclass(frozen=True)
class ErrorBand:
    """The learned band of one robot and model."""

    scale: FloatArray
    """Standard deviation of the state's change over the horizon (states,)."""
    usual: FloatArray
    """Mean variation of the commands (actions,)."""
    edges: FloatArray
    """(channels,), in the channel's unit."""
    error: float
    """Upper edge of the error of a stretch, scaled like a report's ``heldout_error``."""

    def ratios(self, system: System, forecast: Forecast) -> FloatArray:
        """|error| over the band's edge (channels,): beyond 1 it is outside."""
        with np.errstate(over="ignore", invalid="ignore"):
            found = np.abs(channel_errors(system, forecast)) / (self.edges * _widened(forecast, self.usual))
        return np.asarray(np.nan_to_num(found, nan=1e6, posinf=1e6))


def has_moved(system: System, forecast: Forecast) -> bool:
    """Whether the robot moved, or should have: being stationary says nothing about a model."""
    happened = np.abs(system.difference(forecast.measured, forecast.began)).max()
    expected = np.abs(system.difference(forecast.predicted, forecast.began)).max()
    return bool(max(happened, expected) > _MOVED or not np.isfinite(expected))


def learned_band(system: System, forecasts: Sequence[Forecast], scale: FloatArray | None = None) -> ErrorBand:
    """The band of at least ``_STRETCH`` forecasts in which the robot moved, on their own scale or on a given one."""
    if scale is None:
        spread = np.std([system.difference(item.measured, item.began) for item in forecasts], axis=0)
        scale = np.where(spread > 1e-9, spread, 0.0)
    usual = np.maximum(np.mean([item.variation for item in forecasts], axis=0), 1e-9)
    errors = np.array([channel_errors(system, item) for item in forecasts])
    widened = np.array([_widened(item, usual) for item in forecasts])
    largest = np.maximum((np.abs(errors) / widened[:, None]).max(axis=0), _CONCERN * _by_channel(system, scale))
    stretches = [forecasts[start : start + _STRETCH] for start in range(len(forecasts) - _STRETCH + 1)]
    usually = max([stretch_error(system, part, scale) for part in stretches] + [_CONCERN])
    return ErrorBand(scale, usual, np.maximum(_INFLATION * largest, 1e-9), _INFLATION * usually)


def _widened(forecast: Forecast, usual: FloatArray) -> float:
    """1 + V / 2"""
    return 1.0 + _TRANSIENT * float(np.mean(forecast.variation / usual)) if len(usual) else 1.0


def _by_channel(system: System, scale: FloatArray) -> FloatArray:
    """The scale of each channel: along and across the heading that of the place."""
    found = scale.copy()
    if system.state_names[:2] == ("x", "y"):
        found[:2] = np.sqrt((scale[:2] ** 2).mean())
    return found


_FEWEST = 4
_ONE_WAY = 0.8
"""Share of the errors with one sign from which on they count as one-sided."""
_TURNS = 0.8
"""Correlation with the heading's sine and cosine from which on an error counts as turning with it."""
_TIMES = 1.8
"""Ratio of the errors on both sides of a variable's middle from which on it is named."""


def describe_conditions(system: System, band: ErrorBand, forecasts: Sequence[Forecast], horizon: float) -> str:
    """One sentence about forecasts that were made since the error left its band; empty with fewer than four."""
    if len(forecasts) < _FEWEST:
        return ""
    ratios = np.array([band.ratios(system, item) for item in forecasts])
    worst = int(np.median(ratios, axis=0).argmax())
    errors = np.array([channel_errors(system, item) for item in forecasts])[:, worst]
    name, unit = channels(system)[worst]
    size = float(np.median(np.abs(errors)))
    above, below = float((errors > 0.0).mean()), float((errors < 0.0).mean())
    way = " more" if above >= _ONE_WAY else " less" if below >= _ONE_WAY else ""
    amount = f"{size:.2g}{'' if unit == '1' else ' ' + unit}"
    measured = f"{amount}{way} than predicted" if way else f"{amount} next to the prediction"
    heading = "" if way else _heading(system, forecasts, errors)
    return f"{name}: {measured} after {horizon:g} s{heading or _condition(system, forecasts, errors)}"


def _condition(system: System, forecasts: Sequence[Forecast], errors: FloatArray) -> str:
    """The variable that tells large errors from small ones best, if any does."""
    found = []
    for name, unit, values in _variables(system, forecasts):
        middle = float(np.median(values))
        low, high = np.abs(errors[values <= middle]), np.abs(errors[values > middle])
        if len(low) < 2 or len(high) < 2:
            continue
        below, above = float(low.mean()) + 1e-12, float(high.mean()) + 1e-12
        side = "above" if above > below else "below"
        found.append((max(above / below, below / above), f", most where {name} is {side} {middle:.2g} {unit}".rstrip()))
    times, phrase = max(found, default=(0.0, ""))
    return phrase if times >= _TIMES else ""


def _heading(system: System, forecasts: Sequence[Forecast], errors: FloatArray) -> str:
    """Whether the error has opposite signs in opposite headings: least squares on the heading's cosine and sine."""
    if "yaw" not in system.state_names or len(errors) < 2 * _FEWEST:
        return ""
    yaw = np.array([item.began[system.state_names.index("yaw")] for item in forecasts])
    basis = np.column_stack([np.cos(yaw), np.sin(yaw)])
    if np.ptp(basis, axis=0).max() < 1.0:
        return ""
    (east, north), *_ = np.linalg.lstsq(basis, errors, rcond=None)
    explained = basis @ np.array([east, north])
    whole = float(np.sqrt((explained**2).sum() * (errors**2).sum()))
    if whole <= 0.0 or float(explained @ errors) / whole < _TURNS or np.sign(errors).var() < 0.1:
        return ""
    towards = round(math.degrees(math.atan2(north, east)))  # a whole number: no -0 degrees
    return f", turning with the heading (most towards {towards} degrees)"


def _variables(system: System, forecasts: Sequence[Forecast]) -> list[tuple[str, str, FloatArray]]:
    """Name, unit and values of what may decide: states that are no place and no angle, and the commands."""
    found = []
    for index, variable in enumerate(system.state):
        if variable.name not in ("x", "y") and not variable.angle:
            values = np.array([0.5 * (item.began[index] + item.measured[index]) for item in forecasts])
            found.append((variable.name, variable.unit, values))
    for index, variable in enumerate(system.action):
        found.append((variable.name, variable.unit, np.array([item.actions[index] for item in forecasts])))
    return found


ALPHA: Final = 1e-6
"""In an hour of driving a false finding comes with probability 0.4 % at most, in ten hours with 3.6 %."""
BEYOND: Final = 2.0
"""Times the band's edge."""

_OUTSIDE_PAYS = 0.5 / 0.04
_BEYOND_PAYS = 0.5 / 0.01
_STAKES = (0.3, 0.9)
_MOST = log(1e9)
"""Of the logarithm: more would only make it slower to see that all is well again."""


@final
class EDetector:
    """The e-detector of one robot and model."""

    def __init__(self) -> None:
        self._sums = [0.0 for _ in _STAKES]
        self._walk = 0.0
        self.since: int | None = None
        """Tick from which on the evidence has grown. None while there is none."""

    @property
    def threshold(self) -> float:
        """log(1 / alpha)"""
        return -log(ALPHA)

    @property
    def value(self) -> float:
        """log of the mean of M over the stakes; 0 at the start."""
        mean = sum(self._sums) / len(self._sums)
        return log(mean) if mean > 1.0 else 0.0

    @property
    def raised(self) -> bool:
        """Whether the null hypothesis is given up."""
        return self.value >= self.threshold

    def add(self, ratio: float, start: int) -> None:
        """Takes one forecast: its error over the band's edge, and the tick at which it began."""
        pays = _BEYOND_PAYS if ratio > BEYOND else _OUTSIDE_PAYS if ratio > 1.0 else 0.0
        factors = [1.0 - stake + stake * pays for stake in _STAKES]
        self._sums = [min((own + 1.0) * factor, exp(_MOST)) for own, factor in zip(self._sums, factors, strict=True)]
        self._walk = min(max(0.0, self._walk + log(factors[-1])), _MOST)
        if self._walk == 0.0:
            self.since = None
        elif self.since is None:
            self.since = start


_LEARN = 40
"""Forecasts in which the robot moves, 20 s of them, from which the band is learned."""
_SETTLE = 2
"""Forecasts left out at the start: actuators may remember what no one saw."""
_COVERED_SECONDS = 20.0
_RETAINED = 80


@dataclass(frozen=True)
class VerdictFacts:
    """What of the filter's verdict the watch needs."""

    h_now: float
    h_next: float
    margin: float


@final
class ModelMonitor:
    """Follows one robot and one model; a new model needs a new watch.

    ``scale`` (states,) is that of the watch before, so that errors of both models are told on one scale; ``period`` [s]
    that of the robot's ticks, by default the model's.
    """

    def __init__(
        self, model: PhysicsModel, horizon: float = 1.0, scale: FloatArray | None = None, period: float | None = None
    ) -> None:
        self.model = model
        self.horizon = horizon
        self.band: ErrorBand | None = None
        """None while it is being learned."""
        self.evidence = EDetector()
        self._forecasts = ForecastTracker(model, horizon, period)
        self._seen: deque[Forecast] = deque(maxlen=_RETAINED)
        self._settling = _SETTLE
        self._judged_until = -1
        self._covered: deque[bool] = deque(maxlen=round(_COVERED_SECONDS / (period or model.period)))
        self._decision: tuple[int, VerdictFacts] | None = None
        self._scale = scale

    @property
    def scale(self) -> FloatArray:
        """Standard deviation of the state's change over the horizon (states,): of the band, or of what was seen."""
        if self._scale is not None:
            return self._scale
        difference = self.model.system.difference
        if len(self._seen) < _STRETCH:  # too few to tell a scale from
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
        recent = list(self._seen)[-_STRETCH:]
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
        return describe_conditions(self.model.system, self.band, after, self.horizon)

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

    def observe(self, tick: int, state: FloatArray, applied: FloatArray, latent: FloatArray | None) -> None:
        """Takes one tick: state (states,), what was applied since the last one (actions,), the latent (latents,)."""
        for forecast in self._forecasts.observe(tick, state, applied, latent):
            if self._settling > 0:
                self._settling -= 1
            elif has_moved(self.model.system, forecast):
                self._take(forecast)

    def judge_margin(self, tick: int, decision: VerdictFacts | None, *, obeyed: bool = True) -> None:
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
