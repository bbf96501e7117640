"""Diagnosis on recordings of real robots: a car, a pendulum, balls that fall.

No one knows the whole truth about a real robot. So what counts is the error on data that was not used for fitting:
blocks of time inside the logs, and whole logs left out.
"""

from __future__ import annotations

import datetime
import platform
import time
from collections import Counter
from collections.abc import Sequence
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
from safedpa.dynamics import load_model, load_user_file
from safedpa.errors import InputError
from safedpa.records.run import Run
from safedpa.report.diagnosis_story import report_text
from safedpa_lab.experiments.common.workers import each_result
from safedpa_lab.experiments.diagnosis.real_logs_data import (
    BALLS,
    CAR,
    OTHER_DAY,
    OTHER_ROBOTS,
    PENDULUM,
    OtherRobot,
    ball_runs,
    mapped_runs,
    other_robot_runs,
    paths_of,
    reported_windows,
    uncovered,
)
from safedpa_lab.experiments.record import Options, ReportProgress, Result, silent
from safedpa_lab.experiments.report import markdown_table

_SLOW = ("torque_lag", "torque_delay", "torque_offset")
"""Which the pendulum's own authors, and fits elsewhere, leave out."""


def targets_of(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Each target with its limit, the measured value and whether it was met; only for available recordings."""
    found = []
    for row in rows:
        if row["part"] == "car":
            found.append(_car_target(row))
            if row.get("unseen_where_told"):
                found.append(_car_where_reported(row))
        elif row["part"] == "pendulum":
            found += _pendulum_target(row)
        elif row["part"] == "others":
            found += _other_target(row)
        elif (wanted := _ball_target(row)) is not None:
            found.append(wanted)
    return found


def _target(subject: str, asked: str, measured: str, met: bool) -> dict[str, Any]:
    return {"subject": subject, "asked": asked, "measured": measured, "met": met}


def _car_target(row: dict[str, Any]) -> dict[str, Any]:
    count = len(row["added"])
    if not row["name"]:
        measured = f"{100 * row['change']:+.1f} % with {count} effects"
        return _target("car, all logs", "held-out error at least -60 %", measured, row["change"] <= -0.60)
    measured = f"{100 * row['unseen_change']:+.1f} % with {count} effects"
    log = row["name"].removesuffix(".csv")[-8:]  # the names differ in the time of day
    undecided = row["verdict"] == "undecided"
    met = undecided or row["unseen_change"] <= -0.30
    return _target(
        f"car, without {log}",
        "error on that log at least -30 %, or undecided",
        "undecided" if undecided else measured,
        met,
    )


def _car_where_reported(row: dict[str, Any]) -> dict[str, Any]:
    """Of the part of a log that the diagnosis of the others says it holds for, in its first sentence."""
    log, reported, errors = row["name"].removesuffix(".csv")[-8:], row["unseen_told"], row["unseen_where_told"]
    change = errors[1] / errors[0] - 1.0
    measured = f"{100 * change:+.1f} %; {100 * reported:.0f} % of its predictions lie there"
    return _target(f"car, without {log}, inside the data", "-30 % inside the data", measured, change <= -0.30)


def folds_target(change: float) -> dict[str, Any]:
    """Of the errors on the logs that were left out, added up."""
    return _target(
        "car, all four left out in turn", "errors together at least -60 %", f"{100 * change:+.1f} %", change <= -0.60
    )


def _pendulum_target(row: dict[str, Any]) -> list[dict[str, Any]]:
    first = row["added"][0] if row["added"] else "nothing"
    fall = row["errors"][1] / row["errors"][0] - 1.0 if row["added"] else 0.0
    late = [name for name in row["added"] if name in _SLOW]
    return [
        _target("pendulum", "Coulomb friction first", first, first == "coulomb_friction"),
        _target("pendulum", "which takes off at least 45 %", f"{100 * fall:+.1f} %", fall <= -0.45),
        _target("pendulum", "no lag, delay or offset", ", ".join(late) or "none", not late),
    ]


def _ball_target(row: dict[str, Any]) -> dict[str, Any] | None:
    name, added = row["name"].lower(), row["added"]
    if "bowling" in name:
        return _target(row["name"], "nothing missing", ", ".join(added) or row["verdict"], not added)
    if "whiffle" in name:
        notice = ", ".join(added) or row["verdict"]
        return _target(row["name"], "quadratic drag first", notice, added[:1] == ["quadratic_drag"])
    return None


def _other_target(row: dict[str, Any]) -> list[dict[str, Any]]:
    """A named effect, or its group, has to hold one of each set of alternatives."""
    robot = OTHER_ROBOTS[row["name"]]
    named = {name for effect in row["added"] for name in (effect, *row["indistinguishable"].get(effect, ()))}
    met = all(any(one in named for one in wanted) for wanted in robot.effects)
    asked = " and ".join(" or ".join(wanted) for wanted in robot.effects)
    error = row["errors"][-1]
    return [
        _target(row["name"], f"{asked} named", ", ".join(sorted(named)) or row["verdict"], met),
        _target(row["name"], f"error at most {robot.error:g}", f"{error:.4g}", error <= robot.error),
    ]


PARTS = ("car", "pendulum", "balls", "others")
_HORIZON = {"car": 1.0, "pendulum": 0.4, "ball": 0.5}
"""s; near upright a pendulum's errors grow as exp(4.5 t), and a drop lasts 3 s."""
_FEWEST = 20
"""Predictions of a log that was left out, inside of what a report says that it holds for, without which no error is
reported."""
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


def real_logs_experiment(experiment: RealLogs, report_progress: ReportProgress = silent) -> dict[str, Any]:
    """Diagnoses each robot's recordings; for the car also every three of the four logs, judged by the fourth.

    Raises InputError where none of the recordings are in the folder.
    """
    jobs = [job for part in experiment.parts for job in _jobs(part, experiment)]
    if not jobs:
        raise InputError(
            f"{experiment.folder}: found no recording of a car, a pendulum, balls, a servo, a joint or tanks; name the "
            "folder of the recordings"
        )
    rows = each_result(_row, jobs, experiment.processes, report_progress)
    left_out = [row for row in rows if row["part"] == "car" and row["name"]]
    together = _together(left_out)
    return {
        **_circumstances(),
        "parts": list(experiment.parts),
        "targets": [*targets_of(rows), *([folds_target(together)] if together is not None else [])],
        "folds_together": together,
        "stable_names": dict(Counter(name for row in left_out for name in row["added"]).most_common()),
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
    if part == "others":
        return [_Job(part, folder, None, name) for name, robot in OTHER_ROBOTS.items() if paths_of(folder, robot.model)]
    if ball is None or not paths_of(folder, BALLS):
        return []
    return [_Job(part, folder, ball, name) for name in list(_drops(folder, ball))]


def _row(job: _Job) -> dict[str, Any]:
    begin, processor = time.perf_counter(), time.process_time()
    found = {"car": _car, "pendulum": _pendulum, "balls": _ball, "others": _other}[job.part](job)
    # Of the processor too: wall time depends on what else the machine does.
    used = round(time.process_time() - processor, 1)
    seconds = round(time.perf_counter() - begin, 1)
    return {"part": job.part, "name": job.name, **found, "seconds": seconds, "processor_seconds": used}


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


def _other(job: _Job) -> dict[str, Any]:
    robot: OtherRobot = OTHER_ROBOTS[job.name]
    model, runs = other_robot_runs(job.folder, robot)
    return _summary(diagnose(model, runs, robot.horizon))


@cache
def _falling(ball: Path | None) -> Any:
    if ball is None or not ball.with_suffix(".toml").is_file():
        raise InputError(f"{ball}: wanted a Python file with the falling ball, and its model file .toml next to it")
    load_user_file(ball)
    return load_model(str(ball.with_suffix(".toml")))


def _drops(folder: Path, ball: Path | None) -> dict[str, list[Run]]:
    return ball_runs(paths_of(folder, BALLS)[0], _falling(ball))


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


def _circumstances() -> dict[str, Any]:
    versions = {"python": platform.python_version(), "numpy": np.__version__, "safedpa": version("safedpa")}
    date = datetime.date.today().isoformat()
    return {"experiment": "real-logs", "date": date, "seed": None, "versions": versions}


_BALL = Path(__file__).resolve().parents[4] / "docs" / "examples" / "falling_ball.py"
"""Its place in a working copy of the project."""


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment real-logs``. Raises InputError for a folder of recordings that does not exist."""
    data, ball = options["data"], options["ball"]
    if not data.is_dir():
        raise InputError(f"--data {data}: no such folder; see docs/evidence/diagnosis.md for where the recordings are")
    if ball is None and _BALL.is_file():
        ball = _BALL
    parts = PARTS if options["part"] == "all" else (options["part"],)
    return real_logs_experiment(RealLogs(data, ball, parts, options["processes"]), report_progress)


def report(result: Result) -> str:
    """One row per diagnosis, then the targets, other days, and how stable the names are."""
    head = "recordings | added, in order | error | after | change | unseen | outside | s | s of processor"
    parts = [markdown_table(head, map(_row_text, result["rows"]))]
    targets = (
        f"{item['subject']} | {item['asked']} | {item['measured']} | {'met' if item['met'] else 'missed'}"
        for item in result["targets"]
    )
    parts.append(markdown_table("of | asked | measured | ", targets))
    for row in result["rows"]:
        for other in row.get("other_days", ()):
            before, after = other["unseen_before"], other["unseen_after"]
            outside = f"{other['unseen_outside']:.0%} of its rows outside of what the fit saw"
            change = f"{before:.3f} to {after:.3f}, {after / before - 1.0:+.0%}"
            parts.append(f"Another day, {other['name']}: {change}; {outside}.")
    if result["stable_names"]:
        folds = sum(1 for row in result["rows"] if "unseen_change" in row)
        names = ", ".join(f"{name} {count}/{folds}" for name, count in result["stable_names"].items())
        parts.append(f"Named with one log left out: {names}.")
    return "\n\n".join(parts)


def _row_text(row: dict[str, Any]) -> str:
    name = row["name"] or row["part"]
    if row["part"] == "car":
        name = f"car, without {row['name'].removesuffix('.csv')[-8:]}" if row["name"] else "car, all logs"
    unseen = f"{100 * row['unseen_change']:+.0f} %" if "unseen_change" in row else ""
    outside = f"{100 * row['unseen_outside']:.0f} %" if "unseen_outside" in row else ""
    added = ", ".join(row["added"]) or row["verdict"].replace("_", " ")
    return (
        f"{name} | {added} | {row['errors'][0]:.3f} | {row['errors'][-1]:.3f} | {100 * row['change']:+.0f} % "
        f"| {unseen} | {outside} | {row['seconds']:.0f} | {row['processor_seconds']:.0f}"
    )
