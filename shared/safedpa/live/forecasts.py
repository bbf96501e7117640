"""Open-loop predictions of one running robot, one horizon ahead, compared with what happened.

x[k+1] = model(x[k], a[k], z), from a measured start, with the actions that were applied and the latent that was known
at the start; nothing is looked at later. A few predictions run side by side, one model step each in every period.

And their errors: of one forecast, and of a stretch of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.dynamics import PhysicsModel
from safedpa.errors import InputError
from safedpa.systems import System

__all__ = ["Forecast", "ForecastTracker", "channel_errors", "channels", "stretch_error"]


_PLANE = ("x", "y", "yaw")


def channels(system: System) -> tuple[tuple[str, str], ...]:
    """Name and unit of the entries of ``channel_errors``: of a robot in the plane along and across its heading."""
    own = [(variable.name, variable.unit) for variable in system.state]
    if system.state_names[:3] != _PLANE:
        return tuple(own)
    return (("place along the heading", "m"), ("place across the heading", "m"), *own[2:])


def channel_errors(system: System, forecast: Forecast) -> FloatArray:
    """measured - predicted (channels,), the place turned into the frame of the start's heading."""
    error = system.difference(forecast.measured, forecast.predicted)
    if system.state_names[:3] == _PLANE:
        cosine, sine = np.cos(forecast.began[2]), np.sin(forecast.began[2])
        error[:2] = cosine * error[0] + sine * error[1], cosine * error[1] - sine * error[0]
    return error


def stretch_error(system: System, forecasts: Sequence[Forecast], scale: FloatArray) -> float:
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


_SIDE_BY_SIDE = 2
"""Predictions that run at a time: one begins in every half of the horizon."""


@dataclass(frozen=True)
class Forecast:
    """One prediction that has come to its end."""

    start: int
    """Tick of the measured start."""
    end: int
    """Tick with which it is compared."""
    began: FloatArray
    """Measured state at the start (states,)."""
    measured: FloatArray
    """Measured state at the end (states,)."""
    predicted: FloatArray
    """(states,)"""
    actions: FloatArray
    """Mean of what was applied (actions,)."""
    variation: FloatArray
    """Sum of the changes of what was applied, without sign (actions,): what a window asks of a model."""


@dataclass
class _Running:
    start: int
    began: FloatArray
    state: FloatArray
    memory: Any
    latent: FloatArray | None
    summed: FloatArray
    variation: FloatArray


@dataclass
class _Last:
    tick: int
    state: FloatArray
    action: FloatArray | None = None
    memory: Any = None
    running: list[_Running] = field(default_factory=list)


@final
class ForecastTracker:
    """Follows one robot with a tick every ``period`` [s], by default the model's.

    Raises InputError for a horizon shorter than two periods.
    """

    def __init__(self, model: PhysicsModel, horizon: float = 1.0, period: float | None = None) -> None:
        self._model = model
        self._period = model.period if period is None else period
        self.steps = round(horizon / self._period)
        if self.steps < 2:
            raise InputError(f"horizon: got {horizon} s, wanted at least two periods of {self._period:g} s")
        self._last: _Last | None = None

    def observe(self, tick: int, state: FloatArray, applied: FloatArray, latent: FloatArray | None) -> list[Forecast]:
        """Takes the state (states,) of a tick and what was applied since the last one (actions,).

        Returns what came to its end. After a gap in the ticks, or a state that cannot be believed, all begins again.
        """
        last = self._last
        if not self._model.system.is_plausible(state) or not np.isfinite(applied).all():
            self._last = None
            return []
        if last is None or tick != last.tick + 1:
            self._last = _Last(tick, state)
            return []
        ended = self._onward(last, tick, state, applied, latent)
        self._begin(last, tick, state, latent)
        return ended

    def _onward(
        self, last: _Last, tick: int, state: FloatArray, applied: FloatArray, latent: FloatArray | None
    ) -> list[Forecast]:
        model = self._model
        memory = model.initial_memory(applied, latent) if last.action is None else last.memory
        change = np.zeros(len(applied)) if last.action is None else np.abs(applied - last.action)
        ended = []
        for own in last.running:
            own.state, own.memory = model.advance(
                own.state, applied, own.memory, own.latent, period=self._period, time=(tick - 1) * self._period
            )
            own.summed = own.summed + applied
            own.variation = own.variation + change
            if tick - own.start >= self.steps:
                mean = own.summed / (tick - own.start)
                ended.append(Forecast(own.start, tick, own.began, state, own.state, mean, own.variation))
        last.running = [own for own in last.running if tick - own.start < self.steps]
        # what the actuators remember does not depend on the state: one step of the model tells it
        if memory:
            memory = model.advance(last.state, applied, memory, latent, period=self._period)[1]
        last.memory = memory
        last.tick, last.state, last.action = tick, state, applied
        return ended

    def _begin(self, last: _Last, tick: int, state: FloatArray, latent: FloatArray | None) -> None:
        newest = max((own.start for own in last.running), default=None)
        if newest is None or tick - newest >= self.steps / _SIDE_BY_SIDE:
            none = np.zeros(len(self._model.system.action))
            last.running.append(_Running(tick, state, state, last.memory, latent, none, none))
