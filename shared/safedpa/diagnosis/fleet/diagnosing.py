"""A fleet's diagnosis from recordings to fleet.json: what is not done yet is done, then the robots are compared."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from uuid import uuid4

from safedpa.diagnosis.fleet.document import analysed, fleet_document
from safedpa.diagnosis.fleet.inputs import Options, file_stamp, options_digest
from safedpa.diagnosis.fleet.mending import Workers, mended
from safedpa.diagnosis.fleet.one_robot import Task, diagnosed_robot, not_diagnosed
from safedpa.diagnosis.fleet.outcome import outcome_of
from safedpa.diagnosis.fleet.page import write_fleet_page
from safedpa.diagnosis.fleet.robots import Found, RobotLogs
from safedpa.diagnosis.fleet.splitting import robots_in, split_recording
from safedpa.diagnosis.fleet.store import clear_others, kept, results, write_result, write_scripts
from safedpa.dynamics import load_model
from safedpa.errors import InputError
from safedpa.records.atomic import atomic_path

__all__ = ["Fleet", "Workers", "diagnose_fleet"]

Tell = Callable[[int, int], None]


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
    _refuse_given(Path(options.model), out)
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
    common = mended(analysis, tasks, workers, out / "model.toml")
    document = fleet_document(analysis, common, **_about(fleet, len(todo)))
    with atomic_path(out / "fleet.json") as temporary:
        temporary.write_text(json.dumps(document, allow_nan=False, indent=1) + "\n", encoding="utf-8")
    write_fleet_page(document, analysis, out)
    return document


def _refuse_given(model: Path, out: Path) -> None:
    """The mended model must not take the place of the given one."""
    if model.exists() and model.resolve() == (out / "model.toml").resolve():
        raise InputError(
            f"--out {out}: got the given model's own folder; choose another one, model.toml is written there"
        )


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
