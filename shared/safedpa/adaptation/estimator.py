"""Recursive estimation of a model's free parameters from the last transitions.

An extended Kalman filter whose state is the latent z itself, taken as a slow random walk:

    z[t+1] = z[t] + w,  w ~ N(0, Q);    x[t+1] = step(x[t], a[t], z[t]) + v,  v ~ N(0, R)

with the sensitivity d(step)/dz by finite differences. An innovation beyond four standard deviations is weighted down
(Huber), so that a push or a tracking glitch does not throw the estimate. A robot that does not move teaches nothing:
held by a wall it looks like one with an immense load. Source: Simon, Optimal State Estimation,
sections 13.2 and 13.4 (parameter estimation).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from safedpa.adaptation.abstract import AbstractEstimator, check_transition
from safedpa.dynamics import PhysicsModel
from safedpa.errors import InputError

__all__ = ["EstimatorSettings", "LatentEstimator"]

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class EstimatorSettings:
    """How far the estimate is trusted, and how fast the world may change.

    Deviations of the parameters are in units of their typical size; of the measurements in the state's units per step.
    """

    initial_deviation: float = 0.5
    drift_per_second: float = 0.15
    """Standard deviation of the random walk after one second."""
    measurement_deviation: tuple[float, ...] = (0.01, 0.01, 0.01, 0.03)
    largest_innovation: float = 4.0
    """Standard deviations from which an innovation is weighted down."""
    smallest_motion: float = 1.0
    """Measurement deviations by which some entry of the state must change for a transition to teach anything."""

    def __post_init__(self) -> None:
        scales = (self.initial_deviation, self.drift_per_second, self.largest_innovation, self.smallest_motion)
        if not all(np.isfinite(number) and number > 0.0 for number in (*scales, *self.measurement_deviation)):
            raise InputError(f"estimator settings: got {self}, wanted positive numbers")


_SETTINGS = {"pendulum": EstimatorSettings(measurement_deviation=(0.001, 0.02))}
"""Of robots whose state is not the car's; rad and rad/s."""


@final
class LatentEstimator(AbstractEstimator):
    """Estimates the free parameters of a model by the extended Kalman filter above."""

    quick = False

    def __init__(self, model: PhysicsModel, settings: EstimatorSettings | None = None) -> None:
        settings = settings or _SETTINGS.get(model.system.name, EstimatorSettings())
        if len(settings.measurement_deviation) != len(model.system.state):
            raise InputError(
                f"measurement_deviation: got {len(settings.measurement_deviation)} entries, "
                f"wanted {len(model.system.state)} ({', '.join(model.system.state_names)})"
            )
        self._model = model
        self._settings = settings
        chosen = [model.parameters[path] for path in model.latent_names]
        self._low = np.array([parameter.low for parameter in chosen])
        self._high = np.array([parameter.high for parameter in chosen])
        self._typical = np.array([parameter.typical or 0.1 * (parameter.high - parameter.low) for parameter in chosen])
        self._measured = np.array(settings.measurement_deviation)
        self._noise = np.diag(np.square(settings.measurement_deviation))
        self._drift = np.square(settings.drift_per_second * self._typical)
        self._limit = np.square(settings.initial_deviation * self._typical)
        self._unit = np.eye(len(chosen))
        self.latent: Vector = model.latent.copy()
        self._covariance = np.diag(np.square(settings.initial_deviation * self._typical))
        self._memory: Any = None

    @property
    def deviations(self) -> Vector:  # noqa: D102
        return np.asarray(np.sqrt(self._covariance.diagonal()))

    def update(self, state: Vector, action: Vector, next_state: Vector, period: float) -> None:  # noqa: D102
        check_transition(state, action, next_state, period)
        memory = self._model.initial_memory(action) if self._memory is None else self._memory
        predicted, self._memory = self._model.advance(state, action, memory, self.latent, period=period)
        if not len(self.latent):
            return
        self._covariance = self._limited(self._covariance + np.diag(self._drift * period))
        motion = np.abs(self._model.system.difference(next_state, state)) / self._measured
        if motion.max() >= self._settings.smallest_motion:
            sensitivity = self._sensitivity(state, action, memory, predicted, period)
            self._correct(self._model.system.difference(next_state, predicted), sensitivity)

    def _correct(self, innovation: Vector, sensitivity: Vector) -> None:
        """The filter's measurement update: innovation (states,), sensitivity (states, latents)."""
        spread = sensitivity @ self._covariance @ sensitivity.T + self._noise
        gain = np.linalg.solve(spread, sensitivity @ self._covariance).T
        step = gain @ self._weighted_down(innovation, spread)
        self.latent = np.clip(self.latent + step, self._low, self._high)
        keep = self._unit - gain @ sensitivity
        self._covariance = keep @ self._covariance @ keep.T + gain @ self._noise @ gain.T

    def _limited(self, covariance: Vector) -> Vector:
        """Without excitation the covariance must not grow for ever: at most what was unknown at first."""
        excess = np.sqrt(np.minimum(1.0, self._limit / covariance.diagonal()))
        limited: Vector = covariance * (excess[:, np.newaxis] * excess)
        return limited

    def forget_transient(self) -> None:
        """Takes the actuators as settled at the next action."""
        self._memory = None

    def _sensitivity(self, state: Vector, action: Vector, memory: Any, predicted: Vector, period: float) -> Vector:
        columns = []
        for index in range(len(self.latent)):
            nudge = 1e-4 * self._typical[index]
            nudge = -nudge if self.latent[index] + nudge > self._high[index] else nudge
            latent = self.latent.copy()
            latent[index] += nudge
            moved, _ = self._model.advance(state, action, memory, latent, period=period)
            columns.append((moved - predicted) / nudge)
        return np.array(columns).T

    def _weighted_down(self, innovation: Vector, spread: Vector) -> Vector:
        size = float(np.sqrt(innovation @ np.linalg.solve(spread, innovation) / len(innovation)))
        return innovation * min(1.0, self._settings.largest_innovation / max(size, 1e-12))
