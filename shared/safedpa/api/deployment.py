"""Prepares a diagnosed model for driving: checks it for ``safedpa up``, calibrates a margin, gives the command."""

from __future__ import annotations

import datetime
import os
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import final

from safedpa.dynamics import LearnedBase, PhysicsModel
from safedpa.dynamics.user_files import EFFECTS_VARIABLE
from safedpa.errors import InputError
from safedpa.records.run import Run
from safedpa.systems.registry import why_not_driven
from safedpa.systems.robots import DEFAULT_ROBOT, own_robots, robot_like, robot_named

__all__ = ["RATES", "CalibratedMargin", "calibrate_margin_file", "drive_command", "refusal_reason"]

RATES = (1.0, 500.0)
"""Minimum and maximum rate of ``safedpa up`` in ticks per second."""

_SAME_RATE = 0.01
"""Relative difference of two periods up to which they count as equal."""
_COVERAGE = 0.99
"""Share of steps that a calibrated margin covers."""


def refusal_reason(model: PhysicsModel) -> str:
    """Returns why ``safedpa up`` would refuse this model with its robot's default settings; empty if it accepts it."""
    from safedpa.policy.controller import controller_for
    from safedpa.runtime.scene import scene_of

    name = model.system.name
    refusal = why_not_driven(model.system, name)
    if refusal:
        return refusal
    robot = robot_named(name).of_system(model.system)
    try:
        scene_of(model, robot.settings())
        controller_for(model)
    except InputError as error:
        return str(error)
    if isinstance(model.base, LearnedBase) and abs(robot.rate * model.period - 1.0) > _SAME_RATE:
        trained = 1.0 / model.period
        return f"its networks were trained for {trained:g} ticks per second, a {name} is driven at {robot.rate:g}"
    return ""


def drive_command(
    model: PhysicsModel, path: Path, margin: Path | None, own: Path | None = None, period: float = 0.0
) -> str:
    """Returns the shell command that drives the simulated robot with the model at ``path``.

    :param own: file of the user's own robot or effects; None: the file named by the environment variable, if any
    :param period: step of the margin [s]. If it differs from the model's step, the command drives at its rate, within
        the limits ``RATES``. 0: unknown
    """
    name = model.system.name
    files = [str(own)] if own else [item for item in os.environ.get(EFFECTS_VARIABLE, "").split(os.pathsep) if item]
    arguments = ["safedpa", "up"]
    if name != DEFAULT_ROBOT and name not in own_robots():
        arguments += ["--robot", name]
    if files:
        arguments += ["--robot-file" if name in own_robots() else "--effects", files[0]]
    arguments += ["--model", str(path), *(["--margin", str(margin)] if margin else [])]
    differs = period > 0.0 and abs(period / model.period - 1.0) > _SAME_RATE
    if differs and RATES[0] <= 1.0 / period <= RATES[1]:
        arguments += ["--rate", f"{1.0 / period:.4g}"]
    return shlex.join(arguments)


@final
@dataclass(frozen=True)
class CalibratedMargin:
    """The result of a margin calibration."""

    path: Path | None = None
    """Margin file; None: no margin."""
    period: float = 0.0
    """Step [s] that the margin is for; 0: no margin."""
    notice: str = ""
    """What the user has to know about the margin; empty in the usual case."""


def calibrate_margin_file(
    model: PhysicsModel,
    runs: Sequence[Run],
    path: Path,
    fewer: Callable[[Sequence[Run]], Sequence[Run]] = lambda runs: runs,
) -> CalibratedMargin:
    """Calibrates the margin of ``model`` on ``runs`` and writes it to ``path``, replacing a margin that lies there.

    The margin is for the model's step, or for the step of the runs where that differs. If the runs do not allow a
    margin, the result's ``notice`` gives the reason. For a robot whose margins cannot be calibrated from logs, the
    result is empty. ``fewer`` subsamples long runs.
    """
    from safedpa.adaptation import HistoryEstimator
    from safedpa.calibration.from_runs import log_margin, log_margin_message

    path.unlink(missing_ok=True)
    robot = robot_like(model.system)
    if robot is None or not robot.calibrates_from_logs:
        return CalibratedMargin()
    # The filter gets the latent of a learned model from phi at each tick; the calibration must use the same estimate.
    learned = isinstance(model.base, LearnedBase) and model.base.weights.has("phi")
    estimator = (lambda: HistoryEstimator(model)) if learned else None
    today = datetime.date.today().isoformat()
    try:
        found = log_margin(model, robot.settings(), runs, _COVERAGE, today, estimator=estimator, fewer=fewer)
    except InputError as error:
        why = str(error).removeprefix("margin: ")
        return CalibratedMargin(
            notice=f"No margin was calibrated: {why}; the filter uses epsilon of its settings instead"
        )
    found.calibration.save(path)
    return CalibratedMargin(path, found.period, log_margin_message(model, found))
