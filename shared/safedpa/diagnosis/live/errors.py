"""The error of one forecast, and of a stretch of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from safedpa.diagnosis.live.forecasts import Forecast
from safedpa.systems import System

__all__ = ["channel_errors", "channels", "stretch_error"]

Vector = NDArray[np.float64]

_PLANE = ("x", "y", "yaw")


def channels(system: System) -> tuple[tuple[str, str], ...]:
    """Name and unit of the entries of ``channel_errors``: of a robot in the plane along and across its heading."""
    own = [(variable.name, variable.unit) for variable in system.state]
    if system.state_names[:3] != _PLANE:
        return tuple(own)
    return (("place along the heading", "m"), ("place across the heading", "m"), *own[2:])


def channel_errors(system: System, forecast: Forecast) -> Vector:
    """measured - predicted (channels,), the place turned into the frame of the start's heading."""
    error = system.difference(forecast.measured, forecast.predicted)
    if system.state_names[:3] == _PLANE:
        cosine, sine = np.cos(forecast.began[2]), np.sin(forecast.began[2])
        error[:2] = cosine * error[0] + sine * error[1], cosine * error[1] - sine * error[0]
    return error


def stretch_error(system: System, forecasts: Sequence[Forecast], scale: Vector) -> float:
    """Root mean square error of each state over ``scale`` (states,), mean over the states whose scale is not 0.

    The same number as a report's ``heldout_error``, without its trimming: a stretch has few forecasts.
    """
    moved = scale > 0.0
    if not forecasts or not moved.any():
        return 0.0
    errors = np.array([system.difference(item.measured, item.predicted) for item in forecasts])
    with np.errstate(over="ignore", invalid="ignore"):
        found = np.sqrt((errors[:, moved] ** 2).mean(axis=0)) / scale[moved]
    return float(min(found.mean(), 1e6)) if not np.isnan(found).any() else 1e6
