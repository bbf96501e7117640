"""Margin calibration from runs of a car or a pendulum, by one-step predictions of the model.

Recordings of the bus contain the obstacles around the car; a run from a log does not. Every transition is therefore
combined with random obstacles near the car, because the error of h depends on their positions. For a pendulum, the
error does not depend on the limits of the corridor. A margin is valid for steps of one length: the model's period if
the logs have enough such steps, otherwise the period of the logs.

``live_margin`` calibrates the margin of a model fitted while the robot drives, from the data of that drive.
"""

from __future__ import annotations

import datetime
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.calibration.from_drives import AT_REST
from safedpa.dynamics import LearnedBase, PhysicsModel, fingerprint
from safedpa.errors import InputError
from safedpa.records.run import Run, Stretch
from safedpa.safety.checks.compatibility import check_settings
from safedpa.safety.margins.calibration import MarginCalibration, calibration_from_errors, margin_text
from safedpa.safety.margins.conformal import smallest_sample
from safedpa.safety.settings import FilterSettings
from safedpa.systems.robots import robot_like, robots


class LatentTrajectory(Protocol):
    """Estimates the latent along a drive; any estimator of the adaptation."""

    @property
    def latent(self) -> FloatArray: ...  # noqa: D102

    def update(self, state: FloatArray, action: FloatArray, next_state: FloatArray, period: float) -> None: ...  # noqa: D102


# Transitions used. More of them change the quantile by less than its own spread.
_MOST = 3000
# Relative difference of a step from the model's period beyond which its transition is left out.
_SAME_PERIOD = 0.1
# Steps per block for estimating a rate by the median. A jitter of 50 % changes the median by 10 %.
_BLOCK = 20
# Relative difference of medians from which blocks count as of different rates.
_OTHER_RATE = 0.25
# Share of the time that may have another rate, such as while a robot starts.
_STRAY = 0.1


@final
@dataclass(frozen=True)
class LogMargin:
    """A margin, and the steps of the logs for which it is valid."""

    calibration: MarginCalibration
    period: float
    """Length of its steps in s."""
    others: int
    """Number of steps of other lengths, which were not used."""


def calibration_from_runs(
    model: PhysicsModel,
    settings: FilterSettings,
    runs: Sequence[Run],
    coverage: float,
    date: str,
    footprint: tuple[float, ...] = (),
    estimator: Callable[[], LatentTrajectory] | None = None,
    period: float = 0.0,
) -> MarginCalibration:
    """Calibrates margins by kind of barrier: the quantile of h(predicted) - h(measured) over the transitions.

    Actuator states are simulated as in the filter. ``footprint`` is as in the state message; empty: the default one.
    ``estimator`` creates an estimator of the latent for each stretch; without one the model's own latent is used.
    ``period`` [s] selects the steps within 10 % of it; 0, or a value within 10 % of the model's period, means the
    model's period. Raises InputError for a robot that does not support this calibration, settings of another robot, too
    few transitions of the period, and predictions that are not finite.
    """
    robot = robot_like(model.system)
    draw = np.random.default_rng(0)
    if robot is None or not robot.calibrates_from_logs:
        raise InputError(
            f"margin: got a model with the actions {', '.join(model.system.action_names) or 'none'} and the states "
            f"{', '.join(model.system.state_names)}, wanted a robot that supports calibration from logs: "
            f"{', '.join(name for name, one in robots().items() if one.calibrates_from_logs)}"
        )
    check_settings(settings, model.system)
    another = period > 0.0 and not is_period_of(model, period)
    stepping = model.with_period(period) if another else model
    errors: dict[str, list[float]] = {}
    for before, predicted, after in _predictions(stepping, runs, estimator):
        for barrier in robot.barriers_around(before, settings, footprint, draw):
            apart = barrier.h(predicted) - barrier.h(after)
            errors.setdefault(barrier.kind, []).append(float(apart.max()))
    if not errors:
        raise InputError(
            f"margin: no transition of {stepping.period:g} s, wanted runs with steps of that length; record at one rate"
        )
    found = {kind: np.array(values) for kind, values in errors.items()}
    return calibration_from_errors(found, coverage, date, fingerprint(model), stepping.period)


def log_margin(
    model: PhysicsModel,
    settings: FilterSettings,
    runs: Sequence[Run],
    coverage: float,
    date: str,
    *,
    estimator: Callable[[], LatentTrajectory] | None = None,
    fewer: Callable[[Sequence[Run]], Sequence[Run]] = lambda runs: runs,
) -> LogMargin:
    """Calibrates margins by kind as the ``coverage`` quantile of h(predicted) - h(measured) over steps of one length.

    The length is the model's period if at least ceil(coverage / (1 - coverage)) steps have it, otherwise the common
    period of the logs. ``fewer`` thins out long logs once their rate is known; ``estimator`` is as in
    ``calibration_from_runs``. Raises InputError as ``calibration_from_runs`` does, for logs of several rates without
    the model's, for logs that are too short, and for network models trained for another rate.
    """
    known = [run for run in runs if run.period > 0.0]  # excludes runs without two consecutive rows
    blocks = [part for run in known for part in _blocks(run)]
    period = _period(model, blocks, smallest_sample(coverage))
    near = [run for run in known if any(abs(steps / period - 1.0).min() < _OTHER_RATE for steps in _blocks(run))]
    found = calibration_from_runs(model, settings, fewer(near), coverage, date, estimator=estimator, period=period)
    others = sum(len(part) for part in blocks if abs(np.median(part) / period - 1.0) > _OTHER_RATE)
    return LogMargin(found, period, others)


def log_margin_message(model: PhysicsModel, found: LogMargin) -> str:
    """Returns a note on the validity of the margin; empty if all steps have the model's period."""
    left = f"; {found.others} steps of other lengths were not used" if found.others else ""
    own, period = model.period, found.period
    if period == own:
        return left and f"The margin is valid for the model's period of {own:g} s{left}."
    wider = "wider than needed" if period > own else f"scaled by {own / period:.3g} and has no guarantee"
    return (
        f"The margin is valid for steps of {period:.3g} s, as in the recordings{left}: "
        f"for the model's period of {own:g} s it is {wider}; record at that rate to calibrate for it."
    )


def is_period_of(model: PhysicsModel, period: float) -> bool:
    """Whether ``period`` [s] is the model's period within the tolerance for clock jitter."""
    return abs(period / model.period - 1.0) < _SAME_PERIOD


def _predictions(
    model: PhysicsModel, runs: Sequence[Run], estimator: Callable[[], LatentTrajectory] | None
) -> Iterator[tuple[FloatArray, FloatArray, FloatArray]]:
    """Yields (state, predicted next, measured next) for steps of the model's period, thinned out evenly.

    Steps in which the robot rests before and after are left out: see ``barrier_residuals``.
    """
    every = max(1, round(sum(_own_steps(model, run) for run in runs) / _MOST))
    latent = model.latent if model.latent_names else None
    number = 0
    for run in runs:
        begun = min((float(t[0]) for t, _, _ in run.parts() if len(t)), default=0.0)
        speeds = [index for index, each in enumerate(run.system.state) if each.unit == "m/s"]
        for t, states, actions in run.parts():
            if not len(t):
                continue
            memory = model.initial_memory(actions[0], latent)
            along = None if estimator is None else estimator()
            for row in range(len(t) - 1):
                period = float(t[row + 1] - t[row])
                near = is_period_of(model, period)
                rests = bool(speeds) and float(np.abs(states[row : row + 2, speeds]).max()) < AT_REST
                wanted = near and number % every == 0 and not rests
                number += near
                if along is not None:
                    latent = along.latent
                if wanted or memory:
                    since = float(t[row]) - begun
                    predicted, memory = model.advance(
                        states[row], actions[row], memory, latent, period=period, time=since
                    )
                if wanted:
                    yield states[row], predicted, states[row + 1]
                if along is not None and near:
                    along.update(states[row], actions[row], states[row + 1], model.period)


def _own_steps(model: PhysicsModel, run: Run) -> int:
    return sum(is_period_of(model, step) for t, _, _ in run.parts() for step in np.diff(t).tolist())


def _blocks(run: Run) -> list[FloatArray]:
    """Returns the steps [s] of all stretches in blocks of consecutive steps."""
    steps = [np.diff(t) for t, _, _ in run.parts() if len(t) > 1]
    return [block for part in steps for block in np.array_split(part, -(-len(part) // _BLOCK))]


def _period(model: PhysicsModel, blocks: Sequence[FloatArray], least: int) -> float:
    """Returns the model's period if at least ``least`` steps have it, otherwise the predominant period [s]."""
    if not blocks:
        raise InputError(f"margin: no steps, wanted recordings with at least {least} of one length; record more")
    steps = np.concatenate(blocks)
    own = sum(is_period_of(model, step) for step in steps.tolist())
    rates, seconds = (np.array([of(part) for part in blocks]) for of in (np.median, np.sum))
    order = np.argsort(rates)
    most = rates[order][np.searchsorted(np.cumsum(seconds[order]), 0.5 * seconds.sum())]
    apart = abs(rates / most - 1.0) > _OTHER_RATE
    usual = float(np.median(np.concatenate([part for part, other in zip(blocks, apart, strict=True) if not other])))
    if own >= least or is_period_of(model, usual):
        return model.period
    if seconds[apart].sum() > _STRAY * seconds.sum():
        raise InputError(
            f"margin: got steps of {rates.min():.3g} to {rates.max():.3g} s, {own or 'none'} of the model's own "
            f"{model.period:g} s, wanted recordings of one rate or {least} steps of the model's own; use recordings of "
            "one rate, or record at the model's"
        )
    if isinstance(model.base, LearnedBase):
        raise InputError(
            f"margin: got steps of {usual:.3g} s, wanted {model.period:g} s, for which the model's networks were "
            "trained; record at that rate"
        )
    return usual


_COVERAGE = 0.99


def live_margin(
    model: PhysicsModel,
    settings: FilterSettings,
    run: Run,
    footprint: tuple[float, ...],
    estimator: Callable[[], LatentTrajectory] | None = None,
) -> str:
    """Returns the margin as text: for each kind of barrier the maximum over the whole run and its newest half.

    The margin is valid for the run's own period, over which the filter predicts for this robot. Empty if the robot does
    not support calibration from logs. Raises InputError if the run is too short for 99 %.
    """
    # The model was fitted to part of the run, most likely its older half, where its errors are smaller.
    robot = robot_like(model.system)
    if robot is None or not robot.calibrates_from_logs:
        return ""
    date = datetime.date.today().isoformat()
    period = run.period if run.period > 0.0 else 0.0  # NaN without two consecutive rows

    def calibrated(part: Run) -> MarginCalibration:
        return calibration_from_runs(model, settings, [part], _COVERAGE, date, footprint, estimator, period)

    found = calibrated(run)
    try:
        newest = calibrated(_newest_half(run))
    except InputError:  # too few transitions in a half
        return margin_text(found)
    larger = {kind: max(value, newest.epsilon.get(kind, 0.0)) for kind, value in found.epsilon.items()}
    return margin_text(replace(found, epsilon=larger))


def _newest_half(run: Run) -> Run:
    middle = len(run.t) // 2
    parts = [Stretch(max(part.start, middle), part.stop) for part in run.stretches if part.stop - middle > 1]
    return replace(run, stretches=tuple(parts))
