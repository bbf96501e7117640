"""What the recorder acknowledged can be read, whatever happens to it afterwards."""

import dataclasses
import errno
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from safedpa.bus import (
    HEALTH,
    NO_ROBOT,
    SETUP,
    STATE,
    Bus,
    HealthMessage,
    MemoryBroker,
    MemoryTransport,
    ReceivedMessage,
)
from safedpa.bus.messages.service_info import setup_message
from safedpa.records import Finding, read_messages
from safedpa_services.recorder.recorder import Recorder

RECORDING = """
import itertools, sys, time
from pathlib import Path
from safedpa.bus import HEALTH, STATE, Bus, MemoryBroker, MemoryTransport
from safedpa.bus.messages.service_info import setup_message
from safedpa_services.recorder.recorder import Recorder
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene
import dataclasses, resource, signal

if {limit}:
    resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}))
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
broker = MemoryBroker()
bus, ears = Bus(MemoryTransport(broker), "f"), Bus(MemoryTransport(broker), "f")
heard = ears.inbox((HEALTH,), keep_all=True)
recorder = Recorder(bus, Path({path!r}), setup_message("recorder", {{}}))
state = CarRobot(Scene.random(1, "none"), wall_clock=lambda: 0.0).state_message()
for tick in itertools.count():
    ears.publish(STATE, "r1", dataclasses.replace(state, tick=tick))
    if tick % 7 == 0:
        recorder.turn(0.0)
    if tick % 53 == 0:
        recorder.sync()
        for item in heard.take(0.0):
            print(item.message.acknowledged, item.message.steps, item.message.state, flush=True)
    if tick > 3000:
        time.sleep(0.01)
"""


def acknowledged(path: Path, lines: int, fault: Any, limit: int = 0) -> tuple[int, set[str]]:
    """Runs a recorder until it reported its health ``lines`` times, then does ``fault``; the last count, and states."""
    code = RECORDING.format(path=str(path), limit=limit)
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    with process:
        reported = [process.stdout.readline() for _ in range(lines)]
        fault(process)
        reported += process.stdout.readlines()
    whole = [line.split() for line in reported if line.endswith("\n")]
    return max(int(line[0]) for line in whole), {line[2] for line in whole}


def retained(path: Path) -> tuple[int, list[int]]:
    """Messages in the file, and the ticks of the states among them."""
    findings: list[Finding] = []
    messages = [message for _, _, message in read_messages(path, findings)]
    assert {finding.kind for finding in findings} <= {"cut_off"}
    return len(messages), [message.tick for message in messages if hasattr(message, "values")]


def killed(process: subprocess.Popen[str]) -> None:
    process.send_signal(signal.SIGKILL)


def stopped_then_killed(process: subprocess.Popen[str]) -> None:
    process.send_signal(signal.SIGSTOP)
    os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WNOWAIT)
    process.send_signal(signal.SIGKILL)


@pytest.mark.long
@pytest.mark.parametrize("case", range(4))
def test_a_kill_at_any_moment_loses_nothing_that_was_acknowledged(tmp_path: Path, case: int) -> None:
    path = tmp_path / "drive.mcap"
    fault = stopped_then_killed if case == 3 else killed
    reported, _ = acknowledged(path, random.Random(case).randint(2, 40), fault)
    total, ticks = retained(path)
    assert reported > 0
    assert total >= reported
    assert ticks == list(range(len(ticks))), "everything up to there, in order, once"


def test_a_full_disk_loses_nothing_that_was_acknowledged(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    reported, states = acknowledged(path, 60, killed, limit=30_000)
    assert states == {"running", "failing"}
    total, ticks = retained(path)
    assert 0 < reported <= total
    assert ticks == list(range(len(ticks)))
    assert path.stat().st_size <= 30_000


class Fleet:
    """A recorder and a publisher, in one process."""

    def __init__(self, path: Path) -> None:
        broker = MemoryBroker()
        self.bus = Bus(MemoryTransport(broker), "f")
        self._health = self.bus.inbox((HEALTH,), keep_all=True)
        self.recorder = Recorder(Bus(MemoryTransport(broker), "f"), path, setup_message("recorder", {}))

    def send(self, message: Any) -> None:
        self.bus.publish(STATE, "r1", message)

    def health(self) -> HealthMessage:
        items = [item.message for item in self._health.take(0.0) if isinstance(item, ReceivedMessage)]
        message = items[-1]
        assert isinstance(message, HealthMessage)
        return message


@pytest.fixture
def state(fleet_of: Any) -> Any:
    return fleet_of().robot.state_message()


def test_the_recording_continues_in_another_file_once_there_is_room(tmp_path, state, monkeypatch):
    fleet, later = Fleet(tmp_path / "drive.mcap"), time.monotonic() + 10.0
    setup = setup_message("policy", {"model": "car"})
    fleet.bus.publish(SETUP, NO_ROBOT, setup, "policy")
    for tick in range(50):
        fleet.send(dataclasses.replace(state, tick=tick))
    fleet.recorder.turn(0.0)
    fleet.recorder.sync()
    before = fleet.health()
    assert before.acknowledged >= 51
    assert before.state == "running"

    def full(_descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        patch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=0))
        fleet.recorder.sync()
        for tick in range(50, 90):
            fleet.send(dataclasses.replace(state, tick=tick))
        fleet.recorder.turn(0.0)
        fleet.recorder.sync()
    during = fleet.health()
    assert during.state == "failing"
    assert "No space left" in during.detail
    assert during.acknowledged >= before.acknowledged

    monkeypatch.setattr(time, "monotonic", lambda: later)
    fleet.recorder.sync()
    for tick in range(90, 120):
        fleet.send(dataclasses.replace(state, tick=tick))
    assert fleet.recorder.run(lambda: True) == 1, "something was lost on the way"
    after = fleet.health()
    assert after.state == "failing"
    lost, _, phrase = after.detail.partition(" ")
    assert 40 <= int(lost) <= 50, "those in between, and the recorder's own"
    assert phrase.startswith("messages lost")
    assert "drive-2.mcap" in after.detail

    (_, first), (_, second) = retained(tmp_path / "drive.mcap"), retained(tmp_path / "drive-2.mcap")
    assert first[:50] == list(range(50))
    assert second == list(range(90, 120))
    keys = [key for key, _, _ in read_messages(tmp_path / "drive-2.mcap")]
    assert keys[0].endswith("setup/policy"), "a file can be replayed by itself"


def test_a_repeated_setup_is_recorded_once(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path / "drive.mcap")
    setup = setup_message("policy", {"model": "car"})
    for _ in range(4):
        fleet.bus.publish(SETUP, NO_ROBOT, setup, "policy")
    fleet.recorder.run(lambda: True)
    keys = [key for key, _, _ in read_messages(tmp_path / "drive.mcap")]
    assert keys.count("safedpa/f/-/setup/policy") == 1
