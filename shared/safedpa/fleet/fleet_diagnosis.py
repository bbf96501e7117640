"""The diagnosis of a fleet from recordings to fleet.json: diagnose each robot, then compare the robots."""

from __future__ import annotations

import hashlib
import json
import math
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol, TypeVar
from uuid import uuid4

import numpy as np

from safedpa.dynamics import LearnedBase, PhysicsModel, load_model, save_model, write_model
from safedpa.errors import InputError
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
    Options,
    Task,
    diagnose_robot,
    failed_result,
    file_stamp,
    options_digest,
)
from safedpa.fleet.outcome import outcome_of
from safedpa.fleet.page import fleet_page
from safedpa.fleet.results import Results, StoredResults, diagnose_into, plotly_script, results_at
from safedpa.fleet.robots import DiscoveredRobots, RobotLogs, robots_in, split_recording
from safedpa.records.readers.table import regular_file
from safedpa.records.store import find_files, url_of, write_file
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
    digest, results = options_digest(options), results_at(out)
    results.write_file("plotly.min.js", plotly_script())  # first: it shows whether the place can be written
    tasks = [Task(robot, options, digest) for robot in _own_recordings(fleet)]
    results.clear_others(tasks)
    current = set() if again else results.current(tasks)
    todo = [task for task in tasks if task.robot.name not in current]
    report_progress(len(tasks) - len(todo), len(tasks))
    for done, _ in enumerate(_diagnosed(results, todo, workers), len(tasks) - len(todo) + 1):
        report_progress(done, len(tasks))
    analysis = analyse_fleet([outcome_of(*pair) for pair in results.iterate(tasks)], given.system.name)
    with results.new_file("model.toml") as path:
        common = correct_fleet_model(analysis, tasks, workers, path)
    document = fleet_document(analysis, common, **_about(fleet, len(todo)))
    results.write_file("fleet.json", (json.dumps(document, allow_nan=False, indent=1) + "\n").encode())
    results.write_file("fleet.html", fleet_page(document, analysis).encode())
    return document


def _diagnosed(results: Results, todo: Sequence[Task], workers: Workers) -> Iterator[None]:
    """Diagnoses robots and has their results written: by the workers in object storage, otherwise here."""
    if isinstance(results, StoredResults):
        earlier = results.robots()
        jobs = [replace(task, is_first=task.robot.name not in earlier) for task in todo]
        for result in workers(partial(diagnose_into, results.url), jobs, failed_result):
            if result.document["status"] == "failed":  # of a worker that was killed
                results.write(result)
            yield
        return
    for result in workers(diagnose_robot, todo, failed_result):
        results.write(result)
        yield


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
    stamp = file_stamp(path)
    digest = stamp.get("sha256") or hashlib.sha256(repr(stamp).encode()).hexdigest()
    folder = out / "recordings" / f"{path.stem}-{digest[:12]}"
    if url := url_of(folder):
        return _split_into_store(path, url)
    if not folder.is_dir():
        part = folder.with_name(f".{folder.name}.{uuid4().hex[:8]}.part")
        try:
            with regular_file(path) as local:
                split_recording(local, part)
            os.replace(part, folder)
        finally:
            shutil.rmtree(part, ignore_errors=True)
    return {piece.stem: piece for piece in folder.glob("*.mcap")}


def _split_into_store(path: Path, url: str) -> dict[str, Path]:
    """Splits a recording into a folder in object storage, where the file ``complete`` comes last."""
    present = find_files(url)
    if f"{url}/complete" not in present:
        with tempfile.TemporaryDirectory(prefix="safedpa-fleet-") as name, regular_file(path) as local:
            for piece in split_recording(local, Path(name)).values():
                write_file(f"{url}/{piece.name}", piece.read_bytes())
        write_file(f"{url}/complete", b"")
        present = find_files(url)
    return {Path(piece).stem: Path(piece) for piece in present if piece.endswith(".mcap")}
