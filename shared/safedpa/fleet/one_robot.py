"""The diagnosis of one robot of a fleet, which runs in a worker process.

The result consists of a few texts and is small, whatever the length of the recordings. It is current as long as model,
options and recordings are the same: a recording with unchanged size and modification time counts as unchanged,
otherwise its contents are compared.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from safedpa.errors import InputError, SafedpaError
from safedpa.fleet.robots import RobotLogs
from safedpa.records.store import TransferError, url_of, version_of

if TYPE_CHECKING:
    from safedpa.diagnosis.report_schema import Report
    from safedpa.dynamics import PhysicsModel
    from safedpa.records.run import Run


_BLOCK = 1 << 20


@dataclass(frozen=True)
class Options:
    """Options of the diagnosis of every robot: model, column map and user effects by path or name."""

    model: str
    columns: str | None = None
    horizon: float = 1.0
    effects: str | None = None
    scripts: str = "../../plotly.min.js"
    """Relative path from a robot's page to plotly.js, which the whole fleet shares."""


def options_digest(options: Options) -> str:
    """Returns a hex digest of all inputs but the recordings, including the version of the program."""
    digest = hashlib.sha256(f"{version('safedpa')} {options.horizon!r}".encode())
    for source in (options.model, options.columns, options.effects):
        files = _files_of(source)
        digest.update(f"|{'' if files else source}|".encode())
        for path in files:
            digest.update(f"{path.name} {path.stat().st_size} ".encode() + path.read_bytes())
    return digest.hexdigest()


def _files_of(source: str | None) -> list[Path]:
    """Returns the named file and, for a model, the weights next to it; empty for the name of a shipped file."""
    path = Path(source) if source else None
    if path is None or not path.is_file():
        return []
    weights = sorted(path.parent.glob("*.safetensors")) if path.suffix == ".toml" else []
    return [path, *weights]


def file_stamp(path: Path) -> dict[str, Any]:
    """Returns path, size, modification time and SHA-256 of a file. Raises OSError if it cannot be read.

    Of a file by URL: path, size and the version that its store reports, so that it is not transferred again.
    """
    if url := url_of(path):
        return version_of(url)
    status = path.stat()
    with path.open("rb") as file:
        digest = hashlib.sha256()
        while block := file.read(_BLOCK):
            digest.update(block)
    return {
        "path": str(path),
        "bytes": status.st_size,
        "modified_ns": status.st_mtime_ns,
        "sha256": digest.hexdigest(),
    }


def same_files(stamps: Iterable[Mapping[str, Any]], paths: Iterable[Path]) -> bool:
    """Whether the files are the stamped ones, possibly in another folder."""
    before, now = list(stamps), list(paths)
    if [Path(item["path"]).name for item in before] != [path.name for path in now]:
        return False
    try:
        return all(_same(item, path) for item, path in zip(before, now, strict=True))
    except OSError:
        return False


def _same(stamp: Mapping[str, Any], path: Path) -> bool:
    if url := url_of(path):
        # Without a version the store reports no change of the content.
        return bool(stamp.get("version")) and {**stamp, "path": url} == version_of(url)
    if "sha256" not in stamp:  # of the same file in object storage
        return False
    status = path.stat()
    if status.st_size != stamp["bytes"]:
        return False
    untouched = status.st_mtime_ns == stamp["modified_ns"] and str(path) == stamp["path"]
    return bool(untouched or file_stamp(path)["sha256"] == stamp["sha256"])


FORMAT = 1
Status = Literal["diagnosed", "no_verdict", "unreadable", "failed"]
"""``no_verdict``: the data do not allow one, for example because they are too short. ``failed``: a defect of the
program."""


@dataclass(frozen=True)
class Task:
    """A robot to diagnose."""

    robot: RobotLogs
    options: Options
    digest: str
    is_first: bool = False
    """Whether no file of an earlier result exists."""


@dataclass(frozen=True)
class RobotResult:
    """The contents of ``result.json``, and the texts of the other files by name."""

    name: str
    document: dict[str, Any]
    texts: Mapping[str, str] = field(default_factory=dict)


def diagnose_robot(task: Task) -> RobotResult:
    """Reads and diagnoses one robot. Problems with its data do not raise; they are reported in the result."""
    begin, processor = time.perf_counter(), time.process_time()
    unread: list[dict[str, str]] = []
    try:
        status, reason, report, texts = _diagnosed(task, unread)
    except SafedpaError as error:
        status, reason, report, texts = "unreadable", str(error), None, {}
    document = _document(task, status, reason, unread)
    document["seconds"] = round(time.perf_counter() - begin, 3)
    document["processor_seconds"] = round(time.process_time() - processor, 3)
    document["memory_mebibytes"] = _most_mebibytes()
    document["measured_seconds"] = 0.0 if report is None else round(report[1], 3)
    return RobotResult(task.robot.name, document, texts)


def _most_mebibytes() -> int:
    """Most memory of this process so far [MiB]; 0 where the system does not report it."""
    try:
        import resource
    except ImportError:
        return 0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024


def failed_result(task: Task, reason: str) -> RobotResult:
    """Returns the result of a robot whose process died or raised an unexpected exception."""
    return RobotResult(task.robot.name, _document(task, "failed", reason, []))


def _document(task: Task, status: Status, reason: str, unread: list[dict[str, str]]) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "robot": task.robot.name,
        "status": status,
        "reason": reason,
        "digest": task.digest,
        "files": [] if any("kind" in item for item in unread) else _stamps(task.robot.files),
        "unreadable_files": unread,
    }


def _stamps(paths: Sequence[Path]) -> list[dict[str, Any]]:
    """Returns the stamps of the files; empty if one cannot be read."""
    # Without stamps the result never counts as current, so the robot is diagnosed again next time.
    try:
        return [file_stamp(path) for path in paths]
    except OSError:
        return []


def _diagnosed(
    task: Task, unread: list[dict[str, str]]
) -> tuple[Status, str, tuple[Report, float] | None, dict[str, str]]:
    from safedpa.diagnosis.diagnose import diagnose
    from safedpa.diagnosis.report_schema import as_document
    from safedpa.dynamics import load_model

    model = load_model(task.options.model)
    runs, lost = read_runs(model, task.robot, task.options)
    unread += lost
    if not runs:
        return "unreadable", unread[0]["reason"], None, {}
    report = diagnose(model, runs, task.options.horizon)
    document = as_document(report)
    texts = {"report.json": json.dumps(document, allow_nan=False, indent=1) + "\n"}
    texts |= _model_text(report.models[-1])
    texts["report.html"] = _page(document, runs, report, task)
    silent = not (report.unexplained and report.unexplained.depends_on)
    none = report.verdict in ("unexplained", "undecided") and silent
    reason = _why_none(report) if none else ""
    measured = sum(run.duration for run in runs)
    return "no_verdict" if none else "diagnosed", reason, (report, measured), texts


def _why_none(report: Report) -> str:
    """Returns why there is no verdict."""
    if report.unexplained is not None:
        return report.unexplained.expression
    if report.verdict != "undecided":
        return "the model predicts badly with any added effect"
    if report.closest:
        return f"not enough data; closest: {report.closest[0].effect}"
    return "the data are too uniform to tell"


def read_runs(model: PhysicsModel, robot: RobotLogs, options: Options) -> tuple[list[Run], list[dict[str, str]]]:
    """Returns the robot's readable runs with distinct names, and the unreadable files with the reason.

    Raises InputError and ColumnMapError for problems with the options.
    """
    from safedpa.comparison.comparison import with_distinct_names
    from safedpa.errors import RunError
    from safedpa.records import load_column_map, load_run

    mapping = load_column_map(options.columns) if options.columns else None
    runs, paths, unread = [], [], []
    for path in robot.files:
        try:
            runs.append(load_run(path, model.system, mapping))
            paths.append(str(path))
        except (RunError, OSError) as error:
            unread.append({"path": str(path), "reason": str(error)} | _transfer(error))
    return (with_distinct_names(runs, paths) if runs else []), unread


def _transfer(error: Exception) -> dict[str, str]:
    """Marks a file that its store did not deliver, so that the next diagnosis tries it again."""
    return {"kind": "transfer"} if isinstance(error, (TransferError, OSError)) else {}


def _model_text(model: PhysicsModel) -> dict[str, str]:
    """Returns the text of the diagnosed model; none for a learned one, which needs its weights next to it."""
    from safedpa.dynamics import LearnedBase, write_model

    return {} if isinstance(model.base, LearnedBase) else {"model.toml": write_model(model)}


def _page(document: Mapping[str, Any], runs: Sequence[Run], report: Report, task: Task) -> str:
    """Returns the robot's report page, with the fleet's shared plotly.js instead of 4 MB of its own."""
    from importlib.resources import files

    from safedpa.report.diagnosis_page import report_page

    text = report_page(document, runs, report.models, task.robot.name)
    own = files("plotly").joinpath("package_data", "plotly.min.js").read_text(encoding="utf-8")
    policy = "script-src 'unsafe-inline'"
    if own not in text or policy not in text:
        raise InputError("report page: unexpected template, wanted plotly.js in a separate script element")
    shared = f'<script src="{task.options.scripts}"></script>'
    return text.replace(f"<script>{own}</script>", shared).replace(policy, f"{policy} 'self' file:")
