"""The whole loop as the user starts it: real processes, real Zenoh sessions."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from safedpa.bus import VerdictMessage
from safedpa.records import read_messages

pytestmark = [pytest.mark.processes, pytest.mark.slow]

SERVICES = ("adaptation", "policy", "safety_filter", "recorder")
PATIENCE = 120.0
"""s; only a busy machine takes this long."""


def up(folder: Path, *options: str) -> tuple[dict[str, Any], str]:
    command = [sys.executable, "-m", "safedpa_services", "up", "--headless", "--json", "--out", str(folder), *options]
    done = subprocess.run(command, capture_output=True, text=True, timeout=170, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("\n") == 1, "one JSON document and nothing else"
    return json.loads(done.stdout), done.stderr


def processes_with(text: str) -> list[int]:
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            try:
                line = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
            except OSError:
                continue
            if text in line:
                found.append(int(entry.name))
    return found


@pytest.mark.long
def test_lockstep_repeats_bit_for_bit_and_is_safe(tmp_path: Path) -> None:
    options = ("--robot", "car", "--load", "box", "--seconds", "20", "--lockstep", "--seed", "1")
    first, _ = up(tmp_path, *options)
    second, _ = up(tmp_path, *options)
    assert first["trajectory_sha256"] == second["trajectory_sha256"]
    assert first["ticks"] == 400
    assert first["collisions"] == 0
    assert first["goals_reached"] >= 1
    assert sum(first["verdicts"].values()) == first["ticks"]
    assert first["interventions"] > 0
    assert {service["name"] for service in first["services"]} == {"robot", *SERVICES}
    assert all(service["restarts"] == 0 for service in first["services"])
    assert Path(first["recording"]).stat().st_size > 10_000
    assert first["recording_error"] is None
    assert processes_with(str(tmp_path)) == []


@contextmanager
def driving(folder: Path, seconds: float) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "safedpa_services", "up", "--headless", "--json", "--out", str(folder)]
    command += ["--seconds", repr(seconds), "--seed", "1", "--load", "chair"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def pid_of(folder: Path, module: str) -> int:
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        for pid in processes_with(module):
            try:
                line = Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace")
                if "--supervised" in line and _belongs(pid, folder):
                    return pid
            except OSError:  # another process, which has ended meanwhile
                continue
        time.sleep(0.05)
    raise AssertionError(f"{module} never started")


def _belongs(pid: int, folder: Path) -> bool:
    return any(str(folder) in os.readlink(f"/proc/{pid}/fd/{number}") for number in (1, 2))


def wait_for(there: Callable[[], bool], otherwise: str) -> None:
    deadline = time.monotonic() + PATIENCE
    while not there():
        assert time.monotonic() < deadline, otherwise
        time.sleep(0.05)


def driven(folder: Path) -> int:
    """Returns the number of recorded periods in which the filter had all inputs."""
    recordings = folder.glob("*/recording*.mcap")
    messages = (message for path in recordings if path.stat().st_size for _, _, message in read_messages(path))
    return sum(isinstance(message, VerdictMessage) and message.status != "fallback" for message in messages)


def drives_on(folder: Path) -> None:
    """Returns when another second of driving has been recorded."""
    before = driven(folder)
    wait_for(lambda: driven(folder) >= before + 20, "the robot does not drive")


def killed(folder: Path, module: str) -> None:
    """Kills the process of a module; returns when it was restarted and the robot drives."""
    before = pid_of(folder, module)
    os.kill(before, signal.SIGKILL)
    wait_for(lambda: pid_of(folder, module) != before, f"{module} did not come back")
    drives_on(folder)


@pytest.mark.long
def test_a_killed_service_is_restarted_and_nothing_is_hit(tmp_path: Path) -> None:
    """Each service in turn, in one drive."""
    with driving(tmp_path, 0.0) as process:
        drives_on(tmp_path)
        for service in SERVICES:
            killed(tmp_path, f"safedpa_services.{service}")
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, errors
    assert _left(tmp_path) == []
    summary = json.loads(output)
    assert summary["collisions"] == 0
    restarts = {entry["name"]: entry["restarts"] for entry in summary["services"]}
    assert {name: restarts[name] for name in SERVICES} == dict.fromkeys(SERVICES, 1)
    assert sum(restarts.values()) == len(SERVICES)
    assert sum(count for status, count in summary["verdicts"].items() if status != "fallback") > 60, "it drove on"


@pytest.mark.long
def test_a_killed_supervisor_leaves_nothing_behind(tmp_path: Path) -> None:
    with driving(tmp_path, 0.0) as process:
        drives_on(tmp_path)
        process.kill()
        process.wait()
        deadline = time.monotonic() + PATIENCE
        while _left(tmp_path) and time.monotonic() < deadline:
            time.sleep(0.1)
    assert _left(tmp_path) == []


def _left(folder: Path) -> list[int]:
    left = []
    for pid in processes_with("--supervised"):
        try:
            if _belongs(pid, folder):
                left.append(pid)
        except OSError:
            continue
    return left


def test_bad_input_ends_the_process_with_code_2(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "safedpa_services", "up", "--headless", "--out", str(tmp_path), "--rate", "0"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "Traceback" not in done.stderr
