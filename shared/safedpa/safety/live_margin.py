"""The filter's margin for a model that was fitted while the robot drives, from the little data that there are."""

from __future__ import annotations

import datetime
from collections.abc import Callable
from dataclasses import replace

from safedpa.dynamics import PhysicsModel
from safedpa.errors import InputError
from safedpa.records.run import Run, Stretch
from safedpa.robot import robot_like
from safedpa.safety.calibration import MarginCalibration
from safedpa.safety.margin_text import margin_text
from safedpa.safety.run_calibration import LatentAlong, calibration_from_runs
from safedpa.safety.settings import FilterSettings

__all__ = ["live_margin"]

_COVERAGE = 0.99


def live_margin(
    model: PhysicsModel,
    settings: FilterSettings,
    run: Run,
    footprint: tuple[float, ...],
    estimator: Callable[[], LatentAlong] | None = None,
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
