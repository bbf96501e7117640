"""Where a running model fails, in words: which entry of the state, which way, and under which condition."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from safedpa.diagnosis.live.band import Band
from safedpa.diagnosis.live.errors import channel_errors, channels
from safedpa.diagnosis.live.forecasts import Forecast
from safedpa.systems import System

__all__ = ["place_in_words"]

Vector = NDArray[np.float64]

_FEWEST = 4
_ONE_WAY = 0.8
"""Share of the errors with one sign from which on they count as one-sided."""
_TURNS = 0.8
"""Correlation with the heading's sine and cosine from which on an error counts as turning with it."""
_TIMES = 1.8
"""Ratio of the errors on both sides of a variable's middle from which on it is named."""


def place_in_words(system: System, band: Band, forecasts: Sequence[Forecast], horizon: float) -> str:
    """One sentence about forecasts that were made since the error left its band; empty with fewer than four."""
    if len(forecasts) < _FEWEST:
        return ""
    ratios = np.array([band.ratios(system, item) for item in forecasts])
    worst = int(np.median(ratios, axis=0).argmax())
    errors = np.array([channel_errors(system, item) for item in forecasts])[:, worst]
    name, unit = channels(system)[worst]
    size = float(np.median(np.abs(errors)))
    share = float((errors > 0.0).mean())
    way = " more" if share >= _ONE_WAY else " less" if share <= 1.0 - _ONE_WAY else ""
    amount = f"{size:.2g}{'' if unit == '1' else ' ' + unit}"
    measured = f"{amount}{way} than predicted" if way else f"{amount} beside the prediction"
    heading = "" if way else _heading(system, forecasts, errors)
    return f"{name}: {measured} after {horizon:g} s{heading or _condition(system, forecasts, errors)}"


def _condition(system: System, forecasts: Sequence[Forecast], errors: Vector) -> str:
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
    times, words = max(found, default=(0.0, ""))
    return words if times >= _TIMES else ""


def _heading(system: System, forecasts: Sequence[Forecast], errors: Vector) -> str:
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
    return f", turning with the heading (most towards {np.degrees(np.arctan2(north, east)):.0f} degrees)"


def _variables(system: System, forecasts: Sequence[Forecast]) -> list[tuple[str, str, Vector]]:
    """Name, unit and values of what may decide: states that are no place and no angle, and the commands."""
    found = []
    for index, variable in enumerate(system.state):
        if variable.name not in ("x", "y") and not variable.angle:
            values = np.array([0.5 * (item.began[index] + item.measured[index]) for item in forecasts])
            found.append((variable.name, variable.unit, values))
    for index, variable in enumerate(system.action):
        found.append((variable.name, variable.unit, np.array([item.actions[index] for item in forecasts])))
    return found
