"""Every road on which a file reaches the product: each command and option that reads one, and the workbench's upload.

A road is tried in a fork of this process, in an empty folder, with what it says caught, its memory and processor time
measured, and the folder looked at afterwards.
"""

from __future__ import annotations

import os
import re
import resource
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

from safedpa.errors import InputError
from safedpa.records.readers.own_process import in_this_process
from safedpa_lab.experiments.hostile.bombs import BOMBS, Bomb
from safedpa_lab.experiments.record import ReportProgress, silent

MOST_SECONDS = 2.0
"""Of processor time, for one command; one in ten is importing."""
MOST_MEBIBYTES = 200.0
"""Beyond what the process had."""
_LONGEST_SECONDS = 40.0
_MOST_LETTERS = 1500
_NOT_PRINTED = re.compile(r"[\x00-\x09\x0b-\x1f\x7f-\x9f\u200b-\u200f\u2028-\u202e\u2066-\u2069]")
_RUNS = (".csv", ".parquet", ".mcap", ".bag", ".db3", ".ulg", ".zstd", ".yaml")
_BAGS = (".bag", ".db3", ".ulg", ".zstd", ".yaml")
_COLUMNS = ("--columns", "f1tenth_bag")


@dataclass(frozen=True)
class Road:
    """One way in, for files of these endings."""

    name: str
    endings: tuple[str, ...]
    arguments: tuple[str, ...]
    """The words after ``safedpa``, or what the workbench is asked to open; ``{file}`` is the hostile file, ``{good}`` a
    harmless recording, ``{folder}`` where to write."""
    may_answer: bool = False
    """Whether it reads names alone, and may list them of a file whose rows would be too much."""
    may_copy: bool = False
    """Whether it may write a copy of the file, the same to the last byte, without reading what is in it."""


def _model(*phrase: str) -> tuple[str, tuple[str, ...], tuple[str, ...]]:
    return f"{phrase[0]}: model", (".toml",), phrase


def _map(*phrase: str) -> tuple[str, tuple[str, ...], tuple[str, ...]]:
    return f"{phrase[0]}: column map", (".map",), phrase


def _run(*phrase: str) -> tuple[str, tuple[str, ...], tuple[str, ...]]:
    return f"{phrase[0]}: recording", _RUNS, phrase


_UP = ("up", "--headless", "--lockstep", "--seconds", "1", "--out", "{folder}/runs")
_TOML = (".toml",)
ROADS: tuple[Road, ...] = tuple(
    Road(*entry)
    for entry in (
        _model("compare", "{file}", "{good}", "--out", "{folder}/out"),
        ("compare --before: model", _TOML, ("compare", "car", "{good}", "--before", "{file}", "--out", "{folder}/out")),
        _model("diagnose", "{file}", "{good}", "--out", "{folder}/out"),
        _model("add", "{file}", "payload", "{good}", "--out", "{folder}/m.toml"),
        _model("refit", "{file}", "{good}", "--out", "{folder}/m.toml"),
        _model("remove", "{file}", "payload", "{good}", "--out", "{folder}/m.toml"),
        _model("predict", "{file}", "{good}", "--horizon", "1", "--out", "{folder}/p.csv"),
        _model("rehearse", "{file}", "{good}"),
        _model("calibrate", "--model", "{file}", "{good}", "--out", "{folder}/m.toml"),
        _model("export", "{file}", "--format", "simulators", "--out", "{folder}/m"),
        _model("train", "car", "--model", "{file}", "--out", "{folder}/out"),
        ("up --model", _TOML, (*_UP, "--model", "{file}")),
        ("up --settings", _TOML, (*_UP, "--settings", "{file}")),
        ("up --margin", _TOML, (*_UP, "--margin", "{file}")),
        ("up --perception", _TOML, (*_UP, "--laser", "--perception", "{file}")),
        ("serve: robot", _TOML, ("serve", "{file}", "--out", "{folder}/runs")),
        ("ros run: robot", _TOML, ("ros", "run", "{file}")),
        ("ros sources: robot", _TOML, ("ros", "sources", "{file}", "{good}")),
        ("ros from-collision-monitor", (".yaml",), ("ros", "from-collision-monitor", "{file}")),
        ("train --configuration", _TOML, ("train", "car", "--configuration", "{file}", "--out", "{folder}/out")),
        _map("compare", "car", "{good}", "--columns", "{file}", "--out", "{folder}/out"),
        _map("diagnose", "car", "{good}", "--columns", "{file}", "--out", "{folder}/out"),
        _map("add", "car", "payload", "{good}", "--columns", "{file}", "--out", "{folder}/m.toml"),
        _map("refit", "car", "{good}", "--columns", "{file}", "--out", "{folder}/m.toml"),
        _map("predict", "car", "{good}", "--columns", "{file}", "--horizon", "1", "--out", "{folder}/p.csv"),
        _map("rehearse", "car", "{good}", "--columns", "{file}"),
        _run("compare", "car", "{file}", "--out", "{folder}/out"),
        _run("diagnose", "car", "{file}", "--out", "{folder}/out"),
        _run("add", "car", "payload", "{file}", "--out", "{folder}/m.toml"),
        _run("refit", "car", "{file}", "--out", "{folder}/m.toml"),
        _run("predict", "car", "{file}", "--horizon", "1", "--out", "{folder}/p.csv"),
        _run("rehearse", "car", "{file}"),
        (*_run("columns", "{file}", "--robot", "car"), True),
        ("init: recording", (".csv", ".parquet"), ("init", "{file}", "--out", "{folder}/robot")),
        ("calibrate: recording", (".mcap",), ("calibrate", "{file}", "--out", "{folder}/m.toml")),
        ("replay: recording", (".mcap", ".csv"), ("replay", "{file}", "--out", "{folder}/r.csv")),
        ("export: recording", (".mcap",), ("export", "{file}", "--format", "csv", "--out", "{folder}/r.csv")),
        ("export: weights", (".safetensors",), ("export", "{file}", "--onnx", "{folder}/onnx")),
        ("migrate: file", (".toml", ".mcap"), ("migrate", "{file}", "--out", "{folder}/new"), False, True),
        ("workbench --session", (".json",), ("workbench", "--session", "{file}", "--out", "{folder}/out")),
        ("workbench: model", _TOML, ("{file}", "{good}", "")),
        ("workbench: column map", (".map",), ("car", "{good}", "{file}")),
        ("workbench: recording", _RUNS, ("car", "{file}", "")),
        ("workbench: upload", _RUNS, ()),
    )
)  # fmt: skip
"""Bags are compared, diagnosed and so on with the column map that ships for them.

The workbench says on its page what it cannot open: of it the function behind its Open button is asked, by model,
recording and column map, and the two that look at an upload.
"""


@dataclass(frozen=True)
class Outcome:
    """What one road did with one bomb."""

    road: str
    bomb: str
    code: int
    notice: str
    seconds: float
    """Of processor time."""
    mebibytes: float
    """At most, beyond what the process had at first."""
    written: tuple[str, ...]
    """Files that were not there before."""
    may_answer: bool = False

    @property
    def hole(self) -> str:
        """What is wrong with it; empty where it was refused as it should be."""
        answered = self.may_answer and self.code == 0
        if self.code != 2 and not answered:
            return f"exit code {self.code}: {self.notice[-300:]!r}"
        if (
            not self.notice.strip()
            or _NOT_PRINTED.search(self.notice)
            or not (answered or self.notice.count("\n") == 1)
        ):
            return f"did not say one line: {self.notice[:300]!r}"
        if len(self.notice) > _MOST_LETTERS and not answered:
            return f"said {len(self.notice)} letters"
        if self.mebibytes > MOST_MEBIBYTES:
            return f"took {self.mebibytes:.0f} MiB"
        return f"wrote {', '.join(self.written[:5])}" if self.written else ""


def pairs() -> Iterator[tuple[Road, Bomb]]:
    """Every road with every bomb of its endings, bomb by bomb."""
    for bomb in BOMBS:
        for road in ROADS:
            if bomb.ending in road.endings:
                yield road, bomb


def good_recording(folder: Path) -> Path:
    """A car that drives straight on, for the roads that want a recording next to what is hostile."""
    path = folder / "good.csv"
    rows = "".join(f"{0.05 * k:.2f},{0.05 * k:.3f},0,0,1,1,0\n" for k in range(200))
    path.write_text(f"t,x,y,yaw,speed,target_speed,steer\n{rows}", encoding="utf-8")
    return path


def placed(content: bytes, bomb: Bomb, folder: Path) -> Path:
    """The bomb as a person would have it: a bag's description in its folder, a packed file with both endings."""
    name = {".map": "bomb.toml", ".zstd": "bomb.mcap.zstd", ".yaml": "bag/metadata.yaml"}
    path = folder / name.get(bomb.ending, f"bomb{bomb.ending}")
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(content)
    return path.parent if bomb.ending == ".yaml" else path


def prepare() -> None:
    """Imports what the commands import, so that a fork measures what a file costs."""
    for name in (
        "numpy", "pyarrow.parquet", "pyarrow.csv", "zstandard", "lz4.frame", "mcap.reader", "rosbags.typesys",
        "pyulog.core", "safetensors", "safedpa.records.readers.mcap", "safedpa.diagnosis", "safedpa.policy.node",
        "safedpa_services.command_line.up", "safedpa_services.workbench.open_dialog.file_preview",
        "safedpa_services.workbench.session.session", "safedpa.ros.definitions",
    ):  # fmt: skip
        import_module(name)


def tried(road: Road, bomb: Bomb, content: bytes) -> Outcome:
    """Sends the bomb along the road, in a fork."""
    with tempfile.TemporaryDirectory(prefix="safedpa-roads-") as name:
        folder = Path(name).resolve()
        inside = folder / "inside"
        inside.mkdir()
        file, good = placed(content, bomb, inside), good_recording(inside)
        before = {str(path.relative_to(inside)) for path in inside.rglob("*")}
        notice = folder / "notice"
        code, seconds, peak = _forked(lambda: _walked(road, bomb, file, good, inside), inside, notice)
        written = {str(path.relative_to(inside)) for path in inside.rglob("*")} - before
        found = [inside / one for one in sorted(written) if (inside / one).is_file()]
        copied = road.may_copy and bool(found) and all(path.read_bytes() == file.read_bytes() for path in found)
        text = notice.read_bytes()[:100_000].decode("utf-8", "replace").replace(str(inside), "...")
        about = f"{bomb.ending[1:]}: {bomb.name}"
        more = () if copied else tuple(sorted(written))
        return Outcome(road.name, about, code, text, seconds, peak, more, road.may_answer or copied)


def _walked(road: Road, bomb: Bomb, file: Path, good: Path, folder: Path) -> int:
    phrase = [word.format(file=file, good=good, folder=folder) for word in road.arguments]
    if road.name.startswith("workbench:"):
        return _opened(phrase) if phrase else _uploaded(file)
    from safedpa_services.command_line.group import safedpa

    if bomb.ending in _BAGS and phrase[0] not in ("columns", "replay", "export", "calibrate"):
        phrase += _COLUMNS
    return safedpa.run(phrase)


def _opened(phrase: Sequence[str]) -> int:
    """What the Open button does."""
    from safedpa_services.workbench.session.inputs import InputSelection, load_inputs

    model, run, columns = phrase
    bag = Path(run).suffix in _BAGS or Path(run).is_dir()
    try:
        load_inputs(InputSelection(model, (run,), columns or (_COLUMNS[1] if bag else None)))
    except InputError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    return 0


def _uploaded(file: Path) -> int:
    """What the page does with an upload: looks whether it is a recording, reads its first rows, then checks it."""
    from safedpa.dynamics import load_model
    from safedpa.records import load_column_map
    from safedpa.records.readers.preview import raw_rows
    from safedpa_services.web.upload_store import FileStore
    from safedpa_services.workbench.open_dialog.file_preview import check_recording

    try:
        (path,) = FileStore([file.parent]).recordings([str(file)])
        raw_rows(path)
        columns = load_column_map("f1tenth_bag") if file.suffix in _BAGS else None
        problem = check_recording(path, load_model("car").system, columns).problem
    except InputError as error:
        problem = str(error)
    if problem:
        sys.stderr.write(f"{problem}\n")
    return 2 if problem else 0


def _forked(work: Callable[[], int], folder: Path, notice: Path) -> tuple[int, float, float]:
    """Exit code, s of processor time, and MiB at most beyond what there was, of ``work`` in a fork in ``folder``."""
    sys.stdout.flush()
    sys.stderr.flush()
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        _child(work, folder, notice, writing)
    os.close(writing)
    status = _awaited(child)
    with os.fdopen(reading, "rb") as pipe:
        reported = pipe.read(1000).decode().split()
    code = os.waitstatus_to_exitcode(status)
    seconds, peak = (float(reported[0]), float(reported[1])) if len(reported) == 2 else (_LONGEST_SECONDS, 0.0)
    return code, seconds, peak


def _awaited(child: int) -> int:
    end = time.monotonic() + _LONGEST_SECONDS
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return status
        time.sleep(0.01)
    os.killpg(child, signal.SIGKILL)
    return os.waitpid(child, 0)[1]


def _child(work: Callable[[], int], folder: Path, notice: Path, reported: int) -> NoReturn:
    code = 1
    try:
        os.setpgid(0, 0)
        out = os.open(notice, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
        os.dup2(out, 1)
        os.dup2(out, 2)
        sys.stdout, sys.stderr = (os.fdopen(number, "w", closefd=False) for number in (1, 2))
        os.chdir(folder)
        os.environ["TMPDIR"] = str(folder.parent)
        resource.setrlimit(resource.RLIMIT_CPU, (int(_LONGEST_SECONDS), int(_LONGEST_SECONDS)))
        with suppress(OSError):  # the peak begins again, where the kernel can do that
            Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
        before, began = _memory("VmRSS"), time.process_time()
        try:
            with in_this_process():  # what a reader takes is measured here
                code = work()
        except SystemExit as error:
            code = error.code if isinstance(error.code, int) else 1
        except BaseException:  # noqa: BLE001  this is what is looked for
            traceback.print_exc()
        sys.stdout.flush()
        sys.stderr.flush()
        os.write(reported, f"{time.process_time() - began} {_memory('VmHWM') - before}".encode())
    finally:
        os._exit(code)


def _memory(what: str) -> float:
    """MiB."""
    with open("/proc/self/status", encoding="ascii") as status:
        line = next(line for line in status if line.startswith(what))
    return float(line.split()[1]) / 1024.0


def walk(chosen: Sequence[tuple[Road, Bomb]], report_progress: ReportProgress = silent) -> list[dict[str, Any]]:
    """A row for each pair; a bomb is made once for all roads that follow each other with it."""
    prepare()
    rows: list[dict[str, Any]] = []
    made: tuple[Bomb | None, bytes] = (None, b"")
    for road, bomb in chosen:
        if made[0] is not bomb:
            made = bomb, bomb.make()
        found = tried(road, bomb, made[1])
        hole = found.hole or (f"took {found.seconds:.1f} s" if found.seconds > MOST_SECONDS else "")
        rows.append(
            {
                "road": found.road,
                "bomb": found.bomb,
                "seconds": round(found.seconds, 3),
                "mebibytes": round(found.mebibytes, 1),
                "notice": found.notice.strip()[:300],
                "hole": hole,
            }
        )
        report_progress(len(rows), len(chosen))
    return rows
