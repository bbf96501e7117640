"""A robot prepares itself while its services start, and does nothing before it is asked to begin."""

import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from safedpa.bus.service.process import StopSignal
from safedpa_services.supervisor.child import Child

_ROBOT = """
import argparse, pathlib, time
from safedpa.bus.service.process import run_process

def work(options, stop):
    ready = options.folder / "ready"
    ready.write_text(ready.read_text() + "again" if ready.exists() else "once")
    if options.await_word:
        stop.wait_for_start()
    if stop():
        return 0
    (options.folder / "began").touch()
    while not stop():
        if stop.signals > 1:
            (options.folder / "signalled").touch()
        time.sleep(0.01)
    return 0

parser = argparse.ArgumentParser()
parser.add_argument("--await-word", action="store_true")
parser.add_argument("--folder", type=pathlib.Path)
run_process(work, parser)
"""
_PATIENCE_SECONDS = 60.0


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Child]:
    (tmp_path / "waiting_robot.py").write_text(_ROBOT)
    monkeypatch.setenv("PYTHONPATH", ":".join([str(tmp_path), *sys.path]))
    child = Child("robot", "waiting_robot", ("--folder", str(tmp_path)), tmp_path / "log", waits=True)
    yield child
    child.end(1.0)


def wait_for(there: Callable[[], bool]) -> None:
    end = time.monotonic() + _PATIENCE_SECONDS
    while not there():
        assert time.monotonic() < end, "it did not come"
        time.sleep(0.01)


def is_ready(folder: Path, times: str) -> Callable[[], bool]:
    """Returns whether it has reported that it is ready; the file exists a moment before its contents."""
    return lambda: (folder / "ready").exists() and (folder / "ready").read_text() == times


def test_a_robot_that_has_begun_notices_a_further_signal(robot: Child, tmp_path: Path) -> None:
    robot.start()
    wait_for(is_ready(tmp_path, "once"))
    robot.begin()
    wait_for((tmp_path / "began").exists)
    assert not (tmp_path / "signalled").exists()
    robot.signal()
    wait_for((tmp_path / "signalled").exists)


def test_a_robot_does_nothing_before_it_is_asked_to_begin(robot: Child, tmp_path: Path) -> None:
    robot.start()
    wait_for(is_ready(tmp_path, "once"))
    time.sleep(0.3)
    assert not robot.has_begun
    assert not (tmp_path / "began").exists()
    robot.begin()
    assert robot.has_begun
    wait_for((tmp_path / "began").exists)


def test_a_restarted_robot_does_not_wait_once_the_first_had_begun(robot: Child, tmp_path: Path) -> None:
    robot.start()
    wait_for(is_ready(tmp_path, "once"))
    robot.kill()
    robot.begin()  # no process is running
    assert not (tmp_path / "began").exists()
    wait_for(robot.restart_if_due)
    wait_for((tmp_path / "began").exists)
    assert (tmp_path / "ready").read_text() == "onceagain"


def test_a_robot_asked_to_end_while_it_waits_ends_without_having_begun(robot: Child, tmp_path: Path) -> None:
    robot.start()
    wait_for(is_ready(tmp_path, "once"))
    robot.terminate()
    wait_for(lambda: robot.exit_code is not None)
    assert robot.exit_code == 0
    assert not (tmp_path / "began").exists()


def test_the_end_of_the_process_ends_the_waiting() -> None:
    stop = StopSignal()
    stop.set("the supervisor is gone")
    stop.wait_for_start()
    assert stop()
