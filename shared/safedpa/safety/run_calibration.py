"""Margin calibration from runs of a car or a pendulum: what the model predicted one period ahead, and what came of it.

Recordings of the bus tell which scene the car was in; a run of a log does not. So every transition is placed among
obstacles drawn around the car, near enough to matter: the error of h depends on where they stand. That of a pendulum's
corridor does not depend on its edges.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from safedpa.dynamics import PhysicsModel, fingerprint
from safedpa.errors import InputError
from safedpa.records.run import Run
from safedpa.robot import robot_like, robots
from safedpa.safety.calibration import MarginCalibration, calibration_from_errors
from safedpa.safety.compatibility import check_settings
from safedpa.safety.settings import FilterSettings

__all__ = ["LatentAlong", "calibration_from_runs", "is_period_of"]

Values = NDArray[np.float64]


class LatentAlong(Protocol):
    """Estimates the latent while the robot drives: any estimator of the adaptation."""

    @property
    def latent(self) -> Values: ...  # noqa: D102

    def update(self, state: Values, action: Values, next_state: Values, period: float) -> None: ...  # noqa: D102


_MOST = 3000
"""Transitions; more narrow the quantile by less than its own spread."""
_SAME_PERIOD = 0.1
"""Relative difference of a row's period from the model's beyond which its transition is left out."""


def calibration_from_runs(
    model: PhysicsModel,
    settings: FilterSettings,
    runs: Sequence[Run],
    coverage: float,
    date: str,
    footprint: tuple[float, ...] = (),
    estimator: Callable[[], LatentAlong] | None = None,
) -> MarginCalibration:
    """Margins by kind of barrier: the quantile of h(predicted) - h(measured) over the runs' transitions.

    Actuators remember what was commanded before, as they do in the filter. ``footprint`` as in the message
    of the state; empty: the usual one.
    ``estimator`` makes what estimates the latent along each stretch; without one the model's own latent stands.
    Raises InputError for a model that is of a robot that does not say how, settings of another one, too few transitions
    at the model's own period, or predictions that are not finite.
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
    errors: dict[str, list[float]] = {}
    for before, predicted, after in _predictions(model, runs, estimator):
        for barrier in robot.barriers_around(before, settings, footprint, draw):
            apart = barrier.values(predicted) - barrier.values(after)
            errors.setdefault(barrier.kind, []).append(float(apart.max()))
    if not errors:
        raise InputError(f"margin: got no transition of {model.period:g} s, wanted runs at the model's period")
    found = {kind: np.array(values) for kind, values in errors.items()}
    return calibration_from_errors(found, coverage, date, fingerprint(model), model.period)


def is_period_of(model: PhysicsModel, period: float) -> bool:
    """Whether a step of ``period`` [s] is one of the model's own, but for what clocks jitter."""
    return abs(period / model.period - 1.0) < _SAME_PERIOD


def _predictions(
    model: PhysicsModel, runs: Sequence[Run], estimator: Callable[[], LatentAlong] | None
) -> Iterator[tuple[Values, Values, Values]]:
    """(state, predicted next, measured next), evenly spread over all runs."""
    every = max(1, sum(len(part) for run in runs for part in run.stretches) // _MOST)
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
                number += 1
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
