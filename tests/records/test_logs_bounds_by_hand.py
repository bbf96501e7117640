"""Maps that do not fit, damaged flight logs, packed bags, recordings: what is refused, and what just passes."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from tests.records.test_flight_logs_by_hand import STAMPS, described, flight_log, logged, message, subscribed
from tests.records.test_mcap import record, state

from safedpa.bus.wire.codec import encode
from safedpa.bus.wire.topics import STATE, key_of
from safedpa.errors import ColumnMapError, InputError, RecordingError, RunError
from safedpa.limits import LimitError
from safedpa.records import McapRecorder, load_run, read_run_from_mcap
from safedpa.records.apply_map import check_map
from safedpa.records.bags import topic_log
from safedpa.records.bags.folder_bag import FolderBag, _unpacked
from safedpa.records.column_map import ColumnMap, DerivedColumn, SourceColumn, TrackedPoint, native_map
from safedpa.records.mcap_records import records_of
from safedpa.records.write import export_recording
from safedpa.robots.car.system import CAR
from safedpa.robots.pendulum.system import PENDULUM


def with_columns(found: ColumnMap, **columns: Any) -> ColumnMap:
    kept = {name: item for name, item in found.columns.items() if name not in columns}
    return replace(found, columns={**kept, **{name: item for name, item in columns.items() if item is not None}})


PENDULUM_MAP, CAR_MAP = native_map(PENDULUM), native_map(CAR)

MISFITS: Mapping[str, tuple[ColumnMap, Any, str]] = {
    "another robot": (CAR_MAP, PENDULUM, "robot: the map is for a car, the model for a pendulum"),
    "a column too many": (
        with_columns(PENDULUM_MAP, x=SourceColumn("x")),
        PENDULUM,
        "columns.x: the model has no 'x'; ",
    ),
    "no time": (with_columns(PENDULUM_MAP, t=None), PENDULUM, "columns.t: missing; the pendulum needs t, "),
    "no rate": (with_columns(PENDULUM_MAP, rate=None), PENDULUM, "columns.rate: missing; the pendulum needs t, "),
    "a point of a pendulum": (
        replace(PENDULUM_MAP, tracked_point=TrackedPoint(ahead=0.1)),
        PENDULUM,
        "tracked_point: a pendulum has no x, y and yaw; remove the table",
    ),
    "a slope of itself": (
        with_columns(PENDULUM_MAP, rate=DerivedColumn("slope", 0.1, "rate")),
        PENDULUM,
        "columns.rate.derive: wanted for a state, of another state",
    ),
    "a slope for an action": (
        with_columns(PENDULUM_MAP, torque=DerivedColumn("slope", 0.1, "angle")),
        PENDULUM,
        "columns.torque.derive: wanted for a state, of another state",
    ),
    "a slope of an action": (
        with_columns(PENDULUM_MAP, rate=DerivedColumn("slope", 0.1, "torque")),
        PENDULUM,
        "columns.rate.of: got 'torque'; ",
    ),
    "a unit of something else": (
        with_columns(PENDULUM_MAP, rate=SourceColumn("rate", unit="deg")),
        PENDULUM,
        "columns.rate.unit: got unit 'deg', wanted one for rad/s: ",
    ),
    "time in degrees": (
        with_columns(PENDULUM_MAP, t=SourceColumn("t", unit="deg")),
        PENDULUM,
        "columns.t.unit: got unit 'deg', wanted one for s: ",
    ),
}


@pytest.mark.parametrize("case", MISFITS)
def test_a_map_that_does_not_give_what_the_system_needs_is_refused(case: str) -> None:
    columns, system, said = MISFITS[case]
    with pytest.raises(ColumnMapError) as caught:
        check_map(columns, system)
    assert str(caught.value).startswith(f"{columns.name}: {said}")


@pytest.mark.parametrize(
    ("columns", "system"),
    [
        (PENDULUM_MAP, PENDULUM),
        (CAR_MAP, CAR),
        (replace(CAR_MAP, tracked_point=TrackedPoint(ahead=0.1)), CAR),
        (with_columns(PENDULUM_MAP, rate=DerivedColumn("slope", 0.1, "angle")), PENDULUM),
        (with_columns(PENDULUM_MAP, rate=DerivedColumn("rate_from_angle", 0.1)), PENDULUM),
        (with_columns(PENDULUM_MAP, rate=SourceColumn("rate", unit="deg/s")), PENDULUM),
        (with_columns(PENDULUM_MAP, t=SourceColumn("t", unit="ms")), PENDULUM),
    ],
)
def test_a_map_that_fits_is_taken(columns: ColumnMap, system: Any) -> None:
    check_map(columns, system)


ROWS = [logged(7, stamp, 0.0) for stamp in STAMPS]
HEAD = [described("speed"), subscribed("speed", 7)]


@pytest.mark.parametrize(
    ("messages", "said"),
    [
        pytest.param([], "the flight log holds no message; name another one", id="nothing"),
        pytest.param([described("speed")], "the flight log holds no message; name another one", id="only described"),
        pytest.param(HEAD, "the flight log holds no message; name another one", id="only subscribed"),
        pytest.param(
            [message("B", bytes(8) + b"\x02" + bytes(31)), *HEAD, *ROWS],
            "is a damaged PX4 flight log",
            id="of another format",
        ),
        pytest.param([message("Z", b"x"), *HEAD, *ROWS], "is a damaged PX4 flight log; fetch it", id="unknown first"),
        pytest.param([described("speed")[:-3]], "is a damaged PX4 flight log; fetch it", id="cut off in a description"),
    ],
)
def test_a_flight_log_without_messages_is_refused(messages: list[bytes], said: str, tmp_path: Path) -> None:
    with pytest.raises(RunError, match=said):
        topic_log(flight_log(tmp_path / "a.ulg", messages)).topics()


@pytest.mark.parametrize("more", [0, 1])
def test_ten_thousand_messages_of_unknown_kinds_are_passed_over_and_no_more(more: int, tmp_path: Path) -> None:
    from safedpa.records.bags.ulog_log import _subscribed

    path = flight_log(tmp_path / "a.ulg", [*HEAD, *[message("z", b"")] * (10_000 + more), *ROWS])
    if more:
        with pytest.raises(RunError, match="is a damaged PX4 flight log"):
            list(_subscribed(path))
    else:
        assert list(_subscribed(path)) == ["speed"]


@pytest.mark.parametrize("more", [0, 1])
def test_a_flight_log_has_so_many_bytes(more: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = flight_log(tmp_path / "a.ulg", [*HEAD, *ROWS])
    monkeypatch.setenv("SAFEDPA_LIMITS", f"table_bytes={path.stat().st_size - more}")
    if more:
        with pytest.raises(LimitError, match="table_bytes"):
            topic_log(path).topics()
    else:
        assert topic_log(path).topics()["speed"].count == 3


def test_a_field_or_a_topic_that_a_flight_log_has_not_is_told(tmp_path: Path) -> None:
    log = topic_log(flight_log(tmp_path / "a.ulg", [*HEAD, *ROWS]))
    assert log.series({"speed": ("x",)})["speed"].values["x"].tolist() == [0.0] * 3
    with pytest.raises(InputError, match="field 'y' of speed: "):
        log.series({"speed": ("x", "y")})
    with pytest.raises(RunError, match="sped"):
        log.series({"sped": ("x",)})


def test_messages_of_a_bag_are_unpacked_up_to_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SAFEDPA_LIMITS", "bag_message_bytes=2000")
    packed = [zstandard.ZstdCompressor().compress(b" " * size) for size in (2000, 2001)]
    assert _unpacked(packed[0]) == b" " * 2000
    with pytest.raises(LimitError, match=r"more than 2000, wanted at most 2000; .*bag_message_bytes"):
        _unpacked(packed[1])
    assert _unpacked(b"no zstd") == b""


METADATA = """rosbag2_bagfile_information:
  version: 5
  storage_identifier: sqlite3
  relative_file_paths:
    - a.db3
  compression_format: {form}
  compression_mode: {mode}
"""


@pytest.mark.parametrize(
    ("form", "mode", "said"),
    [
        ("lz4", "MESSAGE", "messages are packed by 'lz4'; wanted zstd; unpack with ros2 bag convert"),
        ("lz4", "message", "messages are packed by 'lz4'; wanted zstd"),
        ('""', "MESSAGE", "messages are packed by ''; wanted zstd"),
        ("zstd", "MESSAGE", ""),
        ("zstd", "message", ""),
        ("lz4", "FILE", ""),
        ('""', '""', ""),
    ],
)
def test_messages_of_a_folder_are_packed_by_zstd_or_not_at_all(form: str, mode: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "metadata.yaml").write_text(METADATA.format(form=form, mode=mode), encoding="utf-8")
    (tmp_path / "a.db3").write_bytes(b"SQLite format 3\0")
    if said:
        with pytest.raises(RunError, match=said):
            FolderBag(tmp_path)
    else:
        FolderBag(tmp_path)


def test_a_recording_of_the_bus_needs_no_map(tmp_path: Path) -> None:
    record(tmp_path / "a.mcap", range(40))
    assert len(load_run(tmp_path / "a.mcap", CAR).t)
    with pytest.raises(ColumnMapError, match=r"a.mcap is a recording of the bus; leave the column map out"):
        load_run(tmp_path / "a.mcap", CAR, CAR_MAP)


@pytest.mark.parametrize("part", ["values", "applied"])
def test_a_robot_whose_states_or_actions_change_their_number_is_refused(part: str, tmp_path: Path) -> None:
    with McapRecorder(tmp_path / "a.mcap") as recorder:
        for tick in range(10):
            one = state(tick)
            changed = replace(one, **{part: getattr(one, part)[:-1]}) if tick == 5 else one
            recorder.write(key_of("fleet", "car1", STATE), encode(changed), tick, tick)
    with pytest.raises(RunError, match="robot 'car1': the number of its states or actions changes; record each robot"):
        read_run_from_mcap(tmp_path / "a.mcap", CAR)


@pytest.mark.parametrize(
    ("ticks", "said"), [((0, 1), ""), ((0, 2, 4), "robot 'car1' has no two ticks in a row"), ((3,), "no two")]
)
def test_what_is_exported_has_two_ticks_in_a_row(ticks: tuple[int, ...], said: str, tmp_path: Path) -> None:
    with McapRecorder(tmp_path / "a.mcap") as recorder:
        for tick in ticks:
            recorder.write(key_of("fleet", "car1", STATE), encode(state(tick)), tick, tick)
    if said:
        with pytest.raises(RunError, match=said):
            export_recording(tmp_path / "a.mcap", tmp_path / "a.csv", "csv")
    else:
        assert export_recording(tmp_path / "a.mcap", tmp_path / "a.csv", "csv").rows == 1


def test_after_a_failure_a_recorder_says_it_again_and_once_closed_that_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = McapRecorder(tmp_path / "a.mcap")
    recorder.write(key_of("fleet", "car1", STATE), encode(state(0)), 0, 0)
    assert (recorder.written, recorder.acknowledged) == (1, 0)
    recorder.sync()
    assert (recorder.written, recorder.acknowledged) == (1, 1)

    def full(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device")

    recorder.write(key_of("fleet", "car1", STATE), encode(state(1)), 1, 1)
    with monkeypatch.context() as patch:
        patch.setattr(recorder._file, "sync", full)
        with pytest.raises(RecordingError, match=r"the recording stopped after \d+ bytes \(No space left on device\)"):
            recorder.sync()
    for again in (recorder.flush, recorder.sync):
        with pytest.raises(RecordingError, match="the recording stopped after"):
            again()
    assert (recorder.written, recorder.acknowledged) == (2, 1)
    recorder.close()  # does nothing
    with pytest.raises(RecordingError, match="the recording stopped after"):
        recorder.sync()
    closed = McapRecorder(tmp_path / "b.mcap")
    closed.write(key_of("fleet", "car1", STATE), encode(state(0)), 0, 0)
    closed.close()
    assert closed.acknowledged == 1
    with pytest.raises(RecordingError, match="the recording is closed; open a new one"):
        closed.flush()
    closed.close()


def test_what_is_written_half_a_second_apart_has_reached_the_file(tmp_path: Path) -> None:
    """By the times that are told with the messages: 0.5 s flushes, and a nanosecond less does not."""
    recorder = McapRecorder(tmp_path / "a.mcap")
    flushes: list[int] = []
    recorder.flush = lambda: flushes.append(recorder.written)  # type: ignore[method-assign]
    for at in (1_000_000_000, 1_499_999_999, 1_500_000_000, 1_999_999_999, 2_000_000_000, 1_000_000_000, 2_500_000_001):
        recorder.write(key_of("fleet", "car1", STATE), encode(state(0)), at, at)
    assert flushes == [3, 5, 7]
    recorder.close()


def mcap(folder: Path, *records: bytes) -> Path:
    path = folder / "a.mcap"
    path.write_bytes(b"\x89MCAP0\r\n" + b"".join(records))
    return path


def entry(opcode: int, content: bytes, length: int | None = None) -> bytes:
    return struct.pack("<BQ", opcode, len(content) if length is None else length) + content


FOOTER = entry(2, bytes(20))


@pytest.mark.parametrize("more", [0, 1])
def test_a_record_of_an_mcap_file_has_so_many_bytes(more: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from safedpa.records.mcap_records import DamageError

    monkeypatch.setenv("SAFEDPA_LIMITS", "mcap_record_bytes=1000")
    path = mcap(tmp_path, entry(0x0C, b" " * (1000 + more)), FOOTER)
    if more:
        with pytest.raises(DamageError):
            list(records_of(path, validate=False))
    else:
        assert list(records_of(path, validate=False)) == []


@pytest.mark.parametrize("opcode", [0, 0x0C, 0x80])
def test_a_record_of_no_kind_is_damage_and_one_of_another_program_is_passed_over(opcode: int, tmp_path: Path) -> None:
    from safedpa.records.mcap_records import DamageError

    path = mcap(tmp_path, entry(opcode, b" " * 40), FOOTER)
    if opcode == 0:
        with pytest.raises(DamageError):
            list(records_of(path, validate=False))
    else:
        assert list(records_of(path, validate=False)) == []


def chunk(inside: bytes) -> bytes:
    head = struct.pack("<QQQI", 0, 0, len(inside), 0) + struct.pack("<I", 0) + struct.pack("<Q", len(inside))
    return entry(6, head + inside)


MESSAGE = entry(5, struct.pack("<HIQQ", 1, 2, 3, 4) + b"data")


@pytest.mark.parametrize(
    ("inside", "read"),
    [
        pytest.param(MESSAGE, 1, id="a message"),
        pytest.param(MESSAGE + MESSAGE, 2, id="two"),
        pytest.param(MESSAGE + entry(5, b" " * 22), 2, id="an empty message"),
        pytest.param(MESSAGE + entry(5, b" " * 21), -1, id="a message without its head"),
        pytest.param(MESSAGE + entry(0, b""), -1, id="no kind"),
        pytest.param(MESSAGE + entry(5, struct.pack("<HIQQ", 1, 2, 3, 4), 23), -1, id="longer than its chunk"),
        pytest.param(MESSAGE + entry(0x0C, b"xyz"), 1, id="another kind"),
        pytest.param(MESSAGE + b"\x05\x00", -1, id="cut off in its head"),
    ],
)
def test_what_a_chunk_holds_ends_within_it(inside: bytes, read: int, tmp_path: Path) -> None:
    from safedpa.records.mcap_records import DamageError

    path = mcap(tmp_path, chunk(inside), FOOTER)
    if read < 0:
        with pytest.raises(DamageError):
            list(records_of(path))
    else:
        found = list(records_of(path, validate=False))
        assert len(found) == read
        assert (found[0].channel_id, found[0].sequence, found[0].log_time, found[0].publish_time) == (1, 2, 3, 4)
        assert found[0].data == b"data"


@pytest.mark.parametrize("limit", ["mcap_chunk_bytes=2000", "expansion=1,expansion_free_bytes=2000"])
@pytest.mark.parametrize("more", [0, 1])
def test_a_chunk_becomes_so_many_bytes(limit: str, more: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The file itself is shorter: its chunk is packed."""
    inside = entry(0x0C, b" " * (1991 + more))
    packed = zstandard.ZstdCompressor().compress(inside)
    head = struct.pack("<QQQI", 0, 0, len(inside), 0) + struct.pack("<I", 4) + b"zstd" + struct.pack("<Q", len(packed))
    path = mcap(tmp_path, entry(6, head + packed), FOOTER)
    monkeypatch.setenv("SAFEDPA_LIMITS", limit)
    assert len(inside) == 2000 + more
    if more:
        with pytest.raises(LimitError, match=limit.partition("_")[0].partition("=")[0]):
            list(records_of(path, validate=False))
    else:
        assert list(records_of(path, validate=False)) == []


def test_times_of_a_recording_are_those_of_the_robot(tmp_path: Path) -> None:
    record(tmp_path / "a.mcap", range(40))
    assert np.allclose(np.diff(load_run(tmp_path / "a.mcap", CAR).t), 0.05)


@pytest.mark.parametrize("start", [b"ULoG\x01\x12\x35", b"ULog\x01\x12\x36", b""])
def test_what_does_not_begin_as_a_flight_log_is_none(start: bytes, tmp_path: Path) -> None:
    from safedpa.records.bags.ulog_log import UlogLog

    path = tmp_path / "a.ulg"
    path.write_bytes(start + b"\x01" + bytes(8) + b"".join([*HEAD, *ROWS]))
    with pytest.raises(RunError, match=r"is no PX4 flight log; wanted a .ulg file"):
        UlogLog(path).topics()


def test_the_filter_s_package_gives_what_it_has_and_nothing_else() -> None:
    import safedpa.safety

    assert safedpa.safety.FilterSettings.__name__ == "FilterSettings"
    with pytest.raises(AttributeError, match=r"has no attribute 'FilterSetting'"):
        _ = safedpa.safety.FilterSetting  # type: ignore[attr-defined]
