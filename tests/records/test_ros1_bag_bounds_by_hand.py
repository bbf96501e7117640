"""Bags of ROS 1 written record by record: what is damage and where it begins, what is refused, and what just passes.

Source: wiki.ros.org/Bags/Format/2.0: a record is a header and data, each behind its length of four bytes.
"""

from __future__ import annotations

import bz2
import struct
from collections.abc import Callable
from pathlib import Path

import pytest

from safedpa.errors import RunError
from safedpa.limits import LimitError
from safedpa.records.bags.ros1_bag import Ros1Bag

MAGIC = b"#ROSBAG V2.0\n"


def field(name: str, value: bytes) -> bytes:
    entry = name.encode() + b"=" + value
    return struct.pack("<I", len(entry)) + entry


def record(header: bytes, data: bytes = b"") -> bytes:
    return struct.pack("<I", len(header)) + header + struct.pack("<I", len(data)) + data


def connection(number: int, topic: str = "/a", kind: str = "std_msgs/Float32") -> bytes:
    header = field("op", b"\x07") + field("conn", struct.pack("<I", number)) + field("topic", topic.encode())
    return record(header, field("type", kind.encode()) + field("message_definition", b"float32 data"))


def message(number: int = 0, seconds: int = 5, nanoseconds: int = 7, data: bytes = b"\0\0\0\0") -> bytes:
    time = struct.pack("<II", seconds, nanoseconds)
    return record(field("op", b"\x02") + field("conn", struct.pack("<I", number)) + field("time", time), data)


def chunk(inside: bytes, how: str = "none", told: int | None = None, packed: bytes | None = None) -> bytes:
    size = struct.pack("<I", len(inside) if told is None else told)
    return record(
        field("op", b"\x05") + field("compression", how.encode()) + field("size", size),
        inside if packed is None else packed,
    )


def bag(folder: Path, *records: bytes) -> Ros1Bag:
    path = folder / "a.bag"
    path.write_bytes(MAGIC + b"".join(records))
    return Ros1Bag(path)


def read(log: Ros1Bag) -> list[tuple[str, int, bytes]]:
    return list(log.messages(None))


WHOLE = ("/a", 5_000_000_007, b"\0\0\0\0")


def test_messages_without_a_chunk_are_read_with_their_time_in_nanoseconds(tmp_path: Path) -> None:
    log = bag(tmp_path, connection(0), message(), message(seconds=0, nanoseconds=999_999_999, data=b"x"))
    assert read(log) == [WHOLE, ("/a", 999_999_999, b"x")]
    assert not log.findings


PACKED: dict[str, Callable[[bytes], bytes]] = {"none": lambda data: data, "bz2": bz2.compress}


@pytest.mark.parametrize("how", PACKED)
def test_a_chunk_that_is_as_long_as_it_says_is_read(how: str, tmp_path: Path) -> None:
    inside = connection(0) + message()
    log = bag(tmp_path, chunk(inside, how, packed=PACKED[how](inside)))
    assert read(log) == [WHOLE]
    assert not log.findings


@pytest.mark.parametrize("how", PACKED)
@pytest.mark.parametrize("more", [-1, 1])
def test_a_chunk_of_another_length_than_it_says_is_damage(how: str, more: int, tmp_path: Path) -> None:
    inside = connection(0) + message()
    log = bag(tmp_path, chunk(inside, how, told=len(inside) + more, packed=PACKED[how](inside)))
    assert read(log) == []
    assert [found.kind for found in log.findings] == ["cut_off"]
    assert f"at byte {len(MAGIC)} of {log.path.stat().st_size}" in log.findings[0].message


def test_a_record_that_is_longer_than_its_chunk_is_damage_behind_what_stood_before(tmp_path: Path) -> None:
    """The last message says one byte more than its chunk has."""
    last = message(data=b"abcd")
    broken = last[:-8] + struct.pack("<I", 5) + b"abcd"
    log = bag(tmp_path, chunk(connection(0) + message() + broken))
    assert read(log) == [WHOLE]
    assert [found.kind for found in log.findings] == ["cut_off"]


def test_a_message_of_no_known_connection_is_damage(tmp_path: Path) -> None:
    log = bag(tmp_path, connection(0), message(0), message(1), message(0))
    assert read(log) == [WHOLE]
    assert [found.kind for found in log.findings] == ["cut_off"]


@pytest.mark.parametrize(
    ("broken", "kept"),
    [
        pytest.param(struct.pack("<I", 1 << 20) + b"short", 1, id="a header beyond the file's end"),
        pytest.param(record(b"\x05\0\0\0" + b"op=\x02"), 1, id="a field longer than its header"),
        pytest.param(record(b"\x03\0\0\0" + b"op2"), 1, id="a field without a value"),
        pytest.param(message()[:-1], 1, id="data beyond the file's end"),
        pytest.param(message()[:-5], 1, id="a length beyond the file's end"),
        pytest.param(record(field("op", b"\x02")), 1, id="a message without a connection"),
        pytest.param(record(field("op", b"\x05")), 1, id="a chunk without a size"),
        pytest.param(message(), 2, id="nothing broken"),
        pytest.param(record(field("op", b"\x03"), b"index"), 1, id="what nobody reads"),
        pytest.param(record(field("ver", b"\x01")), 1, id="no op"),
    ],
)
def test_where_a_bag_is_damaged_it_is_read_up_to_there(broken: bytes, kept: int, tmp_path: Path) -> None:
    """What is no damage leaves no finding, and lets all that follows by."""
    log = bag(tmp_path, connection(0), message(), broken)
    at = len(MAGIC) + len(connection(0)) + len(message())
    assert read(log) == [WHOLE] * kept
    sound = broken in (message(), record(field("op", b"\x03"), b"index"), record(field("ver", b"\x01")))
    said = [found.message for found in log.findings]
    assert said == [] if sound else len(said) == 1 and f"at byte {at} of {log.path.stat().st_size}" in said[0]


def test_what_lies_between_records_that_nobody_reads_is_passed_over(tmp_path: Path) -> None:
    log = bag(
        tmp_path, record(field("op", b"\x03"), b" " * 4096), connection(0), record(field("op", b"\x04")), message()
    )
    assert read(log) == [WHOLE]


@pytest.mark.parametrize("start", [b"#ROSBAG V1.2\n", b"#ROSBAG V2.1\n", b"", b"#ROSBAG V2.0"])
def test_what_is_no_bag_of_format_2_0_is_refused(start: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.bag"
    path.write_bytes(start)
    with pytest.raises(RunError, match=r"is no ROS 1 bag of format 2.0; 'rosbag fix' brings older ones up to it"):
        read(Ros1Bag(path))


def test_a_topic_has_one_type(tmp_path: Path) -> None:
    """Two connections of one topic and type are two publishers; of two types they cannot be told apart."""
    log = bag(tmp_path, connection(0), connection(1), message(0), message(1))
    assert read(log) == [WHOLE, WHOLE]
    log = bag(tmp_path, connection(0), connection(1, kind="std_msgs/Int32"))
    with pytest.raises(
        RunError, match=r"topic '/a' has two types, std_msgs/msg/Float32 and std_msgs/msg/Int32; filter the bag"
    ):
        read(log)
    assert read(bag(tmp_path, connection(0), connection(1, "/b", "std_msgs/Int32"), message(1)))[0][0] == "/b"


def test_chunks_packed_by_something_else_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"chunks are packed by 'zip'; wanted bz2 or lz4"):
        read(bag(tmp_path, chunk(b"", "zip")))


def test_so_many_topics_and_no_more_whatever_their_connections(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A connection that is told again, as each chunk does, is none more."""
    monkeypatch.setenv("SAFEDPA_LIMITS", "bag_topics=2")
    two = [connection(0), connection(1, "/b")]
    assert read(bag(tmp_path, *two, *two, message())) == [WHOLE]
    with pytest.raises(LimitError, match=r"wanted at most 2; .*bag_topics"):
        read(bag(tmp_path, *two, connection(2, "/c")))


@pytest.mark.parametrize("told", [True, False])
def test_a_chunk_has_so_many_bytes_told_and_there(told: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Either is enough: a small one that says it becomes large, and a large one that says it stays small."""
    inside = connection(0) + message()
    one = chunk(inside, "bz2", told=5000, packed=b"x") if told else chunk(inside, "bz2", told=1, packed=b"x" * 5000)
    monkeypatch.setenv("SAFEDPA_LIMITS", "bag_chunk_bytes=5000")
    assert read(bag(tmp_path, one)) == []
    monkeypatch.setenv("SAFEDPA_LIMITS", "bag_chunk_bytes=4999")
    with pytest.raises(LimitError, match=r"got 5000 bytes, wanted at most 4999; .*bag_chunk_bytes"):
        read(bag(tmp_path, one))


@pytest.mark.parametrize("more", [0, 1])
def test_a_record_has_so_many_bytes(more: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SAFEDPA_LIMITS", "bag_chunk_bytes=1000")
    log = bag(tmp_path, record(field("op", b"\x03"), b" " * (1000 + more)), connection(0), message())
    if more:
        with pytest.raises(LimitError, match=r"a record of the bag: .*got 1001 bytes, wanted at most 1000"):
            read(log)
    else:
        assert read(log) == [WHOLE]


@pytest.mark.parametrize("more", [0, 1])
def test_all_chunks_together_may_become_so_much(more: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second of two has what the first one left over."""
    inside = connection(0) + message(data=b" " * 500)
    packed = chunk(inside, "bz2", packed=bz2.compress(inside))
    monkeypatch.setenv("SAFEDPA_LIMITS", f"expansion=1,expansion_free_bytes={2 * len(inside) - more}")
    log = bag(tmp_path, packed, packed)
    assert log.path.stat().st_size < 2 * len(inside) - 1
    if more:
        with pytest.raises(LimitError, match=r"expansion"):
            read(log)
    else:
        assert len(read(log)) == 2


def test_only_topics_that_were_asked_for_are_given(tmp_path: Path) -> None:
    log = bag(tmp_path, connection(0), connection(1, "/b"), message(0), message(1), message(0))
    assert [topic for topic, *_ in log.messages(("/b",))] == ["/b"]
    assert list(log.messages(())) == []


@pytest.mark.parametrize("more", [0, 1])
def test_a_header_has_a_mebibyte_at_most(more: int, tmp_path: Path) -> None:
    """One that is longer is damage: nobody writes it."""
    op = field("op", b"\x03")
    filling = field("x", b" " * ((1 << 20) - len(op) - 6 + more))
    assert len(op + filling) == (1 << 20) + more
    log = bag(tmp_path, connection(0), record(op + filling), message())
    assert read(log) == ([] if more else [WHOLE])
    assert len(log.findings) == more
