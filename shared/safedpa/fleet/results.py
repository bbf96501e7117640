"""Where the results of a fleet are: a folder, or object storage by URL, with one folder per robot.

A robot's ``result.json`` says which model, options and recordings it belongs to; a robot without a current one is
diagnosed again. So an interrupted diagnosis resumes. In object storage the workers write the results themselves, so
that a cluster needs no common folder, and ``result.json`` comes last: a killed worker leaves no result.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.resources import files
from itertools import islice
from pathlib import Path
from typing import Any, Protocol
from uuid import uuid4

from safedpa.errors import RecordingError
from safedpa.fleet.one_robot import FORMAT, RobotResult, Task, diagnose_robot, same_files
from safedpa.records.store import find_files, read_files, remove, url_of, write_file
from safedpa.records.writers.tables import atomic_path

__all__ = [
    "FolderResults",
    "Results",
    "StoredResults",
    "clear_others",
    "diagnose_into",
    "has_current_result",
    "iterate_results",
    "plotly_script",
    "read_result",
    "results_at",
    "write_result",
]

ROBOTS = "robots"
"""Folder that contains a folder per robot."""
_RESULT, _REPORT = "result.json", "report.json"
_WITH_REPORT = ("diagnosed", "no_verdict")
"""Statuses of robots that have a report.json."""
_GROUP = 200
"""Robots whose results are in memory at the same time."""
_PARTS = (_RESULT, _REPORT, "report.html", "model.toml")
"""Files of a robot."""

Pair = tuple[dict[str, Any], dict[str, Any] | None]
"""result.json, and report.json or None."""


class Results(Protocol):
    """A place for the results of a fleet."""

    def clear_others(self, tasks: Sequence[Task]) -> None:
        """Removes the results of robots that are no longer in the fleet, and what a killed run left behind."""

    def current(self, tasks: Sequence[Task]) -> set[str]:
        """Returns the names of the robots whose results belong to their model, options and recordings."""

    def write(self, result: RobotResult) -> None:
        """Writes the folder of a robot. Raises RecordingError if that fails."""

    def iterate(self, tasks: Sequence[Task]) -> Iterator[Pair]:
        """Yields (result.json, report.json or None) of every robot, in order."""

    def write_file(self, name: str, content: bytes) -> None:
        """Writes a file of the fleet. Raises RecordingError if that fails."""

    def new_file(self, name: str) -> Any:
        """Yields a local path; a file that is written there replaces ``name``, and without one ``name`` is removed."""


def results_at(out: Path) -> FolderResults | StoredResults:
    """Returns the results in a folder, or those at a URL that was given as a path."""
    url = url_of(out)
    return StoredResults(url) if url else FolderResults(out)


def diagnose_into(out: str, task: Task) -> RobotResult:
    """Diagnoses one robot and writes the result below the URL ``out``, where the worker runs; returns it without texts.

    Raises RecordingError if it cannot be written.
    """
    result = diagnose_robot(task)
    StoredResults(out).write(result, is_first=task.is_first)
    return RobotResult(result.name, result.document)


def plotly_script() -> bytes:
    """Returns plotly.js, which the pages of all robots share."""
    return files("plotly").joinpath("package_data", "plotly.min.js").read_bytes()


class FolderResults:
    """Results in a folder of this machine, written by the process that asks for the diagnosis."""

    def __init__(self, out: Path) -> None:
        self._out = out

    def clear_others(self, tasks: Sequence[Task]) -> None:
        """See ``Results``."""
        clear_others(tasks, self._out)

    def current(self, tasks: Sequence[Task]) -> set[str]:
        """See ``Results``."""
        return {task.robot.name for task in tasks if has_current_result(task, self._out)}

    def write(self, result: RobotResult) -> None:
        """See ``Results``."""
        write_result(result, self._out)

    def iterate(self, tasks: Sequence[Task]) -> Iterator[Pair]:
        """See ``Results``."""
        return iterate_results(tasks, self._out)

    def write_file(self, name: str, content: bytes) -> None:
        """See ``Results``."""
        with atomic_path(self._out / name) as temporary:
            temporary.write_bytes(content)

    @contextmanager
    def new_file(self, name: str) -> Iterator[Path]:
        """See ``Results``."""
        (self._out / name).unlink(missing_ok=True)  # the one of an earlier run
        yield self._out / name


class StoredResults:
    """Results in object storage, by URL."""

    def __init__(self, url: str) -> None:
        self.url = url.rstrip("/")

    def clear_others(self, tasks: Sequence[Task]) -> None:
        """See ``Results``."""
        names = {task.robot.name for task in tasks}
        for name, present in self._present().items():
            if name not in names and _RESULT in present:
                remove([self._file(name, part) for part in sorted(present, key=_RESULT.__ne__)])

    def current(self, tasks: Sequence[Task]) -> set[str]:
        """See ``Results``."""
        present = self._present()
        of_urls = {self._file(task.robot.name, _RESULT): task for task in tasks if task.robot.name in present}
        return {
            of_urls[url].robot.name
            for url, content in read_files(of_urls)
            if _is_current(_parsed(content), of_urls[url])
        }

    def robots(self) -> set[str]:
        """Returns the names of the robots of which any file exists."""
        return set(self._present())

    def write(self, result: RobotResult, *, is_first: bool = False) -> None:
        """See ``Results``; of a robot without earlier files (``is_first``) nothing has to be removed."""
        # result.json comes last and is never missing in between: an earlier one is of other inputs, and so not current,
        # or of the same, and then its files are the same too. A worker that outlives its command can do no harm.
        if not is_first:
            remove([self._file(result.name, part) for part in _PARTS if part not in result.texts and part != _RESULT])
        for name, text in (*result.texts.items(), (_RESULT, json.dumps(result.document, indent=1) + "\n")):
            write_file(self._file(result.name, name), text.encode())

    def iterate(self, tasks: Sequence[Task]) -> Iterator[Pair]:
        """See ``Results``."""
        names = iter([task.robot.name for task in tasks])
        while group := list(islice(names, _GROUP)):
            parsed = (_parsed(content) for _, content in read_files(self._file(name, _RESULT) for name in group))
            found = [item for item in parsed if item is not None and item.get("format") == FORMAT]
            urls = [self._file(item["robot"], _REPORT) for item in found if item["status"] in _WITH_REPORT]
            reports = dict(read_files(urls))
            for item in found:
                yield item, _parsed(reports.get(self._file(item["robot"], _REPORT)))

    def write_file(self, name: str, content: bytes) -> None:
        """See ``Results``."""
        write_file(f"{self.url}/{name}", content)

    @contextmanager
    def new_file(self, name: str) -> Iterator[Path]:
        """See ``Results``."""
        remove([f"{self.url}/{name}"])
        with tempfile.TemporaryDirectory(prefix="safedpa-fleet-") as folder:
            path = Path(folder) / name
            yield path
            for file in Path(folder).iterdir():  # a learned model has its weights next to it
                write_file(f"{self.url}/{file.name}", file.read_bytes())

    def _file(self, robot: str, name: str) -> str:
        return f"{self.url}/{ROBOTS}/{robot}/{name}"

    def _present(self) -> dict[str, set[str]]:
        """Returns the names of the files of each robot."""
        base = f"{self.url}/{ROBOTS}/"
        present: dict[str, set[str]] = {}
        for url in find_files(base):
            robot, _, name = url.removeprefix(base).partition("/")
            present.setdefault(robot, set()).add(name)
        return present


def _parsed(content: bytes | None) -> dict[str, Any] | None:
    try:
        found = json.loads(content) if content is not None else None
    except ValueError:
        return None
    return found if isinstance(found, dict) else None


def _is_current(found: dict[str, Any] | None, task: Task) -> bool:
    # "failed" means a defect of the program, which may be fixed now.
    if found is None or found.get("format") != FORMAT or found["digest"] != task.digest or found["status"] == "failed":
        return False
    return same_files(found["files"], task.robot.files)


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
    return _is_current(read_result(out / ROBOTS / task.robot.name), task)


def read_result(folder: Path) -> dict[str, Any] | None:
    """Reads a robot's ``result.json``; None if there is none of this format."""
    try:
        found = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) and found.get("format") == FORMAT else None


def iterate_results(tasks: Sequence[Task], out: Path) -> Iterator[Pair]:
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
