"""What is said to be on the disk is: the file's name at once, its messages when they are acknowledged."""

import errno
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from safedpa.bus import HEALTH, SETUP, STATE, Bus, MemoryBroker, MemoryTransport, ReceivedMessage, encode
from safedpa.bus.messages.service_info import setup_message
from safedpa.errors import RecordingError
from safedpa.records import McapRecorder
from safedpa.records.readers.mcap import read_payloads
from safedpa_services.recorder import recorder as module
from safedpa_services.recorder.recorder import Recorder
from safedpa_sim.robots.core import CarRobot
from safedpa_sim.robots.scene import Scene

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
def test_a_failing_disk_acknowledges_nothing_and_the_failure_is_repeated(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
def test_a_device_that_cannot_be_synced_is_no_failure(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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


def test_what_a_recorder_received_is_acknowledged_after_half_a_second(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
def test_a_recorder_waits_for_room_on_a_full_disk_and_reports_a_broken_one(
    number: int, waits: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
        assert ("goes on when" in now.detail) is (waits and state == "failing")
    assert (tmp_path / "a-2.mcap").exists() is waits
    recorder.run(lambda: True)  # closes what is open
