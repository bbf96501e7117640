"""A robot makes itself ready beside its services, and does nothing before it is told to begin."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from safedpa.bus.loop.process import Stop
from safedpa_services.supervisor.child import Child
from safedpa_services.supervisor.supervisor import Supervisor

_ROBOT = """
import argparse, pathlib, time
from safedpa.bus.loop.process import run_process

def work(options, stop):
    ready = options.folder / "ready"
    ready.write_text(ready.read_text() + "again" if ready.exists() else "once")
    if options.await_word:
        stop.await_word()
    if stop():
        return 0
    (options.folder / "began").touch()
    while not stop():
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
    """Whether it has written so: the file is there a moment before its words are."""
    return lambda: (folder / "ready").exists() and (folder / "ready").read_text() == times


def test_it_does_nothing_before_it_is_told_to_begin(robot: Child, tmp_path: Path) -> None:
    robot.start()
    wait_for(is_ready(tmp_path, "once"))
    time.sleep(0.3)
    assert not robot.begun
    assert not (tmp_path / "began").exists()
    robot.begin()
    assert robot.begun
    wait_for((tmp_path / "began").exists)


def test_once_begun_whatever_takes_its_place_does_not_wait(robot: Child, tmp_path: Path) -> None:
    robot.start()
    wait_for(is_ready(tmp_path, "once"))
    robot.kill()
    robot.begin()  # nobody hears the word
    assert not (tmp_path / "began").exists()
    wait_for(robot.restart_if_due)
    wait_for((tmp_path / "began").exists)
    assert (tmp_path / "ready").read_text() == "onceagain"


def test_who_is_asked_to_end_while_it_waits_ends_without_having_begun(robot: Child, tmp_path: Path) -> None:
    robot.start()
    wait_for(is_ready(tmp_path, "once"))
    robot.terminate()
    wait_for(lambda: robot.exit_code is not None)
    assert robot.exit_code == 0
    assert not (tmp_path / "began").exists()


def test_the_end_of_the_process_is_a_word_too() -> None:
    stop = Stop()
    stop.set("the supervisor is gone")
    stop.await_word()
    assert stop()


class Named:
    """A process of which only what happens to it is kept."""

    essential, waits, exit_code, pid, restarts = True, False, None, 0, 0

    def __init__(self, name: str, said: list[str], *, waits: bool = False) -> None:
        self.name, self._said, self.waits, self.begun = name, said, waits, False

    def start(self) -> None:
        self.pid = 1
        self._said.append(f"{self.name} starts")

    def begin(self) -> None:
        self.begun = True
        self._said.append(f"{self.name} begins")

    def terminate(self) -> None:
        return

    def end(self, patience: float) -> None:
        del patience


class Slow:
    """A watch that hears of a service in the third turn."""

    def __init__(self, said: list[str]) -> None:
        self.health: dict[str, Any] = {}
        self._said, self._turns = said, 0

    def listen(self, wait: float) -> None:
        del wait
        self._turns += 1
        if self._turns == 3:
            self._said.append("filter heard")
            self.health["filter"] = None

    def has_hung(self, *arguments: object) -> bool:
        return False

    def stop_robot(self) -> bool:
        return False


@pytest.mark.parametrize("waits", [True, False])
def test_no_robot_begins_before_every_service_was_heard(waits: bool) -> None:
    said: list[str] = []
    service: Any = Named("filter", said)
    robots: list[Any] = [Named(name, said, waits=waits) for name in ("r1", "r2")]
    watch: Any = Slow(said)
    turns = iter([False] * 8 + [True] * 20)
    Supervisor([service], robots[0], watch, lambda: next(turns), lambda: None, others=[(robots[1], watch)]).run()
    early = ["r1 starts", "r2 starts"] if waits else []
    assert said == [*early, "filter starts", "filter heard", "r1 begins", "r2 begins"]
