"""A fleet's diagnosis from recordings to fleet.json: what is not done yet is done, then the robots are compared."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, TypeVar
from uuid import uuid4

import numpy as np

from safedpa.diagnosis.fleet.common import (
    Confirmation,
    MendTask,
    confirmed,
    mended_error,
    mended_model,
    mended_settings,
)
from safedpa.diagnosis.fleet.document import Analysis, analysed, fleet_document
from safedpa.diagnosis.fleet.inputs import Options, file_stamp, options_digest
from safedpa.diagnosis.fleet.one_robot import Task, diagnosed_robot, not_diagnosed
from safedpa.diagnosis.fleet.outcome import outcome_of
from safedpa.diagnosis.fleet.page import write_fleet_page
from safedpa.diagnosis.fleet.robots import Found, RobotLogs
from safedpa.diagnosis.fleet.splitting import robots_in, split_recording
from safedpa.diagnosis.fleet.store import clear_others, kept, results, write_result, write_scripts
from safedpa.dynamics import LearnedBase, load_model, save_model
from safedpa.records.atomic import atomic_path

__all__ = ["Fleet", "Workers", "diagnose_fleet"]

Job = TypeVar("Job")
Answer = TypeVar("Answer")
Tell = Callable[[int, int], None]

_MOST_TRIED = 40
"""Robots on which a mended model is tried, evenly spread: more would not change what a coin says."""


class Workers(Protocol):
    """Who does the work: answers in the order in which they are done, ``failed(job, reason)`` for what went wrong."""

    def __call__(
        self, work: Callable[[Job], Answer], jobs: Sequence[Job], failed: Callable[[Job, str], Answer]
    ) -> Iterator[Answer]:
        """Runs ``work`` on every job somewhere."""


@dataclass(frozen=True)
class Fleet:
    """What was asked: robots, model and options, and the folder for everything that is written."""

    found: Found
    options: Options
    out: Path


def diagnose_fleet(fleet: Fleet, workers: Workers, tell: Tell = lambda _done, _all: None, *, anew: bool = False) -> Any:
    """Diagnoses every robot whose result is not there yet, or is of other inputs; returns the document of fleet.json.

    Writes ``robots/NAME/`` (result.json, report.json, report.html, model.toml) as each robot is done, then
    ``fleet.json``, ``fleet.html`` and, where the fleet has an effect in common, ``model.toml``. ``anew``: all of it.
    Raises InputError and ModelFileError for a model or options that no robot could be diagnosed with, RecordingError
    when the folder cannot be written.
    """
    options, out = fleet.options, fleet.out
    given = load_model(options.model)
    digest = options_digest(options)
    tasks = [Task(robot, options, digest) for robot in _own_recordings(fleet)]
    clear_others(tasks, out)
    write_scripts(out)
    todo = [task for task in tasks if anew or not kept(task, out)]
    done = len(tasks) - len(todo)
    tell(done, len(tasks))
    for result in workers(diagnosed_robot, todo, not_diagnosed):
        write_result(result, out)
        done += 1
        tell(done, len(tasks))
    analysis = analysed([outcome_of(*pair) for pair in results(tasks, out)], given.system.name)
    confirmation = _mended(analysis, tasks, fleet, workers)
    document = fleet_document(analysis, confirmation, **_about(fleet, len(todo)))
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
    """The robots with files of their own: recordings of several robots are split into ``recordings`` first."""
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
    """Pieces by robot, in a folder that is named by the recording's contents and is there whole or not at all."""
    folder = out / "recordings" / f"{path.stem}-{file_stamp(path)['sha256'][:12]}"
    if not folder.is_dir():
        part = folder.with_name(f".{folder.name}.{uuid4().hex[:8]}.part")
        try:
            split_recording(path, part)
            os.replace(part, folder)
        finally:
            shutil.rmtree(part, ignore_errors=True)
    return {piece.stem: piece for piece in folder.glob("*.mcap")}


def _mended(analysis: Analysis, tasks: Sequence[Task], fleet: Fleet, workers: Workers) -> Confirmation | None:
    """Tries the model with what the fleet has in common, each robot with the others' numbers; writes it if it holds."""
    path = fleet.out / "model.toml"
    path.unlink(missing_ok=True)  # of an earlier fleet
    if not analysis.common:
        return None
    before = {item.name: item.error_before for item in analysis.outcomes if item.judged}
    judged = [task for task in tasks if task.robot.name in before]
    picked = np.unique(np.linspace(0, len(judged) - 1, min(len(judged), _MOST_TRIED)).astype(int))
    jobs = []
    for task in (judged[index] for index in picked):
        name = task.robot.name
        settings = mended_settings(analysis.robot, analysis.common, name)
        jobs.append(MendTask(task.robot, fleet.options, settings, before[name]))
    found = confirmed(list(workers(mended_error, jobs, _not_tried)))
    if found.holds:
        model = mended_model(load_model(fleet.options.model), mended_settings(analysis.robot, analysis.common))
        _save(model, path)
    return found


def _save(model: Any, path: Path) -> None:
    from safedpa.dynamics import write_model

    if isinstance(model.base, LearnedBase):
        save_model(model, path)
        return
    with atomic_path(path) as temporary:
        temporary.write_text(write_model(model), encoding="utf-8")


def _not_tried(task: MendTask, _reason: str) -> tuple[float, float]:
    return task.before, float("nan")
