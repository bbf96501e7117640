"""From a model on disk to driving it: the margin next to it, whether ``safedpa up`` takes it, and by which command."""

from __future__ import annotations

import datetime
import os
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import final

from safedpa.dynamics import LearnedBase, PhysicsModel
from safedpa.dynamics.own import EFFECTS_VARIABLE
from safedpa.errors import InputError
from safedpa.records.run import Run
from safedpa.robot import DEFAULT_ROBOT, own_robots, robot_like, robot_named
from safedpa.systems.driven import why_not_driven

__all__ = ["RATES", "CalibratedMargin", "calibrate_margin_file", "drive_command", "refusal_reason"]

RATES = (1.0, 500.0)
"""Ticks per second, at least and at most, that ``safedpa up`` drives at."""

_SAME_RATE = 0.01
"""Relative difference of periods up to which networks are asked as they were trained."""
_COVERAGE = 0.99
"""Share of steps that a margin covers."""


def refusal_reason(model: PhysicsModel) -> str:
    """Why ``safedpa up`` would refuse to drive this model with its robot's own settings; empty where it would not."""
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
    """The command that drives the simulated robot with the model at ``path``, for a shell.

    ``own``: the file of the user's own robot or effects; None: that of the environment, if one is named there.
    ``period`` [s]: of the steps of the margin, at whose rate it drives where they are not the model's and a robot can
    be driven at it; 0: not told.
    """
    name = model.system.name
    files = [str(own)] if own else [item for item in os.environ.get(EFFECTS_VARIABLE, "").split(os.pathsep) if item]
    phrase = ["safedpa", "up"]
    if name != DEFAULT_ROBOT and name not in own_robots():
        phrase += ["--robot", name]
    if files:
        phrase += ["--robot-file" if name in own_robots() else "--effects", files[0]]
    phrase += ["--model", str(path), *(["--margin", str(margin)] if margin else [])]
    another = period > 0.0 and abs(period / model.period - 1.0) > _SAME_RATE
    if another and RATES[0] <= 1.0 / period <= RATES[1]:
        phrase += ["--rate", f"{1.0 / period:.4g}"]
    return shlex.join(phrase)


@final
@dataclass(frozen=True)
class CalibratedMargin:
    """Where the margin lies, of which steps it is, and what a person has to know of it."""

    path: Path | None = None
    """None: there is none."""
    period: float = 0.0
    """s, of its steps; 0: there is none."""
    notice: str = ""
    """Sentences; empty where all is as usual."""


def calibrate_margin_file(
    model: PhysicsModel,
    runs: Sequence[Run],
    path: Path,
    fewer: Callable[[Sequence[Run]], Sequence[Run]] = lambda runs: runs,
) -> CalibratedMargin:
    """Calibrates the margin of ``model`` on ``runs`` and writes it to ``path``, in place of one of an earlier model.

    Of the model's own steps, or of those that the runs have; where they tell none, why. Nothing is written or said for
    a robot that does not say which barriers may be drawn around a state. ``fewer`` thins long runs out.
    """
    from safedpa.adaptation import HistoryEstimator
    from safedpa.calibration.from_runs import log_margin, log_margin_message

    path.unlink(missing_ok=True)
    robot = robot_like(model.system)
    if robot is None or not robot.calibrates_from_logs:
        return CalibratedMargin()
    # phi tells a learned latent tick by tick, in the filter as here
    learned = isinstance(model.base, LearnedBase) and model.base.weights.has("phi")
    estimator = (lambda: HistoryEstimator(model)) if learned else None
    today = datetime.date.today().isoformat()
    try:
        found = log_margin(model, robot.settings(), runs, _COVERAGE, today, estimator=estimator, fewer=fewer)
    except InputError as error:
        why = str(error).removeprefix("margin: ")
        return CalibratedMargin(notice=f"No margin was calibrated: {why}; the filter's settings stand in for it")
    found.calibration.save(path)
    return CalibratedMargin(path, found.period, log_margin_message(model, found))
