"""Margin calibration from runs of a car or a pendulum: what the model predicted one period ahead, and what came of it.

Recordings of the bus tell which scene the car was in; a run of a log does not. So every transition is placed among
obstacles drawn around the car, near enough to matter: the error of h depends on where they stand. That of a pendulum's
corridor does not depend on its edges. A margin is of steps of one length: the model's own where the logs have enough of
them, else those that they have.

The filter's margin for a model that was fitted while the robot drives, from the little data that there are.
"""

from __future__ import annotations

import datetime
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.dynamics import LearnedBase, PhysicsModel, fingerprint
from safedpa.errors import InputError
from safedpa.records.run import Run, Stretch
from safedpa.robot import robot_like, robots
from safedpa.safety.checks.compatibility import check_settings
from safedpa.safety.margins.calibration import MarginCalibration, calibration_from_errors, margin_text
from safedpa.safety.margins.conformal import smallest_sample
from safedpa.safety.settings import FilterSettings

__all__ = [
    "LatentTrajectory",
    "LogMargin",
    "calibration_from_runs",
    "is_period_of",
    "live_margin",
    "log_margin",
    "log_margin_message",
]


class LatentTrajectory(Protocol):
    """Estimates the latent while the robot drives: any estimator of the adaptation."""

    @property
    def latent(self) -> FloatArray: ...  # noqa: D102

    def update(self, state: FloatArray, action: FloatArray, next_state: FloatArray, period: float) -> None: ...  # noqa: D102


_MOST = 3000
"""Transitions; more narrow the quantile by less than its own spread."""
_SAME_PERIOD = 0.1
"""Relative difference of a row's period from the model's beyond which its transition is left out."""
_BLOCK = 20
"""Steps whose median is one rate: a clock that jitters by half moves it by a tenth."""
_OTHER_RATE = 0.25
"""Relative difference of such medians from which it is another rate."""
_STRAY = 0.1
"""Share of the time that may be of another rate, as while a robot starts, without hiding that of the logs."""


@final
@dataclass(frozen=True)
class LogMargin:
    """A margin, and of which steps of the logs it is."""

    calibration: MarginCalibration
    period: float
    """s, of its steps."""
    others: int
    """Steps of other rates, which tell nothing of it."""


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
    """Margins by kind of barrier: the quantile of h(predicted) - h(measured) over the runs' transitions.

    Actuators remember what was commanded before, as they do in the filter. ``footprint`` as in the message
    of the state; empty: the usual one.
    ``estimator`` makes what estimates the latent along each stretch; without one the model's own latent stands.
    ``period`` [s]: of the steps that count, within a tenth of it; 0, or where it is the model's own by as little, that.
    Raises InputError for a model that is of a robot that does not say how, settings of another one, too few transitions
    of that period, or predictions that are not finite.
    """
    robot = robot_like(model.system)
    draw = np.random.default_rng(0)
    if robot is None or not robot.calibrates_from_logs:
        raise InputError(
            f"margin: got a model with the actions {', '.join(model.system.action_names) or 'none'} and the states "
            f"{', '.join(model.system.state_names)}, wanted one of a robot that says which barriers may be drawn "
            f"around a state: {', '.join(name for name, one in robots().items() if one.calibrates_from_logs)}"
        )
    check_settings(settings, model.system)
    another = period > 0.0 and not is_period_of(model, period)
    stepping = model.with_period(period) if another else model
    errors: dict[str, list[float]] = {}
    for before, predicted, after in _predictions(stepping, runs, estimator):
        for barrier in robot.barriers_around(before, settings, footprint, draw):
            apart = barrier.values(predicted) - barrier.values(after)
            errors.setdefault(barrier.kind, []).append(float(apart.max()))
    if not errors:
        raise InputError(
            f"margin: got no transition of {stepping.period:g} s, wanted runs with steps of that length; "
            "record at one rate"
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
    """Margins by kind: the ``coverage`` quantile of h(predicted) - h(measured) over the logs' steps of one length.

    Of the model's own period where ceil(coverage / (1 - coverage)) steps are of it, else of the one rate of the logs.
    ``fewer`` thins long logs out once their rate is known; ``estimator`` as in ``calibration_from_runs``. Raises
    InputError where the logs have several rates and none of them is the model's, where they are too short, for a
    model of networks that know one rate alone, and as ``calibration_from_runs``.
    """
    known = [run for run in runs if run.period > 0.0]  # none where no stretch has two rows
    blocks = [part for run in known for part in _blocks(run)]
    period = _period(model, blocks, smallest_sample(coverage))
    near = [run for run in known if any(abs(steps / period - 1.0).min() < _OTHER_RATE for steps in _blocks(run))]
    found = calibration_from_runs(model, settings, fewer(near), coverage, date, estimator=estimator, period=period)
    others = sum(len(part) for part in blocks if abs(np.median(part) / period - 1.0) > _OTHER_RATE)
    return LogMargin(found, period, others)


def log_margin_message(model: PhysicsModel, found: LogMargin) -> str:
    """What has to be known of it, one sentence or two; empty where all steps are the model's own."""
    left = f"; {found.others} steps of other lengths tell nothing of it" if found.others else ""
    own, period = model.period, found.period
    if period == own:
        return left and f"The margin is of the model's own steps of {own:g} s{left}."
    wider = "wider than needed" if period > own else f"{own / period:.3g} times as wide and promises nothing"
    return (
        f"The margin is of steps of {period:.3g} s, as the recordings have them{left}: "
        f"over the model's own, {own:g} s, it is {wider}; for those record at their rate."
    )


def is_period_of(model: PhysicsModel, period: float) -> bool:
    """Whether a step of ``period`` [s] is one of the model's own, but for what clocks jitter."""
    return abs(period / model.period - 1.0) < _SAME_PERIOD


def _predictions(
    model: PhysicsModel, runs: Sequence[Run], estimator: Callable[[], LatentTrajectory] | None
) -> Iterator[tuple[FloatArray, FloatArray, FloatArray]]:
    """(state, predicted next, measured next), evenly spread over those of the model's period in all runs."""
    every = max(1, round(sum(_own_steps(model, run) for run in runs) / _MOST))
    latent = model.latent if model.latent_names else None
    number = 0
    for run in runs:
        begun = min((float(t[0]) for t, _, _ in run.parts() if len(t)), default=0.0)
        for t, states, actions in run.parts():
            if not len(t):
                continue
            memory = model.initial_memory(actions[0], latent)
            along = None if estimator is None else estimator()
            for row in range(len(t) - 1):
                period = float(t[row + 1] - t[row])
                near = is_period_of(model, period)
                wanted = near and number % every == 0
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
    """The steps [s] of each stretch, some that follow one another at a time."""
    steps = [np.diff(t) for t, _, _ in run.parts() if len(t) > 1]
    return [block for part in steps for block in np.array_split(part, -(-len(part) // _BLOCK))]


def _period(model: PhysicsModel, blocks: Sequence[FloatArray], least: int) -> float:
    """The model's own if ``least`` steps are of it, else that of most of the time, s, where it is of nearly all."""
    if not blocks:
        raise InputError(f"margin: got no step, wanted recordings with at least {least} of one length; record more")
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
            f"{model.period:g} s, wanted recordings of one rate or {least} steps of the model's own; diagnose those of "
            "one rate alone, or record at the model's"
        )
    if isinstance(model.base, LearnedBase):
        raise InputError(
            f"margin: got steps of {usual:.3g} s, wanted those of {model.period:g} s, on which the model's networks "
            "were trained; record at that rate"
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
    """The margin as text: for each kind of barrier the larger one of all of the run and of its newest half.

    The model was fitted to part of the run, most likely to its older half. The margin is of the run's own steps, since
    over these the filter predicts for this robot. Empty where the robot does not say which barriers may be drawn around
    a state. Raises InputError when the run is too short for 99 %.
    """
    robot = robot_like(model.system)
    if robot is None or not robot.calibrates_from_logs:
        return ""
    date = datetime.date.today().isoformat()
    period = run.period if run.period > 0.0 else 0.0  # none where no stretch has two rows

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
