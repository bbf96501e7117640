"""Recordings of the bus: round trip, several robots, kill, full disk, damage."""

import re
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from safedpa.bus.messages.codec import encode
from safedpa.bus.messages.messages import StateMessage, VerdictMessage
from safedpa.bus.messages.topics import STATE, VERDICT, key_of
from safedpa.errors import ColumnMapError, InputError, RecordingError, RunError
from safedpa.records import Finding, McapRecorder, load_run, read_messages, read_run_from_mcap, write_csv, write_parquet
from safedpa.records.column_map.column_map import native_map
from safedpa.robots.car.system import CAR
from safedpa.robots.pendulum.system import PENDULUM

PERIOD = 0.05
ZSTANDARD = b"\x28\xb5\x2f\xfd"
"""Begin of a compressed chunk."""


def state(tick: int, epoch: int = 7) -> StateMessage:
    t = tick * PERIOD
    return StateMessage(
        epoch=epoch,
        tick=tick,
        robot_time=t,
        publish_time=1000.0 + t,
        values=(0.5 * np.sin(t), 0.5 * np.cos(t), -t, 0.5),
        applied=() if tick < 0 else (0.5 + 0.01 * tick, 0.1 - 0.001 * tick),
        applied_by="none" if tick == 0 else "filter",
        period=PERIOD,
        lockstep=False,
        goal=(1.0, 1.0),
        obstacles=(),
        field=(-4.0, 4.0, -4.0, 4.0),
        footprint=(0.1, 0.4, 0.12),
    )


def verdict(tick: int, epoch: int = 7) -> VerdictMessage:
    return VerdictMessage(
        epoch=epoch,
        tick=tick,
        robot_time=tick * PERIOD,
        publish_time=1000.0,
        status="passed",
        sentence="the nominal action is safe",
        action=(0.5, 0.1),
        nominal=(0.5, 0.1),
        slack=0.0,
        active=(),
        h_now=1.0,
        h_next=0.9,
        margin=0.05,
        solver="solved",
        microseconds=50.0,
    )


def record(path: Path, ticks: range, robot: str = "car1", epoch: int = 7) -> None:
    with McapRecorder(path) as recorder:
        for tick in ticks:
            now = int(1e9 * (1000 + tick * PERIOD))
            recorder.write(key_of("fleet", robot, STATE), encode(state(tick, epoch)), now, now)
            recorder.write(key_of("fleet", robot, VERDICT), encode(verdict(tick, epoch)), now, now)


def test_messages_come_back_equal_and_in_order(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    record(path, range(100))
    findings: list[Finding] = []
    read = list(read_messages(path, findings))
    assert findings == []
    assert [key for key, _, _ in read[:2]] == ["safedpa/fleet/car1/state", "safedpa/fleet/car1/verdict"]
    assert [message for _, _, message in read] == [m for k in range(100) for m in (state(k), verdict(k))]
    assert read[2][1] == int(1e9 * (1000 + PERIOD))


def test_the_action_of_a_row_is_what_the_robot_reports_one_tick_later(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    record(path, range(50))
    run = read_run_from_mcap(path, CAR)
    assert len(run.t) == 49
    np.testing.assert_array_equal(run.states, [state(k).values for k in range(49)])
    np.testing.assert_array_equal(run.actions, [state(k + 1).applied for k in range(49)])
    np.testing.assert_array_equal(run.t, [k * PERIOD for k in range(49)])
    assert run.period == pytest.approx(PERIOD)


def test_before_its_first_action_a_robot_may_report_none(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    key = key_of("fleet", "car1", STATE)
    with McapRecorder(path) as recorder:
        for tick in range(20):
            message = state(tick) if tick else replace(state(0), applied=())
            recorder.write(key, encode(message), tick, tick)
    run = read_run_from_mcap(path, CAR)
    np.testing.assert_array_equal(run.actions, [state(k + 1).applied for k in range(19)])


def test_a_robot_without_any_action_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    with McapRecorder(path) as recorder:
        for tick in range(20):
            recorder.write(key_of("fleet", "car1", STATE), encode(replace(state(tick), applied=())), tick, tick)
    with pytest.raises(RunError, match=r"robot 'car1': got 0 actions, wanted 2"):
        read_run_from_mcap(path, CAR)


def test_a_restarted_robot_begins_a_new_stretch(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    key = key_of("fleet", "car1", STATE)
    with McapRecorder(path) as recorder:
        for epoch, ticks in ((9, 30), (4, 20)):
            for tick in range(ticks):
                recorder.write(key, encode(state(tick, epoch)), tick, tick)
    run = read_run_from_mcap(path, CAR)
    assert [len(part) for part in run.stretches] == [29, 19]
    assert [finding.kind for finding in run.findings] == ["clock_reset"]
    np.testing.assert_array_equal(run.t[29:], [k * PERIOD for k in range(19)])


def test_repeated_ticks_count_once_and_a_missing_tick_cuts(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    key = key_of("fleet", "car1", STATE)
    with McapRecorder(path) as recorder:
        for tick in [*range(20), 19, 19, *range(20, 40), *range(43, 60)]:
            recorder.write(key, encode(state(tick)), tick, tick)
    run = read_run_from_mcap(path, CAR)
    assert [len(part) for part in run.stretches] == [39, 16]
    assert [finding.kind for finding in run.findings] == ["gap"]


def test_of_several_robots_one_must_be_named(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    with McapRecorder(path) as recorder:
        for tick in range(10):
            for robot in ("beta", "alpha"):
                recorder.write(key_of("fleet", robot, STATE), encode(state(tick)), tick, tick)
    with pytest.raises(RunError, match=r"holds 2 robots: alpha, beta; name one"):
        read_run_from_mcap(path, CAR)
    with pytest.raises(RunError, match=r"robot 'alpa': did you mean 'alpha'"):
        read_run_from_mcap(path, CAR, "alpa")
    assert len(read_run_from_mcap(path, CAR, "alpha").t) == 9
    with pytest.raises(RunError, match=r"got 4 states, wanted 2 \(angle, rate\)"):
        read_run_from_mcap(path, PENDULUM, "alpha")


@pytest.mark.parametrize("part", ["values", "applied"])
def test_a_robot_whose_number_of_states_or_actions_changes_is_refused(part: str, tmp_path: Path) -> None:
    with McapRecorder(tmp_path / "a.mcap") as recorder:
        for tick in range(10):
            one = state(tick)
            changed = replace(one, **{part: getattr(one, part)[:-1]}) if tick == 5 else one
            recorder.write(key_of("fleet", "car1", STATE), encode(changed), tick, tick)
    with pytest.raises(RunError, match="robot 'car1': the number of its states or actions changes; record each robot"):
        read_run_from_mcap(tmp_path / "a.mcap", CAR)


def test_a_recording_of_the_bus_is_read_without_a_column_map(tmp_path: Path) -> None:
    record(tmp_path / "a.mcap", range(40))
    with pytest.raises(ColumnMapError, match=r"a.mcap is a recording of the bus; leave the column map out"):
        load_run(tmp_path / "a.mcap", CAR, native_map(CAR))


def test_all_three_formats_give_the_same_run(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    record(path, range(200))
    run = load_run(path, CAR)
    write_csv(run, tmp_path / "drive.csv")
    write_parquet(run, tmp_path / "drive.parquet")
    for other in (load_run(tmp_path / "drive.csv", CAR), load_run(tmp_path / "drive.parquet", CAR)):
        for name in ("t", "states", "actions"):
            np.testing.assert_array_equal(getattr(other, name), getattr(run, name))
        assert other.stretches == run.stretches


def test_an_existing_recording_is_never_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    record(path, range(10))
    before = path.read_bytes()
    with McapRecorder(path) as recorder:
        assert recorder.path == tmp_path / "drive-2.mcap"
    assert path.read_bytes() == before


def test_a_foreign_key_and_a_closed_recorder_are_refused(tmp_path: Path) -> None:
    recorder = McapRecorder(tmp_path / "drive.mcap")
    with pytest.raises(InputError, match="safedpa/FLEET/ROBOT/TOPIC"):
        recorder.write("other/key", b"", 0, 0)
    recorder.close()
    recorder.close()
    for late in (lambda: recorder.write("safedpa/fleet/car1/state", b"", 0, 0), recorder.flush, recorder.sync):
        with pytest.raises(RecordingError, match="the recording is closed; open a new one"):
            late()


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(RecordingError, match="cannot be written"):
        McapRecorder(tmp_path / "file" / "drive.mcap")


@pytest.mark.parametrize("share", [0.2, 0.5, 0.9, 0.999])
def test_a_file_that_was_cut_off_is_read_up_to_there(tmp_path: Path, share: float) -> None:
    path = tmp_path / "drive.mcap"
    record(path, range(400))
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    findings: list[Finding] = []
    ticks = [message.tick for _, _, message in read_messages(path, findings, (STATE,))]
    assert ticks == list(range(len(ticks)))
    assert len(ticks) > 400 * (share - 0.15)
    assert [finding.kind for finding in findings] == ["cut_off"]


def test_a_damaged_chunk_costs_that_chunk_alone(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    record(path, range(400))
    data = bytearray(path.read_bytes())
    chunks = [found.start() for found in re.finditer(re.escape(ZSTANDARD), data)]
    middle = chunks[len(chunks) // 2] + 16
    data[middle : middle + 64] = bytes(64)
    path.write_bytes(data)
    findings: list[Finding] = []
    ticks = [message.tick for _, _, message in read_messages(path, findings, (STATE,))]
    assert ticks == sorted(set(ticks))
    assert 400 - 2 * 400 / len(chunks) < len(ticks) < 400
    assert (ticks[0], ticks[-1]) == (0, 399)
    assert [finding.kind for finding in findings] == ["damaged"]


def test_messages_that_are_none_are_left_out_and_counted(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    with McapRecorder(path) as recorder:
        recorder.write("safedpa/fleet/car1/state", b"\xc1", 0, 0)
        recorder.write("safedpa/fleet/car1/state", encode(state(0)), 0, 0)
    findings: list[Finding] = []
    assert len(list(read_messages(path, findings))) == 1
    assert findings[0].kind == "unreadable_message"
    assert findings[0].count == 1


@pytest.mark.parametrize("content", [b"hello, this is text", b"\x89MC"])
def test_a_file_that_is_no_mcap_file_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "drive.mcap"
    path.write_bytes(content)
    with pytest.raises(RunError, match="is no MCAP file"):
        list(read_messages(path))


KILLED = """
import sys, time
sys.path.insert(0, {folder!r})
from test_mcap import *
recorder = McapRecorder({path!r})
key = key_of("fleet", "car1", STATE)
start = 1000.0
for tick in range(2000):
    recorder.write(key, encode(state(tick)), int(1e9 * (start + tick * PERIOD)), 0)
print("written", flush=True)
sys.stdin.read()
"""


def test_a_kill_loses_less_than_the_last_second(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    code = KILLED.format(folder=str(Path(__file__).parent), path=str(path))
    process = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdin is not None
    assert process.stdout is not None
    with process:
        assert process.stdout.readline() == b"written\n"
        process.send_signal(signal.SIGKILL)
        process.wait(120)
    ticks = [message.tick for _, _, message in read_messages(path)]
    assert ticks == list(range(len(ticks)))
    assert (2000 - len(ticks)) * PERIOD < 1.0


def test_a_full_device_is_reported_in_one_sentence() -> None:
    with pytest.raises(
        RecordingError, match=r"/dev/full: the recording stopped after 0 bytes \(No space left on device\)"
    ):
        record(Path("/dev/full"), range(10))


FULL = """
import resource, sys
sys.path.insert(0, {folder!r})
from test_mcap import *
resource.setrlimit(resource.RLIMIT_FSIZE, (40000, 40000))
recorder = McapRecorder({path!r})
key = key_of("fleet", "car1", STATE)
for tick in range(5000):
    try:
        recorder.write(key, encode(state(tick)), int(1e9 * tick * PERIOD), 0)
    except RecordingError as error:
        print(tick, error)
        break
for attempt in (lambda: recorder.write(key, b"", 0, 0), recorder.flush):
    try:
        attempt()
    except RecordingError as again:
        assert str(again) == str(error_text := str(again)) and "stopped" in error_text
    else:
        raise SystemExit("a full disk was forgotten")
recorder.close()
"""


def test_on_a_full_disk_what_was_written_stays_readable(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    code = FULL.format(folder=str(Path(__file__).parent), path=str(path))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    tick, _, sentence = done.stdout.strip().partition(" ")
    assert "the recording stopped after" in sentence
    assert "\n" not in sentence
    findings: list[Finding] = []
    ticks = [message.tick for _, _, message in read_messages(path, findings)]
    assert ticks == list(range(len(ticks)))
    assert len(ticks) > 100
    assert (int(tick) - len(ticks)) * PERIOD < 1.0
    assert [finding.kind for finding in findings] == ["cut_off"]
