"""What a model's error usually is: the band that is learned from a stretch of driving.

For each channel c the band reaches to

    edge_c (1 + V / 2),   edge_c = 1.5 max(largest |error_c| / (1 + V / 2) of the learned forecasts, 0.04 scale_c)

V is how much the commands moved during a forecast, over what they did on average: a model errs more in transients, and
a stretch of quiet driving must not make the next manoeuvre look like a fault. scale is the standard deviation of the
state's change over the horizon; an error below a twenty-fifth of that is nobody's concern.

The largest of n exchangeable scores is exceeded by the next one with probability 1 / (n + 1), whatever their
distribution (split conformal prediction with a normalised score: Lei et al., Distribution-free predictive inference
for regression, 2018); the factor 1.5 is for the fact that seconds of one drive are not exchangeable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from safedpa.diagnosis.live.errors import channel_errors, stretch_error
from safedpa.diagnosis.live.forecasts import Forecast
from safedpa.systems import System

__all__ = ["STRETCH", "Band", "learned_band", "moved"]

Vector = NDArray[np.float64]

STRETCH: Final = 10
"""Forecasts of one second, begun every half second, whose common error is told: five seconds."""

_INFLATION = 1.5
_CONCERN = 0.04
_TRANSIENT = 0.5
_MOVED = 0.05
"""In the unit of some state's entry (m, rad, m/s, ...): less in a second is standing still."""


@dataclass(frozen=True)
class Band:
    """The learned band of one robot and model."""

    scale: Vector
    """Standard deviation of the state's change over the horizon (states,)."""
    usual: Vector
    """Mean variation of the commands (actions,)."""
    edges: Vector
    """(channels,), in the channel's unit."""
    error: float
    """Upper edge of the error of a stretch, scaled like a report's ``heldout_error``."""

    def ratios(self, system: System, forecast: Forecast) -> Vector:
        """|error| over the band's edge (channels,): beyond 1 it is outside."""
        with np.errstate(over="ignore", invalid="ignore"):
            found = np.abs(channel_errors(system, forecast)) / (self.edges * _widened(forecast, self.usual))
        return np.asarray(np.nan_to_num(found, nan=1e6, posinf=1e6))


def moved(system: System, forecast: Forecast) -> bool:
    """Whether the robot moved, or should have: standing still says nothing about a model."""
    happened = np.abs(system.difference(forecast.measured, forecast.began)).max()
    expected = np.abs(system.difference(forecast.predicted, forecast.began)).max()
    return bool(max(happened, expected) > _MOVED or not np.isfinite(expected))


def learned_band(system: System, forecasts: Sequence[Forecast], scale: Vector | None = None) -> Band:
    """The band of at least ``STRETCH`` forecasts in which the robot moved, on their own scale or on a given one."""
    if scale is None:
        spread = np.std([system.difference(item.measured, item.began) for item in forecasts], axis=0)
        scale = np.where(spread > 1e-9, spread, 0.0)
    usual = np.maximum(np.mean([item.variation for item in forecasts], axis=0), 1e-9)
    errors = np.array([channel_errors(system, item) for item in forecasts])
    widened = np.array([_widened(item, usual) for item in forecasts])
    largest = np.maximum((np.abs(errors) / widened[:, None]).max(axis=0), _CONCERN * _by_channel(system, scale))
    stretches = [forecasts[start : start + STRETCH] for start in range(len(forecasts) - STRETCH + 1)]
    usually = max([stretch_error(system, part, scale) for part in stretches] + [_CONCERN])
    return Band(scale, usual, np.maximum(_INFLATION * largest, 1e-9), _INFLATION * usually)


def _widened(forecast: Forecast, usual: Vector) -> float:
    """1 + V / 2"""
    return 1.0 + _TRANSIENT * float(np.mean(forecast.variation / usual)) if len(usual) else 1.0


def _by_channel(system: System, scale: Vector) -> Vector:
    """The scale of each channel: along and across the heading that of the place."""
    found = scale.copy()
    if system.state_names[:2] == ("x", "y"):
        found[:2] = np.sqrt((scale[:2] ** 2).mean())
    return found
