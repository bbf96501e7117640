"""Diagnosis on recordings of real robots: a car, a pendulum, balls that fall.

No one knows the whole truth about a real robot. So what counts is the error on data that was not used for fitting:
blocks of time inside the logs, and whole logs left out.
"""

from __future__ import annotations

import datetime
import multiprocessing
import platform
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from safedpa.comparison.rollout_error import rollout_error
from safedpa.comparison.windows import windows_of
from safedpa.diagnosis.diagnose import diagnose
from safedpa.diagnosis.report_schema import Report, as_document
from safedpa.dynamics import load_model, load_own
from safedpa.errors import InputError
from safedpa.records.run import Run
from safedpa.report.diagnosis_story import report_text
from safedpa_lab.experiments.real_logs_cover import reported_windows, uncovered
from safedpa_lab.experiments.real_logs_data import BALLS, CAR, OTHER_DAY, PENDULUM, ball_runs, mapped_runs, paths_of
from safedpa_lab.experiments.real_logs_targets import folds_target, targets_of

__all__ = ["PARTS", "RealLogs", "real_logs_experiment"]

PARTS = ("car", "pendulum", "balls")
_HORIZON = {"car": 1.0, "pendulum": 0.4, "ball": 0.5}
"""s; near upright a pendulum's errors grow as exp(4.5 t), and a drop lasts 3 s."""
_FEWEST = 20
"""Predictions of a log that was left out, inside of what a report says that it holds for, without which no error is
told."""
_EVERY = 0.1
"""s between the starts of two predictions of a log that was left out."""


@dataclass(frozen=True)
class RealLogs:
    """What to look at: the folder of recordings, and the Python file that makes a falling ball known."""

    folder: Path
    ball: Path | None = None
    parts: tuple[str, ...] = PARTS
    processes: int = 2


@dataclass(frozen=True)
class _Job:
    part: str
    folder: Path
    ball: Path | None
    name: str = ""
    """The log that is left out, or the ball."""


def real_logs_experiment(
    experiment: RealLogs, report_progress: Callable[[int, int], None] = lambda _done, _all: None
) -> dict[str, Any]:
    """Diagnoses each robot's recordings; for the car also every three of the four logs, judged by the fourth.

    Raises InputError where none of the recordings are in the folder.
    """
    jobs = [job for part in experiment.parts for job in _jobs(part, experiment)]
    if not jobs:
        raise InputError(
            f"{experiment.folder}: found none of {CAR}, {PENDULUM}, {BALLS}; name the folder of the recordings"
        )
    rows = []
    for done, row in enumerate(_rows(jobs, experiment.processes)):
        rows.append(row)
        report_progress(done + 1, len(jobs))
    left_out = [row for row in rows if row["part"] == "car" and row["name"]]
    together = _together(left_out)
    return {
        **_circumstances(),
        "parts": list(experiment.parts),
        "targets": [*targets_of(rows), *([folds_target(together)] if together is not None else [])],
        "folds_together": together,
        "stable_names": _stable(left_out),
        "rows": rows,
    }


def _jobs(part: str, experiment: RealLogs) -> list[_Job]:
    folder, ball = experiment.folder, experiment.ball
    if part == "car":
        logs = paths_of(folder, CAR)
        names = ["", *(path.name for path in logs)] if len(logs) > 1 else [""] * len(logs)
        return [_Job(part, folder, None, name) for name in names]
    if part == "pendulum":
        return [_Job(part, folder, None)] if paths_of(folder, PENDULUM) else []
    if ball is None or not paths_of(folder, BALLS):
        return []
    return [_Job(part, folder, ball, name) for name in _balls(folder, ball)]


def _rows(jobs: list[_Job], processes: int) -> Any:
    if processes == 1:
        yield from map(_row, jobs)
        return
    with ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn")) as pool:
        yield from pool.map(_row, jobs)


def _row(job: _Job) -> dict[str, Any]:
    begin = time.perf_counter()
    found = {"car": _car, "pendulum": _pendulum, "balls": _ball}[job.part](job)
    return {"part": job.part, "name": job.name, **found, "seconds": round(time.perf_counter() - begin, 1)}


def _car(job: _Job) -> dict[str, Any]:
    """Of all logs, or of all but one, with the error on that one."""
    paths = paths_of(job.folder, CAR)
    model = load_model("dart_car")
    runs = mapped_runs(paths, model, "dart_car_columns")
    own = [run for path, run in zip(paths, runs, strict=True) if path.name != job.name]
    unseen = [run for path, run in zip(paths, runs, strict=True) if path.name == job.name]
    report = diagnose(model, own, _HORIZON["car"])
    if unseen:
        outside = {"unseen_outside": round(uncovered(own, unseen[0]), 4)}
        return {**_summary(report), **_unseen(report, unseen[0]), **outside}
    others = mapped_runs(paths_of(job.folder, OTHER_DAY), model, "dart_car_columns")
    days = [
        {"name": run.name, **_unseen(report, run), "unseen_outside": round(uncovered(own, run), 4)} for run in others
    ]
    return {**_summary(report), "other_days": days}


def _unseen(report: Report, run: Run) -> dict[str, Any]:
    """Errors on a log that neither model saw; both have the free gains of the logs that they did see."""
    windows = windows_of([run], report.horizon, every=_EVERY)
    before, after = (rollout_error(model, windows) for model in (report.models[0], report.models[-1]))
    reported = np.flatnonzero(reported_windows(report.coverage, windows))
    part = windows.select(reported)
    covered = (
        [round(rollout_error(model, part).value, 4) for model in (report.models[0], report.models[-1])]
        if len(reported) >= _FEWEST
        else None
    )
    names = run.system.state_names
    return {
        "unseen_before": round(before.value, 4),
        "unseen_after": round(after.value, 4),
        "unseen_change": round(after.value / before.value - 1.0, 4),
        "unseen_told": round(len(reported) / max(len(windows), 1), 4),
        "unseen_where_told": covered,
        "unseen_per_state": {
            name: [round(float(one), 4), round(float(other), 4)]
            for name, one, other in zip(names, before.per_state, after.per_state, strict=True)
        },
    }


def _pendulum(job: _Job) -> dict[str, Any]:
    model = load_model("dfki_pendulum")
    runs = mapped_runs(paths_of(job.folder, PENDULUM), model, "dfki_pendulum_columns")
    return _summary(diagnose(model, runs, _HORIZON["pendulum"]))


def _ball(job: _Job) -> dict[str, Any]:
    return _summary(diagnose(_falling(job.ball), _drops(job.folder, job.ball)[job.name], _HORIZON["ball"]))


@cache
def _falling(ball: Path | None) -> Any:
    if ball is None or not ball.with_suffix(".toml").is_file():
        raise InputError(f"{ball}: wanted a Python file with the falling ball, and its model file .toml next to it")
    load_own(ball)
    return load_model(str(ball.with_suffix(".toml")))


def _drops(folder: Path, ball: Path | None) -> dict[str, list[Run]]:
    return ball_runs(paths_of(folder, BALLS)[0], _falling(ball))


def _balls(folder: Path, ball: Path) -> list[str]:
    return list(_drops(folder, ball))


def _summary(report: Report) -> dict[str, Any]:
    """What a diagnosis said: names, numbers, errors stage by stage, and what it left out of all that it tried."""
    errors = [round(stage.heldout_error, 4) for stage in report.stages]
    values = {path: [_short(item.value), item.std and _short(item.std)] for path, item in report.parameters.items()}
    groups = {
        item.effect: list(item.indistinguishable_from)
        for item in report.candidates
        if item.decision == "accepted" and item.indistinguishable_from
    }
    return {
        "verdict": report.verdict,
        "lead": report_text(as_document(report)).lead,
        "added": list(report.added),
        "errors": errors,
        "change": round(errors[-1] / errors[0] - 1.0, 4) if errors[0] > 0 else 0.0,
        "runs_improved": [stage.runs_improved for stage in report.stages][1:],
        "parameters": values,
        "indistinguishable": groups,
        "unexplained": None if report.unexplained is None else list(report.unexplained.depends_on),
    }


def _short(value: float) -> float:
    return float(f"{value:.4g}")


def _together(left_out: list[dict[str, Any]]) -> float | None:
    """By how much the errors on the logs that were left out fall, all of them added up; None where there are none."""
    before, after = (sum(row[f"unseen_{when}"] for row in left_out) for when in ("before", "after"))
    return round(after / before - 1.0, 4) if left_out and before > 0 else None


def _stable(left_out: list[dict[str, Any]]) -> dict[str, int]:
    """In how many of the diagnoses with a log left out each effect was added, the most frequent first."""
    return dict(Counter(name for row in left_out for name in row["added"]).most_common())


def _circumstances() -> dict[str, Any]:
    versions = {"python": platform.python_version(), "numpy": np.__version__, "safedpa": version("safedpa")}
    date = datetime.date.today().isoformat()
    return {"experiment": "real-logs", "date": date, "seed": None, "versions": versions}
