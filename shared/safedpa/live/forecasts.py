"""Open-loop predictions of a running robot over one horizon, and their errors.

x[k+1] = model(x[k], a[k], z) from a measured start, with the applied actions and the latent known at the start. The
measurements in between are not used. Two predictions run concurrently, with one model step each per period.
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

_PLANE = ("x", "y", "yaw")


def channels(system: System) -> tuple[tuple[str, str], ...]:
    """Returns name and unit of the entries of ``channel_errors``; in the plane, position errors are along and across
    the heading."""
    own = [(variable.name, variable.unit) for variable in system.state]
    if system.state_names[:3] != _PLANE:
        return tuple(own)
    return (("position along the heading", "m"), ("position across the heading", "m"), *own[2:])


def channel_errors(system: System, forecast: Forecast) -> FloatArray:
    """Returns measured - predicted (channels,), with the position error in the frame of the initial heading."""
    error = system.difference(forecast.measured, forecast.predicted)
    if system.state_names[:3] == _PLANE:
        cosine, sine = np.cos(forecast.began[2]), np.sin(forecast.began[2])
        error[:2] = cosine * error[0] + sine * error[1], cosine * error[1] - sine * error[0]
    return error


def stretch_error(system: System, forecasts: Sequence[Forecast], scale: FloatArray) -> float:
    """Returns the RMS error of each state divided by ``scale`` (states,), averaged over states with a non-zero scale.

    Same definition as ``heldout_error`` of a report, but without its trimming, because a stretch has few forecasts.
    """
    moved = scale > 0.0
    if not forecasts or not moved.any():
        return 0.0
    errors = np.array([system.difference(item.measured, item.predicted) for item in forecasts])
    with np.errstate(over="ignore", invalid="ignore"):
        found = np.sqrt((errors[:, moved] ** 2).mean(axis=0)) / scale[moved]
    return float(min(found.mean(), 1e6)) if not np.isnan(found).any() else 1e6


# Concurrent predictions: one starts in each half of the horizon.
_CONCURRENT = 2


@dataclass(frozen=True)
class Forecast:
    """A completed prediction."""

    start: int
    """Tick of the measured start."""
    end: int
    """Tick of the comparison."""
    began: FloatArray
    """Measured state at the start (states,)."""
    measured: FloatArray
    """Measured state at the end (states,)."""
    predicted: FloatArray
    """Predicted state at the end (states,)."""
    actions: FloatArray
    """Mean of the applied actions (actions,)."""
    variation: FloatArray
    """Total variation of the applied actions (actions,), which determines how demanding the prediction is."""


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
    """Runs the predictions for one robot with the period ``period`` [s], by default the model's.

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
        """Handles the state (states,) of a tick and the action applied since the last one (actions,).

        Returns the completed predictions. After a gap in the ticks or an implausible state, all predictions restart.
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
        # The actuators' internal state does not depend on the robot's state, so one model step from any state updates
        # it.
        if memory:
            memory = model.advance(last.state, applied, memory, latent, period=self._period)[1]
        last.memory = memory
        last.tick, last.state, last.action = tick, state, applied
        return ended

    def _begin(self, last: _Last, tick: int, state: FloatArray, latent: FloatArray | None) -> None:
        newest = max((own.start for own in last.running), default=None)
        if newest is None or tick - newest >= self.steps / _CONCURRENT:
            none = np.zeros(len(self._model.system.action))
            last.running.append(_Running(tick, state, state, last.memory, latent, none, none))
