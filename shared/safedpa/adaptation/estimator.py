"""Recursive estimation of a model's free parameters by an extended Kalman filter.

The state of the filter is the latent z, modelled as a slow random walk:

    z[t+1] = z[t] + w,  w ~ N(0, Q);    x[t+1] = step(x[t], a[t], z[t]) + v,  v ~ N(0, R)

with the sensitivity d(step)/dz by finite differences. An innovation beyond four standard deviations gets a lower weight
(Huber), so that a push or a tracking error does not disturb the estimate. Transitions without motion are ignored: a
robot held by a wall would look like one with an immense load. Source: Simon, Optimal State Estimation, sections 13.2
and 13.4 (parameter estimation).

There are only a few parameters, so the implementation uses Python floats instead of NumPy arrays, and since R is
diagonal, it processes the entries of the state sequentially (``LatentCovariance``). Small matrices in NumPy would take
five times as long.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from math import ceil, isfinite, pi, sqrt
from typing import Any, final

import numpy as np

from safedpa.adaptation.abstract import AbstractEstimator, check_transition
from safedpa.arrays import FloatArray
from safedpa.dynamics import PhysicsModel
from safedpa.errors import InputError
from safedpa.systems.robots import robots

__all__ = ["EstimatorSettings", "LatentCovariance", "LatentEstimator"]


@final
class LatentCovariance:
    """The covariance P (latents, latents) of slowly varying parameters.

    ``start`` has the initial variances, which are also the maximum; ``drift`` the growth of each variance per second.
    """

    def __init__(self, start: Sequence[float], drift: Sequence[float]) -> None:
        self._limit, self._drift = list(start), list(drift)
        self._places = _upper(len(start))
        self._diagonal = [self._places.index((entry, entry)) for entry in range(len(start))]
        self._covariance = [start[row] if row == column else 0.0 for row, column in self._places]
        """The upper triangle of P, row by row."""

    def variances(self) -> list[float]:
        """Returns the diagonal of P (latents,), at least 0."""
        return [max(self._covariance[place], 0.0) for place in self._diagonal]

    def spread(self, seconds: float) -> None:
        """Adds Q times ``seconds`` to P, and limits the variances to the initial ones."""
        # Without excitation, P would otherwise grow without limit, and the first informative transition would make the
        # estimate jump. Rows and columns are scaled together, which preserves the correlations.
        covariance, excess = self._covariance, False
        for place, drift, limit in zip(self._diagonal, self._drift, self._limit, strict=True):
            covariance[place] += drift * seconds
            excess = excess or covariance[place] > limit
        if excess:
            variances = [covariance[place] for place in self._diagonal]
            shrink = [sqrt(min(1.0, limit / value)) for value, limit in zip(variances, self._limit, strict=True)]
            for place, (row, column) in enumerate(self._places):
                covariance[place] *= shrink[row] * shrink[column]

    def correct(
        self, innovation: Sequence[float], sensitivity: Sequence[Sequence[float]], noise: Sequence[float]
    ) -> tuple[list[float], float]:
        """Updates P with a measurement; returns the correction K e (latents,) and the squared innovation e' S^-1 e.

        Innovation e (states,), sensitivity H (states, latents), noise variances r (states,), S = H P H' + R. As R is
        diagonal, processing the entries sequentially is equivalent to the joint update: with u = P h, s = h' u + r,

            c <- c + u g,    P <- P - u u' / s,    surprise <- surprise + g^2 s,    g = (e - h' c) / s

        Source: Simon, Optimal State Estimation, section 6.1 (sequential Kalman filtering).
        """
        correct = _correction(len(self._limit))
        correction, self._covariance, surprise = correct(self._covariance, innovation, sensitivity, noise)
        return correction, surprise


def _upper(latents: int) -> list[tuple[int, int]]:
    return [(row, column) for row in range(latents) for column in range(row, latents)]


@cache
def _correction(latents: int) -> Callable[..., Any]:
    """Generates the function for ``LatentCovariance.correct`` with unrolled loops, which is five times faster.

    The function takes the upper triangle of P, e, H and r. It returns the correction, the new triangle and e' S^-1 e.
    """
    every, places = range(latents), _upper(latents)

    def listed(letter: str, entries: Sequence[Any]) -> str:
        names = [
            f"{letter}{entry}" if isinstance(entry, int) else f"{letter}{entry[0]}_{entry[1]}" for entry in entries
        ]
        return f"[{', '.join(names)}]"

    def product(row: int) -> str:
        return " + ".join(f"p{min(row, column)}_{max(row, column)} * h{column}" for column in every)

    lines = [
        "def correction(covariance, innovation, sensitivity, noise):",
        f"    {listed('p', places)} = covariance",
        f"    {listed('c', every)} = {[0.0] * latents}",
        "    surprise = 0.0",
        f"    for e, {listed('h', every)}, r in zip(innovation, sensitivity, noise, strict=True):",
        *(f"        u{row} = {product(row)}" for row in every),
        f"        s = r + {' + '.join(f'h{entry} * u{entry}' for entry in every)}",
        f"        g = (e - {' - '.join(f'h{entry} * c{entry}' for entry in every)}) / s",
        "        surprise += g * g * s",
        *(f"        c{entry} += u{entry} * g" for entry in every),
        *(f"        p{row}_{column} -= u{row} * u{column} / s" for row, column in places),
        f"    return {listed('c', every)}, {listed('p', places)}, surprise",
    ]
    scope: dict[str, Any] = {}
    exec("\n".join(lines), scope)  # the code is built from the number of latents only, not from any input
    made: Callable[..., Any] = scope["correction"]
    return made


@dataclass(frozen=True)
class EstimatorSettings:
    """Settings of the Kalman filter.

    Deviations of parameters are relative to their typical size; those of measurements are in the state's units.
    """

    initial_deviation: float = 0.5
    drift_per_second: float = 0.15
    """Standard deviation of the random walk after one second."""
    measurement_deviation: tuple[float, ...] = (0.01, 0.01, 0.01, 0.03)
    largest_innovation: float = 4.0
    """Standard deviations beyond which an innovation gets a lower weight."""
    smallest_motion: float = 1.0
    """Change of at least one entry of the state, in measurement deviations, from which a transition is used."""
    command_timing: float = 0.0
    """s by which commands may act later than known. A transition soon after a change of the command says less then."""

    def __post_init__(self) -> None:
        scales = (self.initial_deviation, self.drift_per_second, self.largest_innovation, self.smallest_motion)
        if not all(np.isfinite(number) and number > 0.0 for number in (*scales, *self.measurement_deviation)):
            raise InputError(f"estimator settings: got {self}, wanted positive numbers")
        if not 0.0 <= self.command_timing < np.inf:
            raise InputError(f"command_timing: got {self.command_timing!r}, wanted seconds, 0 or more")


def _settings_of(model: PhysicsModel) -> EstimatorSettings:
    """Returns settings with the robot's measurement deviations; the defaults for a system without a robot."""
    found = robots().get(model.system.name)
    if found is None:
        return EstimatorSettings()
    robot = found.of_system(model.system)
    return EstimatorSettings(
        measurement_deviation=robot.measurement_deviation,
        smallest_motion=robot.smallest_motion,
        command_timing=robot.command_timing,
    )


@final
class LatentEstimator(AbstractEstimator):
    """Estimates the free parameters of a model by an extended Kalman filter; see the module."""

    quick = False

    def __init__(self, model: PhysicsModel, settings: EstimatorSettings | None = None) -> None:
        settings = settings or _settings_of(model)
        if len(settings.measurement_deviation) != len(model.system.state):
            raise InputError(
                f"measurement_deviation: got {len(settings.measurement_deviation)} entries, "
                f"wanted {len(model.system.state)} ({', '.join(model.system.state_names)})"
            )
        self._model = model
        self._settings = settings
        chosen = [model.parameters[path] for path in model.latent_names]
        self._low = [parameter.low for parameter in chosen]
        self._high = [parameter.high for parameter in chosen]
        self._typical = [parameter.typical or 0.1 * (parameter.high - parameter.low) for parameter in chosen]
        self._measured = settings.measurement_deviation
        self._largest = settings.largest_innovation
        self._noise = [deviation**2 for deviation in self._measured]
        self._belief = LatentCovariance(
            [(settings.initial_deviation * typical) ** 2 for typical in self._typical],
            [(settings.drift_per_second * typical) ** 2 for typical in self._typical],
        )
        self.latent: FloatArray = model.latent.copy()
        self._free: list[float] = self.latent.tolist()
        self._memory: Any = None
        self._periods = ceil(settings.command_timing / model.period - 1e-9)
        self._earlier: deque[FloatArray] = deque(maxlen=self._periods)
        """The actions of the last periods, one of which may be the one that acts."""

    @property
    def deviations(self) -> FloatArray:  # noqa: D102
        return np.array([sqrt(variance) for variance in self._belief.variances()])

    def update(self, state: FloatArray, action: FloatArray, next_state: FloatArray, period: float) -> None:  # noqa: D102
        start, felt, reached = state.tolist(), action.tolist(), next_state.tolist()
        if not isfinite(sum(start) + sum(felt) + sum(reached) + period) or period <= 0.0:
            check_transition(state, action, next_state, period)  # passes if only the sum overflowed
        memory = self._model.initial_memory(action) if self._memory is None else self._memory
        step = self._step(state, action, memory, period)
        predicted, self._memory = step(self._free)
        if not self._free:
            return
        self._belief.spread(period)
        motion, smallest = self._difference(reached, start), self._settings.smallest_motion
        for change, scale in zip(motion, self._measured, strict=True):
            if abs(change) / scale >= smallest:
                noise = self._noise_of_timing(state, action, memory, period, predicted)
                self._learn(self._difference(reached, predicted), self._sensitivity(step, predicted), noise)
                break
        self._earlier.append(action)

    def _noise_of_timing(
        self, state: FloatArray, action: FloatArray, memory: Any, period: float, predicted: Sequence[float]
    ) -> list[float]:
        """Variances (states,) of the innovation if one of the earlier actions may have acted instead.

        r + n max_i (step(a_i) - step(a))^2: the n transitions after a change err in the same direction, so each counts
        as one n-th.
        """
        if not self._periods:
            return self._noise
        squares, others = [0.0] * len(predicted), {tuple(earlier.tolist()) for earlier in self._earlier}
        if len(self._earlier) < self._periods:
            others.add((0.0,) * len(action))  # what came before is not known: the robot may have rested
        for other in others - {tuple(action.tolist())}:
            after, _ = self._step(state, np.array(other), memory, period)(self._free)
            errors = self._difference(after, predicted)
            squares = [max(most, error * error) for most, error in zip(squares, errors, strict=True)]
        return [own + self._periods * square for own, square in zip(self._noise, squares, strict=True)]

    def _learn(
        self, innovation: Sequence[float], sensitivity: Sequence[Sequence[float]], noise: Sequence[float]
    ) -> None:
        """Measurement update with innovation (states,), sensitivity (states, latents) and variances (states,)."""
        correction, surprise = self._belief.correct(innovation, sensitivity, noise)
        weight = min(1.0, self._largest / max(sqrt(surprise / len(innovation)), 1e-12))
        moved = [value + weight * change for value, change in zip(self._free, correction, strict=True)]
        for index, (value, low, high) in enumerate(zip(moved, self._low, self._high, strict=True)):
            moved[index] = low if value < low else high if value > high else value
        self._free = moved
        self.latent = np.array(self._free)

    def forget_transient(self) -> None:
        """Assumes that the actuators are settled at the next action."""
        self._memory = None
        self._earlier.clear()

    def _step(self, state: FloatArray, action: FloatArray, memory: Any, period: float) -> Callable[[list[float]], Any]:
        """Returns the model's step of this transition as a function of the latent: (next state, actuator state)."""
        quick = self._model.scalar_step(period)
        entries, felt = state.tolist(), action.tolist()

        def step(free: list[float]) -> tuple[list[float], Any]:
            if quick is not None:
                try:
                    return quick(entries, felt, free, self._model.clock.seconds), memory
                except (ValueError, ArithmeticError):  # such as an overflow, which NumPy below handles
                    pass
            after, cached = self._model.advance(state, action, memory, np.array(free), period=period)
            return after.tolist(), cached

        return step

    def _sensitivity(self, step: Callable[[list[float]], Any], predicted: Sequence[float]) -> list[tuple[float, ...]]:
        """Returns d(step)/dz (states, latents) by finite differences of 1e-4 of each parameter's typical size."""
        columns = []
        for index, value in enumerate(self._free):
            nudge = 1e-4 * self._typical[index]
            nudge = -nudge if value + nudge > self._high[index] else nudge  # stay within the parameter's bounds
            free = self._free.copy()
            free[index] += nudge
            columns.append([(moved - entry) / nudge for moved, entry in zip(step(free)[0], predicted, strict=True)])
        return list(zip(*columns, strict=True))

    def _difference(self, later: Sequence[float], earlier: Sequence[float]) -> list[float]:
        """Returns later - earlier (states,), with angles wrapped to [-pi, pi)."""
        change = [after - before for after, before in zip(later, earlier, strict=True)]
        for index in self._model.system.angles:
            change[index] = (change[index] + pi) % (2.0 * pi) - pi
        return change
