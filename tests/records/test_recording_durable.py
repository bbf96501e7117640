"""Durability of recordings: the file name is on the disk at once, messages when they are acknowledged."""

import errno
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from safedpa.adaptation import AdaptationNode
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
    ServiceLoop,
    encode,
)
from safedpa.bus.messages.service_info import setup_message
from safedpa.dynamics import load_model
from safedpa.errors import RecordingError
from safedpa.records import McapRecorder, read_messages
from safedpa.records.readers.mcap import read_payloads
from safedpa_services.recorder import recorder as module
from safedpa_services.recorder.recorder import Recorder
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene

KEY = "safedpa/f/r1/state"


@pytest.fixture
def synced(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """What the disk was waited for: a folder with how many files there were in it, a file with its bytes."""
    found = list[tuple[str, int]]()
    original = os.fsync

    def fsync(descriptor: int) -> None:
        path = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
        found.append((path.name, len(list(path.iterdir())) if path.is_dir() else path.stat().st_size))
        original(descriptor)

    monkeypatch.setattr(os, "fsync", fsync)
    return found


def payload() -> bytes:
    return encode(CarRobot(Scene.random(1, "none")).state_message())


def failing(number: int) -> Callable[[int], None]:
    """An ``fsync`` that fails."""

    def fsync(_descriptor: int) -> None:
        raise OSError(number, os.strerror(number))

    return fsync


def test_the_name_is_on_the_disk_when_a_recording_begins(tmp_path: Path, synced: list[tuple[str, int]]) -> None:
    with McapRecorder(tmp_path / "drives" / "a.mcap"):
        assert synced == [("drives", 1)]


def test_what_is_acknowledged_is_on_the_disk_before(tmp_path: Path, synced: list[tuple[str, int]]) -> None:
    path = tmp_path / "a.mcap"
    recorder = McapRecorder(path)
    synced.clear()
    for moment, ends in enumerate((recorder.sync, recorder.sync, recorder.close)):
        recorder.write(KEY, payload(), moment, moment)
        assert (recorder.acknowledged, recorder.written) == (moment, moment + 1)
        ends()
        assert synced == [("a.mcap", path.stat().st_size)]
        assert recorder.acknowledged == len(list(read_payloads(path))) == moment + 1
        synced.clear()


@pytest.mark.parametrize("number", [errno.EIO, errno.ENOSPC])
def test_a_failing_disk_acknowledges_nothing_and_the_failure_is_repeated(number, tmp_path, monkeypatch):
    with McapRecorder(tmp_path / "a.mcap") as recorder:
        recorder.write(KEY, payload(), 0, 0)
        recorder.sync()
        recorder.write(KEY, payload(), 1, 1)
        with monkeypatch.context() as patch:
            patch.setattr(os, "fsync", failing(number))
            with pytest.raises(RecordingError, match=rf"stopped after \d+ bytes \({os.strerror(number)}\)"):
                recorder.sync()
        for again in (recorder.flush, recorder.sync, lambda: recorder.write(KEY, payload(), 2, 2)):
            with pytest.raises(RecordingError, match="the recording stopped after"):
                again()
        assert (recorder.written, recorder.acknowledged) == (2, 1)


@pytest.mark.parametrize("number", [errno.EINVAL, errno.EROFS, errno.ENOTSUP])
def test_a_device_that_cannot_be_synced_is_no_failure(number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A pipe, for example."""
    with McapRecorder(tmp_path / "a.mcap") as recorder:
        recorder.write(KEY, payload(), 0, 0)
        monkeypatch.setattr(os, "fsync", failing(number))
        recorder.sync()
        assert recorder.acknowledged == 1


def test_what_is_older_than_half_a_second_has_reached_the_file(tmp_path: Path) -> None:
    path, reached = tmp_path / "a.mcap", []
    with McapRecorder(path) as recorder:
        for tenth in range(13):
            recorder.write(KEY, payload(), tenth * 100_000_000, 0)
            reached.append(len(list(read_payloads(path))))
    assert reached == [0] * 5 + [6] * 5 + [11] * 3


def test_what_a_recorder_received_is_acknowledged_after_half_a_second(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A drive of four seconds with 20 messages in each, by a clock that goes on while the recorder sleeps."""
    clock, broker, sent, waiting = [100.0], MemoryBroker(), [0], list[int]()
    ears, robot = Bus(MemoryTransport(broker), "f"), Bus(MemoryTransport(broker), "f")
    recorder = Recorder(ears, tmp_path / "a.mcap", setup_message("recorder", {}))
    state = CarRobot(Scene.random(1, "none")).state_message()

    def sleep(seconds: float) -> None:
        clock[0] += seconds
        while sent[0] < 20.0 * (clock[0] - 100.0) - 1e-6:
            robot.publish(STATE, "r1", state)
            sent[0] += 1

    def stopped() -> bool:
        waiting.append(sent[0] - recorder.acknowledged)
        return clock[0] > 104.0

    monkeypatch.setattr(
        module, "time", SimpleNamespace(monotonic=lambda: clock[0], sleep=sleep, time_ns=time.time_ns, time=time.time)
    )
    assert recorder.run(stopped) == 0
    assert sent[0] > 80
    assert max(waiting) <= 13, "half a second's, one turn's more, and the recorder's own words"


def test_a_recorder_repeats_its_setup_every_five_seconds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """For those who join late."""
    clock, bus = [100.0], Bus(MemoryTransport(MemoryBroker()), "f")
    late = bus.inbox((SETUP,), keep_all=True)
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    recorder = Recorder(bus, tmp_path / "a.mcap", setup_message("recorder", {}))
    late.take(0.0)
    for _ in range(41):
        recorder.sync()
        clock[0] += 0.5
    assert 3 <= len(late.take(0.0)) <= 5
    assert recorder.run(lambda: True) == 0


@pytest.mark.parametrize(
    ("number", "waits"), [(errno.ENOSPC, True), (errno.EDQUOT, True), (errno.EIO, False), (errno.EBADF, False)]
)
def test_a_recorder_waits_for_room_on_a_full_disk_and_reports_a_broken_one(number, waits, tmp_path, monkeypatch):
    clock, room, broker = [100.0], [0], MemoryBroker()
    ears, robot = Bus(MemoryTransport(broker), "f"), Bus(MemoryTransport(broker), "f")
    health = ears.inbox((HEALTH,), keep_all=True)
    recorder = Recorder(ears, tmp_path / "a.mcap", setup_message("recorder", {}))
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=room[0]))

    def reported() -> Any:
        return [item.message for item in health.take(0.0) if isinstance(item, ReceivedMessage)][-1]

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", failing(number))
        robot.publish(STATE, "r1", CarRobot(Scene.random(1, "none")).state_message())
        recorder.turn(0.0)
        recorder.sync()
    assert reported().state == "failing"
    for free, state in ((2**20, "failing"), (2**40, "running" if waits else "failing")):
        room[0] = free
        clock[0] += 10.0
        recorder.sync()
        now = reported()
        assert (now.state, now.free_bytes) == (state, free), "within ten seconds of there being room"
        assert ("resumes when" in now.detail) is (waits and state == "failing")
    assert (tmp_path / "a-2.mcap").exists() is waits
    recorder.run(lambda: True)  # closes what is open


@pytest.mark.parametrize(
    ("heartbeats", "setups", "missing"),
    [
        (("policy", "safety_filter"), ("policy", "safety_filter"), ()),
        (("policy", "safety_filter"), ("safety_filter",), ("policy",)),
        (("adaptation", "perception", "policy"), (), ("adaptation", "perception", "policy")),
        (("dashboard", "robot"), (), ()),
    ],
)
def test_the_last_health_message_names_the_services_whose_setup_was_not_recorded(heartbeats, setups, missing, tmp_path):
    broker = MemoryBroker()
    fleet, services = Bus(MemoryTransport(broker), "f"), Bus(MemoryTransport(broker), "f")
    health = services.inbox((HEALTH,), keep_all=True)
    recorder = Recorder(fleet, tmp_path / "a.mcap", setup_message("recorder", {}))
    for name in heartbeats:
        beat = HealthMessage(
            epoch=0, tick=0, robot_time=0.0, publish_time=0.0, service=name, pid=1, state="running", detail="", steps=1
        )
        services.publish(HEALTH, NO_ROBOT, beat, name)
    for name in setups:
        services.publish(SETUP, NO_ROBOT, setup_message(name, {}), name)
    health.take(0.0)
    assert recorder.run(lambda: True) == bool(missing)
    last = [item.message for item in health.take(0.0) if isinstance(item, ReceivedMessage)][-1]
    assert isinstance(last, HealthMessage)
    assert last.state == ("failing" if missing else "running")
    assert ", ".join(missing) in last.detail
    assert bool(last.detail) is bool(missing)


def test_a_recorder_that_joins_after_a_service_records_its_setup_at_the_latest_when_the_service_ends(tmp_path: Path):
    broker = MemoryBroker()
    service, fleet = Bus(MemoryTransport(broker), "f"), Bus(MemoryTransport(broker), "f")
    model = load_model("car")
    loop = ServiceLoop(AdaptationNode(model), service, setup=setup_message("adaptation", {}))
    loop.turn(0.0)
    recorder = Recorder(fleet, tmp_path / "a.mcap", setup_message("recorder", {}))
    loop.run(lambda: True)
    assert recorder.run(lambda: True) == 0
    recorded = [key.rsplit("/", 1)[1] for key, _, _ in read_messages(tmp_path / "a.mcap", topics=(SETUP,))]
    assert "adaptation" in recorded
