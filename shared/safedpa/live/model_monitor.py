"""The model monitor of one robot: error band, sequential test, and empirical coverage of the filter's margin.

``ErrorBand`` is the band of usual errors, ``EDetector`` the sequential test of whether the error has left the band,
``ModelMonitor`` combines both, and ``describe_conditions`` describes where the model fails.

In each second of driving, one forecast that overlaps no other is inside its band (0), outside (1) or beyond twice the
band (2). The null hypothesis is that, whatever the past,

    P(outside or beyond | past) <= 5 %   and   P(beyond | past) <= 1 %

Then e = 1 - s + s (0, 12.5 or 50), the last factor by what happened, has a mean of at most 1 for every stake s in
[0, 1], and M[n] = (M[n-1] + 1) e[n] (Shiryaev and Roberts) is an e-detector: M[n] - n is a supermartingale. By Doob's
inequality P(M reaches 1/alpha within n seconds) <= n alpha, and the mean time to a false finding is at least 1/alpha
seconds. No independence is assumed. The 5 % and 1 % leave room for the similarity of successive seconds of a drive; the
actual rate for a band learned from n forecasts is much lower.

Source: Shin, Ramdas and Rinaldo, E-detectors: a nonparametric framework for sequential change detection, 2023.

The band is what the model's error usually is, learned from a stretch of driving.

For each channel c the band reaches to

    edge_c (1 + V / 2),   edge_c = 1.5 max(largest |error_c| / (1 + V / 2) of the learned forecasts, 0.04 scale_c)

V is the variation of the commands during a forecast relative to its average. A model has larger errors in transients,
and a quiet period of driving must not make the next manoeuvre look like a fault. scale is the standard deviation of the
state's change over the horizon; errors below 4 % of it are irrelevant.

The largest of n exchangeable scores is exceeded by the next one with probability 1 / (n + 1), whatever their
distribution (split conformal prediction with a normalised score: Lei et al., Distribution-free predictive inference
for regression, 2018). The factor 1.5 allows for the fact that the seconds of one drive are not exchangeable.
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
from safedpa.bus import VerdictMessage
from safedpa.dynamics import PhysicsModel
from safedpa.live.forecasts import Forecast, ForecastTracker, channel_errors, channels, stretch_error
from safedpa.systems import System

# Number of forecasts whose common error is reported. They last one second and begin every half second: five seconds.
_STRETCH: Final = 10

# Constants of the band, see the equation above: factor on the largest learned error, lower limit relative to the scale
# of a channel, and weight of the variation of the commands.
_INFLATION = 1.5
_CONCERN = 0.04
_TRANSIENT = 0.5
# Change of a state in a second, in its own unit (m, rad, m/s, ...), below which the robot counts as stationary.
_MOVED = 0.05


@dataclass(frozen=True)
class ErrorBand:
    """The learned error band of a robot and its model."""

    scale: FloatArray
    """Standard deviation of the state's change over the horizon (states,)."""
    usual: FloatArray
    """Mean variation of the commands (actions,)."""
    edges: FloatArray
    """Edge of the band by channel (channels,), in the channel's unit."""
    error: float
    """Upper limit of the error of a stretch, scaled like ``heldout_error`` of a report."""

    def ratios(self, system: System, forecast: Forecast) -> FloatArray:
        """Returns |error| / edge of the band (channels,); above 1 the error is outside."""
        with np.errstate(over="ignore", invalid="ignore"):
            found = np.abs(channel_errors(system, forecast)) / (self.edges * _widened(forecast, self.usual))
        return np.asarray(np.nan_to_num(found, nan=1e6, posinf=1e6))


def has_moved(system: System, forecast: Forecast) -> bool:
    """Whether the robot moved or should have moved. A stationary robot gives no information about its model."""
    happened = np.abs(system.difference(forecast.measured, forecast.began)).max()
    expected = np.abs(system.difference(forecast.predicted, forecast.began)).max()
    return bool(max(happened, expected) > _MOVED or not np.isfinite(expected))


def learned_band(system: System, forecasts: Sequence[Forecast], scale: FloatArray | None = None) -> ErrorBand:
    """Returns the band of at least ``_STRETCH`` forecasts in which the robot moved, by default on their own scale."""
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
    """Returns 1 + V / 2 with the relative variation V of the commands."""
    return 1.0 + _TRANSIENT * float(np.mean(forecast.variation / usual)) if len(usual) else 1.0


def _by_channel(system: System, scale: FloatArray) -> FloatArray:
    """Returns the scale of each channel; along and across the heading, that of the position."""
    found = scale.copy()
    if system.state_names[:2] == ("x", "y"):
        found[:2] = np.sqrt((scale[:2] ** 2).mean())
    return found


_FEWEST = 4
# Share of errors with the same sign from which they count as one-sided.
_ONE_SIDED = 0.8
# Correlation with the sine and cosine of the heading from which an error counts as turning with the heading.
_TURNS = 0.8
# Ratio of the errors above and below a variable's median from which the variable is named.
_RATIO = 1.8


def describe_conditions(system: System, band: ErrorBand, forecasts: Sequence[Forecast], horizon: float) -> str:
    """Describes the errors of forecasts since the error left its band; empty with fewer than four forecasts."""
    if len(forecasts) < _FEWEST:
        return ""
    ratios = np.array([band.ratios(system, item) for item in forecasts])
    worst = int(np.median(ratios, axis=0).argmax())
    errors = np.array([channel_errors(system, item) for item in forecasts])[:, worst]
    name, unit = channels(system)[worst]
    size = float(np.median(np.abs(errors)))
    above, below = float((errors > 0.0).mean()), float((errors < 0.0).mean())
    way = " more" if above >= _ONE_SIDED else " less" if below >= _ONE_SIDED else ""
    amount = f"{size:.2g}{'' if unit == '1' else ' ' + unit}"
    measured = f"{amount}{way} than predicted" if way else f"{amount} next to the prediction"
    heading = "" if way else _heading(system, forecasts, errors)
    return f"{name}: {measured} after {horizon:g} s{heading or _condition(system, forecasts, errors)}"


def _condition(system: System, forecasts: Sequence[Forecast], errors: FloatArray) -> str:
    """Describes the variable that separates large from small errors best, if one does."""
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
    return phrase if times >= _RATIO else ""


def _heading(system: System, forecasts: Sequence[Forecast], errors: FloatArray) -> str:
    """Describes an error with opposite signs in opposite headings, by least squares on the heading's cosine and
    sine."""
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
    """Yields name, unit and values of the variables to test: commands, and states except positions and angles."""
    found = []
    for index, variable in enumerate(system.state):
        if variable.name not in ("x", "y") and not variable.angle:
            values = np.array([0.5 * (item.began[index] + item.measured[index]) for item in forecasts])
            found.append((variable.name, variable.unit, values))
    for index, variable in enumerate(system.action):
        found.append((variable.name, variable.unit, np.array([item.actions[index] for item in forecasts])))
    return found


ALPHA: Final = 1e-6
"""Rate of false findings per second: at most 0.4 % in an hour of driving, 3.6 % in ten hours."""
BEYOND: Final = 2.0
"""Multiple of the band's edge that counts as far outside."""

# Payoffs of the bet against the null hypothesis, chosen so that the expected factor is at most 1 (see the module).
_OUTSIDE_PAYOFF = 0.5 / 0.04
_BEYOND_PAYOFF = 0.5 / 0.01
_STAKES = (0.3, 0.9)
# Cap of the logarithm of the evidence. More evidence would only delay the return to normal.
_MOST = log(1e9)


@final
class EDetector:
    """The sequential test of one robot and model."""

    def __init__(self) -> None:
        self._sums = [0.0 for _ in _STAKES]
        self._walk = 0.0
        self.since: int | None = None
        """Tick since which the evidence has grown; None without evidence."""

    @property
    def threshold(self) -> float:
        """The threshold log(1 / alpha)."""
        return -log(ALPHA)

    @property
    def value(self) -> float:
        """Logarithm of the mean of M over the stakes; 0 at the start."""
        mean = sum(self._sums) / len(self._sums)
        return log(mean) if mean > 1.0 else 0.0

    @property
    def raised(self) -> bool:
        """Whether the null hypothesis is rejected."""
        return self.value >= self.threshold

    def add(self, ratio: float, start: int) -> None:
        """Adds one forecast with its ratio of error to band edge and its first tick."""
        pays = _BEYOND_PAYOFF if ratio > BEYOND else _OUTSIDE_PAYOFF if ratio > 1.0 else 0.0
        factors = [1.0 - stake + stake * pays for stake in _STAKES]
        self._sums = [min((own + 1.0) * factor, exp(_MOST)) for own, factor in zip(self._sums, factors, strict=True)]
        self._walk = min(max(0.0, self._walk + log(factors[-1])), _MOST)
        if self._walk == 0.0:
            self.since = None
        elif self.since is None:
            self.since = start


# Forecasts with motion from which the band is learned: 20 s of driving.
_LEARN = 40
# Forecasts ignored at the start, because the initial state of the actuators is unknown.
_SETTLE = 2
# Window of the empirical coverage.
_COVERED_SECONDS = 20.0
# Forecasts retained to locate a change: 40 s of driving.
_RETAINED = 80


@final
class ModelMonitor:
    """Monitors one model of one robot; a new model needs a new monitor.

    ``scale`` (states,) is that of the previous monitor, so that the errors of both models are comparable. ``period``
    [s] is the robot's, by default the model's.
    """

    def __init__(
        self, model: PhysicsModel, horizon: float = 1.0, scale: FloatArray | None = None, period: float | None = None
    ) -> None:
        self.model = model
        self.horizon = horizon
        self.band: ErrorBand | None = None
        """The error band; None while it is being learned."""
        self.evidence = EDetector()
        self._forecasts = ForecastTracker(model, horizon, period)
        self._seen: deque[Forecast] = deque(maxlen=_RETAINED)
        self._settling = _SETTLE
        self._judged_until = -1
        self._covered: deque[bool] = deque(maxlen=round(_COVERED_SECONDS / (period or model.period)))
        self._decision: tuple[int, VerdictMessage] | None = None
        self._scale = scale

    @property
    def scale(self) -> FloatArray:
        """Standard deviation of the state's change over the horizon (states,), of the band or of the data so far."""
        if self._scale is not None:
            return self._scale
        difference = self.model.system.difference
        if len(self._seen) < _STRETCH:  # too few to estimate a scale
            return np.zeros(len(self.model.system.state))
        return np.asarray(np.std([difference(item.measured, item.began) for item in self._seen], axis=0))

    @property
    def learned_share(self) -> float:
        """Share of the data for learning the band that is available, 0 to 1."""
        return 1.0 if self.band is not None else len(self._seen) / _LEARN

    @property
    def seconds_to_learn(self) -> float:
        """Time of driving in s until the band is learned, with a forecast per half horizon; 0 once it is."""
        return (1.0 - self.learned_share) * _LEARN * 0.5 * self.horizon

    @property
    def error(self) -> float:
        """Error of the last stretch over one horizon, scaled like ``heldout_error`` of a report; 0 before the first."""
        recent = list(self._seen)[-_STRETCH:]
        return stretch_error(self.model.system, recent, self.scale)

    @property
    def is_measured(self) -> bool:
        """Whether ``error`` is that of a forecast; before the first one and without a scale it is 0."""
        return bool(self._seen) and bool((self.scale > 0.0).any())

    @property
    def coverage(self) -> float:
        """Share of the steps of the last 20 s after which h was at least the prediction minus the margin."""
        return sum(self._covered) / len(self._covered) if self._covered else 1.0

    @property
    def where(self) -> str:
        """Description of where the model fails; empty without evidence that it does."""
        since = self.evidence.since
        if self.band is None or since is None:
            return ""
        after = [item for item in self._seen if item.start >= since]
        return describe_conditions(self.model.system, self.band, after, self.horizon)

    def changed_at(self) -> int | None:
        """Returns the first tick of the first forecast affected by the change; None without evidence.

        This is the least-squares change point of the logarithm of the errors relative to the band.
        """
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
        """Handles one tick: state (states,), action applied since the last one (actions,), and latent (latents,)."""
        for forecast in self._forecasts.observe(tick, state, applied, latent):
            if self._settling > 0:
                self._settling -= 1
            elif has_moved(self.model.system, forecast):
                self._take(forecast)

    def judge_margin(self, tick: int, decision: VerdictMessage | None, *, obeyed: bool = True) -> None:
        """Compares the filter's prediction of one tick ago with h now; ``decision`` is None without a verdict.

        ``obeyed`` is whether the robot applied the filter's action since then.
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
