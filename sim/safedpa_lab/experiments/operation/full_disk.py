"""Runs whose disk fills in each phase: the drive goes on or ends once, reports it, and its recording is readable."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from safedpa.errors import RecordingError, SafedpaError
from safedpa_lab.experiments.record import Options, ReportProgress, Result

FREE_BYTES: Final = (40_000, 500_000, 6_000_000)
PHASES: Final = ("start", "drive", "end")
_DISK_BYTES = 64 << 20
_START_SECONDS, _END_SECONDS = 120.0, 60.0
_PARTS, _PART_SECONDS = 8, 0.4
_RECORDED_BYTES = 20_000
"""A recording of this size shows that the robot drives."""


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment full-disk``."""
    cases = [(phase, free) for phase in PHASES for free in FREE_BYTES]
    runs = []
    for number, (phase, free) in enumerate(cases):
        runs.append({"phase": phase, "free_bytes": free, **_run_on(phase, free, options["seconds"], options["seed"])})
        report_progress(number + 1, len(cases))
    return {"experiment": "full-disk", "seconds": options["seconds"], "seed": options["seed"], "runs": runs}


def trouble_of(one: dict[str, Any]) -> list[str]:
    """Returns what one run did not do as it should; one that was complete before has nothing to report."""
    found = [] if one["ended"] else ["did not end in time"]
    found += [f"robot started {one['robot_starts']} times"] if one["robot_starts"] > 1 else []
    found += ["the disk is not reported"] if one["filled"] and one["code"] != 0 and not one["reported"] else []
    return found + ([] if one["readable"] else ["the recording is unreadable"])


def verdict(result: Result) -> None:
    """Raises SafedpaError with everything that went wrong."""
    found = [f"{one['phase']}, {one['free_bytes']} bytes: {text}" for one in result["runs"] for text in trouble_of(one)]
    if found:
        raise SafedpaError(f"full-disk: {'; '.join(found)}")


def report(result: Result) -> str:
    """One row for each run."""
    lines = ["| phase | free bytes | exit code | s | messages readable | last line |", "|---|---|---|---|---|---|"]
    return "\n".join(
        [
            *lines,
            *(
                f"| {one['phase']} | {one['free_bytes']} | {one['code']} | {one['seconds']:.0f} | {one['messages']} | "
                f"{'; '.join(trouble_of(one)) or one['last_line'][:110]} |"
                for one in result["runs"]
            ),
        ]
    )


def _run_on(phase: str, free: int, seconds: float, seed: int) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="safedpa-full-") as name, _disk(Path(name) / "place") as disk:
        output, filler = Path(name) / "output", disk / "filler"
        if phase == "start":
            _fill(filler, free)
        command = [sys.executable, "-m", "safedpa_services", "up", "--headless", "--seconds", repr(seconds)]
        command += ["--seed", str(seed), "--out", str(disk / "runs")]
        began = time.monotonic()
        with output.open("wb") as log:
            running = subprocess.Popen(command, stdout=log, stderr=log)
        try:
            if phase != "start":
                _await_recording(disk, running)
                time.sleep(0.0 if phase == "drive" else max(seconds - 1.5, 0.0))
                _fill(filler, free)
            _take_rest(filler, free, running, began + seconds + _START_SECONDS + _END_SECONDS)
        finally:
            running.kill()
        ended = running.wait() != -signal.SIGKILL
        return {"ended": ended, "code": running.returncode, "seconds": time.monotonic() - began} | _found(disk, output)


def _found(disk: Path, output: Path) -> dict[str, Any]:
    from safedpa.records.readers.mcap import read_payloads

    lines = output.read_text(errors="replace").splitlines()
    messages, readable = 0, True
    for path in (disk / "runs").glob("*/*.mcap"):
        try:
            messages += sum(1 for _ in read_payloads(path)) if path.stat().st_size else 0
        except (RecordingError, SafedpaError):
            readable = False
    text = " ".join(lines).lower()
    return {
        "filled": _free(disk) < (1 << 16),
        "reported": "no space" in text or "space is left" in text,
        "robot_starts": 1 + sum("robot was restarted" in line for line in lines),
        "messages": messages,
        "readable": readable,
        "last_line": lines[-1] if lines else "",
    }


def _await_recording(disk: Path, running: subprocess.Popen[bytes]) -> None:
    until = time.monotonic() + _START_SECONDS
    while running.poll() is None and time.monotonic() < until:
        if any(path.stat().st_size > _RECORDED_BYTES for path in (disk / "runs").glob("*/*.mcap")):
            return
        time.sleep(0.1)


def _fill(filler: Path, free: int) -> None:
    with filler.open("ab") as file:
        os.posix_fallocate(file.fileno(), file.tell(), max(_free(filler.parent) - free, 1))


def _take_rest(filler: Path, free: int, running: subprocess.Popen[bytes], until: float) -> None:
    """Takes the free space in equal parts while the run goes on, as another program would."""
    for left in [free * part // _PARTS for part in range(_PARTS - 1, -1, -1)]:
        time.sleep(_PART_SECONDS)
        with contextlib.suppress(OSError):  # the run itself has taken it
            _fill(filler, left)
    while running.poll() is None and time.monotonic() < until:
        time.sleep(0.1)


def _free(disk: Path) -> int:
    status = os.statvfs(disk)
    return status.f_bavail * status.f_frsize


@contextmanager
def _disk(folder: Path) -> Iterator[Path]:
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={_DISK_BYTES},mode=0700", "safedpa-full-disk", str(folder)]
    if subprocess.run(command, capture_output=True, check=False).returncode != 0:
        raise SafedpaError("full-disk: no file system could be mounted; only the superuser may")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)
