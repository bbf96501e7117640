"""Ending a loop brakes the robot first; an order to stop holds over the filter's death. With real processes."""

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

from safedpa.bus import STATE, VERDICT, Bus, StateMessage, VerdictMessage, ZenohSettings, ZenohTransport
from safedpa.records import read_messages

pytestmark = [pytest.mark.processes, pytest.mark.slow]

_LONG = 120.0


class Loop:
    """A running ``safedpa up``, and what it says on the bus."""

    def __init__(self, process: subprocess.Popen[str], folder: Path, endpoint: str) -> None:
        self.process, self.folder, self.endpoint = process, folder, endpoint
        self.bus = Bus(ZenohTransport(ZenohSettings("client", connect=(endpoint,))), "fleet")
        self._inbox = self.bus.inbox((STATE, VERDICT), keep_all=True)
        self.states: list[StateMessage] = []
        self.verdicts: list[VerdictMessage] = []

    def until(self, done: Callable[[], bool], what: str) -> None:
        end = time.monotonic() + _LONG
        while not done():
            assert time.monotonic() < end, what
            for item in self._inbox.take(0.1):
                message = getattr(item, "message", None)
                self.states += [message] if isinstance(message, StateMessage) else []
                self.verdicts += [message] if isinstance(message, VerdictMessage) else []

    def drives(self) -> bool:
        return bool(self.states) and abs(self.states[-1].values[-1]) > 0.5 and self.status() in ("passed", "corrected")

    def is_stationary(self) -> bool:
        return bool(self.states) and abs(self.states[-1].values[-1]) < 0.03

    def status(self) -> str:
        return self.verdicts[-1].status if self.verdicts else ""

    def pid(self, service: str) -> int:
        found = subprocess.run(
            ["pgrep", "-f", f"safedpa_services.{service} .*{self.endpoint}"],
            capture_output=True,
            text=True,
            check=False,
        )
        return int((found.stdout.split() or ["0"])[0])

    def command(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "safedpa_services", *arguments, "--connect", self.endpoint]
        return subprocess.run(command, capture_output=True, text=True, timeout=_LONG, check=False)

    def end(self, number: int) -> tuple[int, str, str]:
        self.process.send_signal(number)
        output, errors = self.process.communicate(timeout=_LONG)
        return self.process.returncode, output, errors

    def recorded(self) -> list[Any]:
        (path,) = self.folder.glob("*/recording.mcap")
        return [message for _, _, message in read_messages(path)]


@contextmanager
def running(folder: Path, port: int, *options: str) -> Iterator[Loop]:
    endpoint = f"tcp/127.0.0.1:{port}"
    command = [sys.executable, "-m", "safedpa_services", "up", "--headless", "--no-diagnosis", "--json"]
    command += ["--out", str(folder), "--listen", endpoint, "--seed", "1", *options]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        end = time.monotonic() + _LONG
        while not list(folder.glob("*/robot.log")):
            assert process.poll() is None, process.communicate()[1]
            assert time.monotonic() < end, "the robot was never started"
            time.sleep(0.1)
        loop = Loop(process, folder, endpoint)
        yield loop
        loop.bus.close()
    finally:
        process.kill()
        process.communicate()


def left(endpoint: str) -> str:
    found = subprocess.run(
        ["pgrep", "-fa", f"supervised.*{endpoint}|{endpoint}.*supervised"], capture_output=True, text=True, check=False
    )
    return found.stdout


@pytest.mark.long
def test_an_order_holds_over_the_filters_death_and_the_filters_end_brakes(tmp_path: Path, free_port: int) -> None:
    with running(tmp_path, free_port, "--load", "box") as loop:
        loop.until(loop.drives, "it never drove")
        everybody_is_reported(loop)
        ordered = loop.command("stop", "--robot", "r1", "--who", "Ada")
        assert ordered.returncode == 0, ordered.stderr
        assert "r1: is stationary" in ordered.stdout
        loop.until(lambda: loop.is_stationary() and "ordered by Ada" in loop.verdicts[-1].sentence, "it does not stand")
        killed = loop.pid("safety_filter")
        os.kill(killed, signal.SIGKILL)
        seen = len(loop.verdicts)
        loop.until(lambda: loop.pid("safety_filter") not in (0, killed), "no filter was started again")
        loop.until(lambda: len(loop.verdicts) > seen + 10, "the new filter says nothing")
        assert {verdict.status for verdict in loop.verdicts[-10:]} == {"stopped"}
        assert loop.is_stationary()
        refused = loop.command("go")
        assert refused.returncode == 2
        assert "the whole fleet is not stopped by an order; still stopped: r1" in refused.stderr
        assert loop.command("go", "--robot", "r1").returncode == 0
        loop.until(loop.drives, "it does not drive again")

        filter_pid = loop.pid("safety_filter")
        os.kill(filter_pid, signal.SIGTERM)
        loop.until(lambda: loop.status() == "stopped", "the filter that ends does not brake")
        assert "about to end" in loop.verdicts[-1].sentence
        loop.until(loop.is_stationary, "it does not stand")
        loop.until(loop.drives, "after the filter's restart it does not drive")
        assert loop.pid("safety_filter") != filter_pid
        code, output, errors = loop.end(signal.SIGINT)
    assert code == 0, errors
    assert json.loads(output)["collisions"] == 0
    ends_standing_and_heard(loop)


def everybody_is_reported(loop: Loop) -> None:
    """In the end: on a busy machine not everybody is heard within two seconds."""
    end, services = time.monotonic() + _LONG, set[str]()
    while not services >= {"policy", "safety_filter", "recorder"}:
        assert time.monotonic() < end, services
        reported = loop.command("status", "--json", "--seconds", "2")
        status = json.loads(reported.stdout)
        assert reported.returncode == (0 if status["healthy"] else 1)
        services = {service["service"] for service in status["services"]}
    assert [robot["robot"] for robot in status["robots"]] == ["r1"]


def ends_standing_and_heard(loop: Loop) -> None:
    """The recording's end: stopped verdicts, a robot that stands, and the recorder there after everybody else."""
    messages = loop.recorded()
    verdicts = [message for message in messages if isinstance(message, VerdictMessage)]
    states = [message for message in messages if isinstance(message, StateMessage)]
    assert verdicts[-1].status == "stopped"
    assert "about to end" in verdicts[-1].sentence
    assert abs(states[-1].values[3]) < 0.03
    begun = next(verdict for verdict in reversed(verdicts) if verdict.status != "stopped")
    braking = [state.applied_by for state in states if (state.epoch, state.tick) > (begun.epoch, begun.tick + 1)]
    assert braking.count("filter") > 0.5 * len(braking), "the filter braked, not the robot's watchdog"
    assert left(loop.endpoint) == ""


@pytest.mark.long
def test_in_lockstep_the_robot_stands_first_too(tmp_path: Path, free_port: int) -> None:
    with running(tmp_path, free_port, "--lockstep") as loop:
        loop.until(loop.drives, "it never drove")
        code, output, errors = loop.end(signal.SIGTERM)
    assert code == 0, errors
    assert json.loads(output)["verdicts"]["stopped"] > 3
    ends_standing_and_heard(loop)


@pytest.mark.long
def test_a_pendulum_is_kept_in_its_corridor_until_its_process_ends(tmp_path: Path, free_port: int) -> None:
    with running(tmp_path, free_port, "--robot", "pendulum", "--wind", "2") as loop:
        loop.until(lambda: len(loop.states) > 50, "it says nothing")
        code, output, errors = loop.end(signal.SIGINT)
    assert code == 0, errors
    assert json.loads(output)["verdicts"]["stopped"] >= 1
    assert [message for message in loop.recorded() if isinstance(message, VerdictMessage)][-1].status == "stopped"


@pytest.mark.long
def test_a_second_signal_ends_everything_at_once(tmp_path: Path, free_port: int) -> None:
    started = time.monotonic()
    with running(tmp_path, free_port) as loop:
        loop.until(loop.drives, "it never drove")
        begun = time.monotonic()
        loop.process.send_signal(signal.SIGINT)
        loop.until(lambda: loop.status() == "stopped", "the first signal brakes nothing")  # two at once may be one
        code, output, errors = loop.end(signal.SIGINT)
        took = time.monotonic() - begun
    assert code == 130
    assert output == ""
    assert "ended immediately by the second signal" in errors
    assert took < 15.0 + (begun - started), "no part had its time to end in order"
    assert left(loop.endpoint) == ""
