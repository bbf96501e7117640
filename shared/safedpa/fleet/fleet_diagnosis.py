"""The diagnosis of a fleet from recordings to fleet.json: diagnose each robot, then compare the robots."""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any, Protocol, TypeVar
from uuid import uuid4

import numpy as np

from safedpa.dynamics import LearnedBase, PhysicsModel, load_model, save_model, write_model
from safedpa.errors import InputError, RecordingError
from safedpa.fleet.common import (
    Confirmation,
    CorrectionTask,
    FleetEffect,
    confirm_correction,
    corrected_error,
    corrected_model,
    corrected_settings,
)
from safedpa.fleet.document import Analysis, analyse_fleet, fleet_document
from safedpa.fleet.one_robot import (
    FORMAT,
    Options,
    RobotResult,
    Task,
    diagnose_robot,
    failed_result,
    file_stamp,
    options_digest,
    same_files,
)
from safedpa.fleet.outcome import outcome_of
from safedpa.fleet.page import write_fleet_page
from safedpa.fleet.robots import DiscoveredRobots, RobotLogs, robots_in, split_recording
from safedpa.records.writers.tables import atomic_path

Job = TypeVar("Job")
Answer = TypeVar("Answer")
Corrected = list[tuple[FleetEffect, Confirmation]]
"""The tested effects with their results, each tested together with those confirmed before it."""

# Robots on which a corrected model is tested, evenly spread. More would not change the result of the sign test.
_MOST_TRIED = 40


class Workers(Protocol):
    """Runs jobs; yields the answers in order of completion, and ``failed(job, reason)`` for a failed job."""

    def __call__(
        self, work: Callable[[Job], Answer], jobs: Sequence[Job], failed: Callable[[Job, str], Answer]
    ) -> Iterator[Answer]:
        """Runs ``work`` on every job."""


def correct_fleet_model(analysis: Analysis, tasks: Sequence[Task], workers: Workers, path: Path) -> Corrected:
    """Tests the common effects on the robots, each with the values of the others; writes the confirmed model.

    Tests the effects found in nearly all robots one after the other, then the best of those with pooled evidence only.
    Writes no file at ``path`` if none is confirmed.
    """
    path.unlink(missing_ok=True)  # the model of an earlier run
    if not tasks:
        return []
    reported: Corrected = []
    held: list[FleetEffect] = []
    errors: Mapping[str, float] = {item.name: item.error_before for item in analysis.outcomes if item.judged}
    steps = [[item] for item in analysis.common] + ([list(analysis.together)] if analysis.together else [])
    for options in steps:
        tried = [(item, _errors([*held, item], analysis, tasks, workers)) for item in options]
        best, after = max(tried, key=lambda pair: confirm_correction(errors, pair[1]).fall)
        found = confirm_correction(errors, after)
        reported.append((best, found))
        if found.holds:
            held.append(best)
            errors = after
    if held:
        _save(corrected_model(load_model(tasks[0].options.model), corrected_settings(analysis.robot, held)), path)
    return reported


def _errors(
    common: Sequence[FleetEffect], analysis: Analysis, tasks: Sequence[Task], workers: Workers
) -> Mapping[str, float]:
    """Returns held-out errors by robot, each with the values of the other robots."""
    known = {item.name for item in analysis.outcomes if item.judged}
    judged = [task for task in tasks if task.robot.name in known]
    picked = np.unique(np.linspace(0, len(judged) - 1, min(len(judged), _MOST_TRIED)).astype(int))
    jobs = [
        CorrectionTask(task.robot, task.options, corrected_settings(analysis.robot, common, task.robot.name))
        for task in (judged[index] for index in picked)
    ]
    return dict(workers(corrected_error, jobs, lambda task, _reason: (task.robot.name, math.nan)))


def _save(model: PhysicsModel, path: Path) -> None:
    if isinstance(model.base, LearnedBase):
        save_model(model, path)
        return
    with atomic_path(path) as temporary:
        temporary.write_text(write_model(model), encoding="utf-8")


ROBOTS = "robots"
"""Folder that contains a folder per robot."""


def write_result(result: RobotResult, out: Path) -> None:
    """Writes the folder ``out/robots/NAME`` atomically. Raises RecordingError if that fails."""
    # A hidden folder first, which is then renamed: a killed run leaves no half-written result behind.
    folder = out / ROBOTS / result.name
    part = folder.with_name(f".{result.name}.{uuid4().hex[:8]}.part")
    old = part.with_suffix(".old")
    try:
        part.mkdir(parents=True)
        for name, text in (*result.texts.items(), ("result.json", json.dumps(result.document, indent=1) + "\n")):
            (part / name).write_text(text, encoding="utf-8")
        if folder.exists():
            os.replace(folder, old)
        os.replace(part, folder)
    except OSError as error:
        raise RecordingError(
            f"{folder}: cannot be written ({error.strerror}); choose another place with --out"
        ) from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)


def has_current_result(task: Task, out: Path) -> bool:
    """Whether the robot's result exists and belongs to the same model, options and recordings."""
    found = read_result(out / ROBOTS / task.robot.name)
    # "failed" means a defect of the program, which may be fixed now.
    if found is None or found["digest"] != task.digest or found["status"] == "failed":
        return False
    return same_files(found["files"], task.robot.files)


def read_result(folder: Path) -> dict[str, Any] | None:
    """Reads a robot's ``result.json``; None if there is none of this format."""
    try:
        found = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) and found.get("format") == FORMAT else None


def iterate_results(tasks: Sequence[Task], out: Path) -> Iterator[tuple[dict[str, Any], dict[str, Any] | None]]:
    """Yields (result.json, report.json or None) of every robot."""
    for task in tasks:
        folder = out / ROBOTS / task.robot.name
        found = read_result(folder)
        if found is None:
            continue
        report = folder / "report.json"
        yield found, json.loads(report.read_text(encoding="utf-8")) if report.exists() else None


def clear_others(tasks: Sequence[Task], out: Path) -> None:
    """Removes the folders of robots that are no longer in the fleet, and those left behind by a killed run."""
    names = {task.robot.name for task in tasks}
    folder = out / ROBOTS
    for path in folder.iterdir() if folder.is_dir() else ():
        half = path.name.startswith(".") and path.suffix in (".part", ".old")
        other = path.name not in names and (path / "result.json").exists()
        if half or other:
            shutil.rmtree(path, ignore_errors=True)


def write_scripts(out: Path) -> None:
    """Writes plotly.js, which the pages of all robots share."""
    text = files("plotly").joinpath("package_data", "plotly.min.js").read_bytes()
    with atomic_path(out / "plotly.min.js") as temporary:
        temporary.write_bytes(text)


ReportProgress = Callable[[int, int], None]


@dataclass(frozen=True)
class Fleet:
    """Inputs of a fleet's diagnosis: robots, model and options, and the output folder."""

    found: DiscoveredRobots
    options: Options
    out: Path


def diagnose_fleet(
    fleet: Fleet, workers: Workers, report_progress: ReportProgress = lambda _done, _all: None, *, again: bool = False
) -> Any:
    """Diagnoses all robots without a current result; returns the contents of fleet.json.

    Writes ``robots/NAME/`` (result.json, report.json, report.html, model.toml) after each robot, then ``fleet.json``,
    ``fleet.html`` and, if an effect is common to the fleet, ``model.toml``. ``again`` repeats all robots. Raises
    InputError and ModelFileError for an unusable model or options, RecordingError if the folder cannot be written.
    """
    options, out = fleet.options, fleet.out
    given = load_model(options.model)
    if Path(options.model).resolve() == (out / "model.toml").resolve():
        raise InputError(
            f"--out {out}: contains the given model; choose another folder, because model.toml is written there"
        )
    digest = options_digest(options)
    tasks = [Task(robot, options, digest) for robot in _own_recordings(fleet)]
    clear_others(tasks, out)
    write_scripts(out)
    todo = [task for task in tasks if again or not has_current_result(task, out)]
    done = len(tasks) - len(todo)
    report_progress(done, len(tasks))
    for result in workers(diagnose_robot, todo, failed_result):
        write_result(result, out)
        done += 1
        report_progress(done, len(tasks))
    analysis = analyse_fleet([outcome_of(*pair) for pair in iterate_results(tasks, out)], given.system.name)
    common = correct_fleet_model(analysis, tasks, workers, out / "model.toml")
    document = fleet_document(analysis, common, **_about(fleet, len(todo)))
    with atomic_path(out / "fleet.json") as temporary:
        temporary.write_text(json.dumps(document, allow_nan=False, indent=1) + "\n", encoding="utf-8")
    write_fleet_page(document, analysis, out)
    return document


def _about(fleet: Fleet, diagnosed: int) -> dict[str, Any]:
    found = fleet.found
    return {
        "model_file": fleet.options.model,
        "horizon": fleet.options.horizon,
        "by": found.by,
        "left_out": [{"path": str(path), "reason": reason} for path, reason in found.left_out],
        "diagnosed_now": diagnosed,
    }


def _own_recordings(fleet: Fleet) -> list[RobotLogs]:
    """Returns the robots with separate files; splits recordings of several robots first."""
    if fleet.found.by != "robot":
        return list(fleet.found.robots)
    pieces: dict[Path, dict[str, Path]] = {}
    for path in sorted({path for robot in fleet.found.robots for path in robot.files}):
        names = robots_in(path)[0]
        pieces[path] = _split(path, fleet.out) if len(names) > 1 else dict.fromkeys(names, path)
    return [
        replace(robot, files=tuple(pieces[path][str(robot.inside)] for path in robot.files))
        for robot in fleet.found.robots
    ]


def _split(path: Path, out: Path) -> dict[str, Path]:
    """Splits a recording by robot into a folder named by a hash of the recording; reuses an existing one."""
    folder = out / "recordings" / f"{path.stem}-{file_stamp(path)['sha256'][:12]}"
    if not folder.is_dir():
        part = folder.with_name(f".{folder.name}.{uuid4().hex[:8]}.part")
        try:
            split_recording(path, part)
            os.replace(part, folder)
        finally:
            shutil.rmtree(part, ignore_errors=True)
    return {piece.stem: piece for piece in folder.glob("*.mcap")}
