"""One supervised process: start, begin, restart and end."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from safedpa_services.supervisor.child import Child


class Process:
    """Stands for the result of ``subprocess.Popen``; ``all`` lists the instances in the order of their start."""

    all: list[Process]

    def __init__(self, command, **options):
        self.command, self.options = command, options
        self.pid, self.code, self.asked = 4711, None, 0
        self.stdin = options["stdin"] = open(os.devnull, "wb")  # noqa: SIM115  closed as the pipe would be
        self.all.append(self)

    def poll(self):
        return self.code

    def terminate(self):
        self.asked += 1

    def wait(self, _=0.0):
        return self.code or 0


@pytest.fixture
def started(monkeypatch):
    """The simulated processes that were started."""
    monkeypatch.setattr(Process, "all", [], raising=False)
    monkeypatch.setattr(subprocess, "Popen", Process)
    yield Process.all
    for process in Process.all:
        process.stdin.close()


def child_of(folder, **fields):
    return Child("policy", "module", ("--rate", "20"), folder / "policy.log", **fields)


def test_a_process_is_started_supervised_with_its_options_and_its_secrets_in_the_environment(started, tmp_path):
    """Arguments are readable by every user of the machine, the environment is not."""
    child_of(tmp_path, environment={"TOKEN": "secret"}).start()
    (process,) = started
    assert process.command == [sys.executable, "-m", "module", "--rate", "20", "--supervised"]
    environment = process.options["env"]
    assert (environment["TOKEN"], environment["SAFEDPA_LOG"]) == ("secret", "json")
    assert environment["OMP_NUM_THREADS"] == environment["OPENBLAS_NUM_THREADS"] == "1", "they share the processor"
    assert environment["PYTHONSAFEPATH"] == "1", "no module of the working directory is taken for one of ours"
    assert process.options["start_new_session"], "Ctrl-C reaches the supervisor alone"


def test_a_process_starts_without_a_log_if_none_can_be_written(started, tmp_path):
    (tmp_path / "file").write_text("no folder")
    Child("policy", "module", (), tmp_path / "file" / "policy.log").start()
    assert len(started) == 1


@pytest.mark.parametrize(("code", "running"), [(None, True), (0, False), (-9, False)])
def test_only_a_running_process_gets_a_signal_and_is_asked_to_end_once(started, code, running, tmp_path, monkeypatch):
    """The id of an ended process may belong to another one; a second signal would skip the orderly shutdown."""
    killed: list[tuple[int, int]] = []
    monkeypatch.setattr(os, "killpg", lambda group, number: killed.append((group, number)))
    child = child_of(tmp_path)
    child.kill()
    child.terminate()
    child.end(0.0)
    child.start()
    started[0].code = code
    child.kill()
    for _ in range(3):
        child.terminate()
    assert killed == ([(4711, signal.SIGKILL)] if running else [])
    assert started[0].asked == running


def test_a_process_that_dies_quickly_is_restarted_after_growing_pauses(started, clock, tmp_path):
    """0.1 s, then twice as long each time, 5 s at most; after more than 10 s of life there is no pause."""
    child, pauses = child_of(tmp_path), list[float]()
    clock.now = -clock.begin  # a clock that is at 0 as it dies
    child.start()
    for life in [0.0] * 7 + [9.0, 11.0, 0.0]:
        clock.now += life
        died = clock.now
        while not child.restart_if_due():
            clock.now += 0.01
        pauses.append(clock.now - died)
    assert pauses == pytest.approx([0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 5.0, 5.0, 0.0, 0.1], abs=0.02)
    assert child.restarts == 10
    assert len(started) == 11


@pytest.mark.parametrize(("life", "restarts"), [(0.0, 8), (9.9, 8), (10.1, 30), (119.0, 30), (121.0, 60)])
def test_a_process_that_ends_too_often_is_given_up_with_its_cause(started, clock, tmp_path, life, restarts):
    """After nine quick ends in a row, or after thirty restarts within an hour."""
    child = child_of(tmp_path)
    child.log.write_text("no space left on device\n")
    child.start()
    for _ in range(60):
        clock.now += life
        started[-1].code = 70
        until = clock.now + 6.0
        while not child.restart_if_due() and clock.now < until:
            clock.now += 0.01
    assert (child.restarts, child.given_up) == (restarts, restarts < 60)
    assert child.cause == "ended with code 70: no space left on device"


@pytest.mark.parametrize(
    ("log", "phrase"),
    [
        (None, "it wrote no message"),
        ("", "it wrote no message"),
        ("first\nsafedpa-policy: no such model\n\n", "no such model"),
        ('no such model\n{"level": "warning"}\n', "no such model"),
        ('{"level": "warning"}\n', "it wrote no message"),
    ],
)
def test_the_last_text_is_the_last_line_of_the_log_that_is_not_json(log, phrase, tmp_path):
    child = child_of(tmp_path)
    if log is not None:
        child.log.write_text(log)
    assert child.last_text() == phrase


def test_a_full_disk_is_named_where_no_message_could_be_written(tmp_path, monkeypatch):
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=0))
    assert f"no space is left on the disk of {tmp_path}" in child_of(tmp_path).last_text()


STUBBORN = """
import os, signal, subprocess, sys, time
signal.signal(signal.SIGTERM, signal.SIG_IGN if "--stubborn" in sys.argv else signal.SIG_DFL)
helper = subprocess.Popen([sys.executable, "-S", "-c", "import time; time.sleep(600)"])
with open(sys.argv[1] + ".new", "w") as file:
    file.write(f"{helper.pid}")
os.rename(sys.argv[1] + ".new", sys.argv[1])
time.sleep(600)
"""


@pytest.mark.processes
@pytest.mark.parametrize("stubborn", [False, True])
def test_a_process_that_does_not_end_in_time_is_killed_with_its_group(stubborn, tmp_path):
    (tmp_path / "stubborn.py").write_text(STUBBORN)
    reported = tmp_path / "helper"
    options = (str(reported), *(["--stubborn"] if stubborn else []))
    child = Child("robot", "stubborn", options, tmp_path / "log", environment={"PYTHONPATH": str(tmp_path)})
    child.start()
    until = time.monotonic() + 60.0
    while not reported.exists() and time.monotonic() < until:
        time.sleep(0.01)
    helper, asked = int(reported.read_text()), time.monotonic()
    child.end(0.3 if stubborn else 60.0)
    took = time.monotonic() - asked
    assert child.exit_code == (-signal.SIGKILL if stubborn else -signal.SIGTERM)
    assert took >= 0.3 if stubborn else took < 50.0
    if stubborn:
        while (state := state_of_process(helper)) not in ("Z", "") and time.monotonic() < until:
            time.sleep(0.01)
        assert state in ("Z", "")
    else:
        os.kill(helper, signal.SIGKILL)


def state_of_process(pid):
    """Returns the state ``R``, ``S`` ... of a process; empty if it does not exist."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return ""
