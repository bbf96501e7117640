"""Results of a fleet's robots on disk: each robot's folder is there whole or not at all, so killed work goes on."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any
from uuid import uuid4

from safedpa.diagnosis.fleet.inputs import same_files
from safedpa.diagnosis.fleet.one_robot import FORMAT, RobotResult, Task
from safedpa.errors import RecordingError
from safedpa.records.atomic import atomic_path

__all__ = ["ROBOTS", "clear_others", "kept", "read_result", "results", "write_result", "write_scripts"]

ROBOTS = "robots"
"""Folder of the robots' folders."""


def write_result(result: RobotResult, out: Path) -> None:
    """Writes ``out/robots/NAME``: a hidden folder first, then renamed. Raises RecordingError when it cannot be."""
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


def kept(task: Task, out: Path) -> bool:
    """Whether the robot's result is there and belongs to the same model, options and recordings.

    What failed by the program's own fault is done again.
    """
    found = read_result(out / ROBOTS / task.robot.name)
    if found is None or found["digest"] != task.digest or found["status"] == "failed":
        return False
    return same_files(found["files"], task.robot.files)


def read_result(folder: Path) -> dict[str, Any] | None:
    """A robot's ``result.json``; None where there is none of this format."""
    try:
        found = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) and found.get("format") == FORMAT else None


def results(tasks: Sequence[Task], out: Path) -> Iterator[tuple[dict[str, Any], dict[str, Any] | None]]:
    """(result.json, report.json or None) of every robot, one at a time."""
    for task in tasks:
        folder = out / ROBOTS / task.robot.name
        found = read_result(folder)
        if found is None:
            continue
        report = folder / "report.json"
        yield found, json.loads(report.read_text(encoding="utf-8")) if report.exists() else None


def clear_others(tasks: Sequence[Task], out: Path) -> None:
    """Takes away folders of robots that the fleet does not have any more, and what a killed run left half written."""
    names = {task.robot.name for task in tasks}
    folder = out / ROBOTS
    for path in folder.iterdir() if folder.is_dir() else ():
        half = path.name.startswith(".") and path.suffix in (".part", ".old")
        other = path.name not in names and (path / "result.json").exists()
        if half or other:
            shutil.rmtree(path, ignore_errors=True)


def write_scripts(out: Path) -> None:
    """Writes plotly.js once for the robots' pages."""
    text = files("plotly").joinpath("package_data", "plotly.min.js").read_bytes()
    with atomic_path(out / "plotly.min.js") as temporary:
        temporary.write_bytes(text)
