"""Seconds of what is stale, late or stamped in a log, and how many records that nobody knows a file may have."""

from __future__ import annotations

import struct
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.errors import RunError
from safedpa.limits import LimitError, limit
from safedpa.records import mcap_records as module
from safedpa.records.bags.messages_log import _seconds
from safedpa.records.bags.ros1_bag import Ros1Bag, _DamageError, _fields
from safedpa.records.bags.series import Series, _clock_findings, _held

BILLION = 1_000_000_000


@pytest.mark.parametrize(("hold", "stale", "first"), [(0.5, [2, 3], 2.0), (1.5, [3], 3.0), (2.5, [], 0.0)])
def test_values_older_than_they_may_be_are_cut_and_the_first_of_them_is_told_in_seconds(
    hold: float, stale: list[int], first: float
) -> None:
    """Rows each second; the topic speaks at 0 and at 1 s, its later message first in the file."""
    rows = np.arange(4, dtype=np.int64) * BILLION
    taken, findings = _held("/odom:x", rows, np.array([BILLION, 0]), np.array([11.0, 10.0]), hold)
    assert np.flatnonzero(np.isnan(taken)).tolist() == stale
    assert taken[:2].tolist() == [10.0, 11.0]
    assert [(finding.count, finding.start_t) for finding in findings] == ([(len(stale), first)] if stale else [])


def test_before_the_first_message_nothing_is_held() -> None:
    rows = np.array([0, 5, 6], dtype=np.int64) * BILLION
    taken, (finding,) = _held("/odom:x", rows, np.array([5 * BILLION]), np.array([1.0]), 9.0)
    assert np.isnan(taken).tolist() == [True, False, False]
    assert (finding.count, finding.start_t) == (1, 0.0)


def series(late: float) -> Series:
    stamp = np.arange(5, dtype=np.int64) * BILLION
    return Series(stamp + round(late * BILLION), stamp, {})


@pytest.mark.parametrize(
    ("rows_late", "other_late", "outcome"),
    [
        (0.0, 0.0, "nothing"),
        (0.00005, 0.0, "nothing"),
        (0.0125, 0.0, "12.5 ms later"),
        (-0.0125, 0.0, "-12.5 ms later"),
        (0.3, -0.1, "300.0 ms later"),
        (0.6, 0.0, "two clocks"),
        (0.0, 0.6, "two clocks"),
        (0.0, -0.6, "two clocks"),
        (30.0, 30.0, "30000.0 ms later"),
    ],
)
def test_stamps_half_a_second_apart_are_two_clocks_and_a_lag_is_told_in_milliseconds(
    rows_late: float, other_late: float, outcome: str
) -> None:
    log: Any = SimpleNamespace(path=Path("drive.bag"))
    found = {"/odom": series(rows_late), "/drive": series(other_late)}
    times = {topic: one.stamp for topic, one in found.items() if one.stamp is not None}
    if outcome == "two clocks":
        with pytest.raises(RunError, match=r"0\.6 s apart: two clocks"):
            _clock_findings(log, found, times, "/odom")
        return
    told = [finding.message for finding in _clock_findings(log, found, times, "/odom")]
    assert [outcome in sentence for sentence in told] == ([] if outcome == "nothing" else [True])


def test_where_rows_count_by_their_receipt_no_stamp_is_asked() -> None:
    log: Any = SimpleNamespace(path=Path("drive.bag"))
    found = {"/odom": series(7.0), "/drive": series(0.0)}
    assert _clock_findings(log, found, {topic: one.receipt for topic, one in found.items()}, "/odom") == []


@pytest.mark.parametrize("seconds", [0, 1, 1_700_000_000])
def test_a_time_of_seconds_and_nanoseconds_is_counted_in_nanoseconds(seconds: int) -> None:
    bag = Ros1Bag.__new__(Ros1Bag)
    bag._names = {3: "/odom"}
    fields = {b"conn": struct.pack("<I", 3), b"time": struct.pack("<II", seconds, 7)}
    assert list(bag._message(fields, b"data", None)) == [("/odom", seconds * BILLION + 7, b"data")]
    assert list(bag._message(fields, b"data", ("/drive",))) == []
    assert list(bag._message(fields, b"data", ("/odom",))) != []
    assert _seconds(seconds * BILLION + 500_000_000) == seconds + 0.5


def entry(text: bytes, length: int | None = None) -> bytes:
    return struct.pack("<I", len(text) if length is None else length) + text


def test_a_header_is_names_and_values_and_whatever_else_is_damage() -> None:
    assert _fields(entry(b"op=\x02") + entry(b"topic=/a=b")) == {b"op": b"\x02", b"topic": b"/a=b"}
    assert _fields(b"") == {}
    for damaged in (entry(b"no equals sign"), entry(b""), entry(b"op=\x02", 9)):
        with pytest.raises(_DamageError):
            _fields(damaged)


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


@pytest.mark.parametrize(
    ("opcode", "length", "count", "read"),
    [
        (0x0A, 40, 3, True),  # an index: known, and passed over
        (0x0A, 40, 12, True),
        (0x80, 40, 3, True),  # anybody's own
        (0x80, 40, 12, False),
        (0x0A, 0, 3, True),  # too short to be anything
        (0x0A, 0, 12, False),
        (0x00, 40, 1, False),
    ],
)
def test_records_that_nobody_knows_are_passed_over_so_many_times(
    opcode: int, length: int, count: int, read: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nine bytes each may be a million of them in a small file."""
    monkeypatch.setattr(module, "_MOST_PASSED_OVER", 5)
    path = tmp_path / "drive.mcap"
    path.write_bytes(record(opcode, bytes(length)) * count + record(0x02, bytes(20)))
    with path.open("rb") as file:
        budget = module._Budget(path, path.stat().st_size)
        records = module._records_in(file, budget, validate=False)
        if read:
            assert list(records) == []
        else:
            with pytest.raises(ValueError, match="records that nobody knows"):
                list(records)


def test_chunks_become_so_many_bytes_each_and_so_many_together() -> None:
    largest, free = limit("mcap_chunk_bytes"), limit("expansion_free_bytes")
    budget = module._Budget(Path("drive.mcap"), 10)
    with pytest.raises(LimitError, match=f"{largest + 1} bytes"):
        budget.take(largest + 1)
    budget = module._Budget(Path("drive.mcap"), 10)
    for _ in range(free // largest):
        budget.take(largest)
    budget.take(free % largest)
    with pytest.raises(LimitError):
        budget.take(1)
    larger = module._Budget(Path("drive.mcap"), free)
    for _ in range(free // largest + 1):
        larger.take(largest)


def test_a_file_has_so_many_channels_and_no_more() -> None:
    budget, most = module._Budget(Path("drive.mcap"), 10), limit("mcap_channels")
    for _ in range(most):
        budget.one_more_channel()
    with pytest.raises(LimitError, match=str(most + 1)):
        budget.one_more_channel()
