"""ROS 1 bags written record by record: where damage begins, what is refused, and the limits.

Source: wiki.ros.org/Bags/Format/2.0: a record is a header and data, each behind its length of four bytes.
"""

import bz2
import struct
from pathlib import Path

import pytest

from safedpa.errors import RunError
from safedpa.limits import LimitError
from safedpa.records.readers.bags.rosbag1 import Ros1Bag

MAGIC = b"#ROSBAG V2.0\n"
PACKED = {"none": bytes, "bz2": bz2.compress}


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


def chunk(inside: bytes, how: str = "none", declared: int | None = None, packed: bytes | None = None) -> bytes:
    size = struct.pack("<I", len(inside) if declared is None else declared)
    header = field("op", b"\x05") + field("compression", how.encode()) + field("size", size)
    return record(header, PACKED[how](inside) if packed is None else packed)


def bag(folder: Path, *records: bytes) -> Ros1Bag:
    path = folder / "a.bag"
    path.write_bytes(MAGIC + b"".join(records))
    return Ros1Bag(path)


def read(log: Ros1Bag) -> list[tuple[str, int, bytes]]:
    return list(log.messages(None))


WHOLE = ("/a", 5_000_000_007, b"\0\0\0\0")
INSIDE = connection(0) + message()
INDEX = record(field("op", b"\x03"), b"index")


def test_times_are_nanoseconds_and_only_the_wanted_topics_are_given(tmp_path: Path) -> None:
    late = message(1, seconds=1_700_000_000, nanoseconds=999_999_999, data=b"x")
    log = bag(tmp_path, connection(0), INDEX, connection(1, "/b"), message(), late)
    assert read(log) == [WHOLE, ("/b", 1_700_000_000_999_999_999, b"x")]
    assert [topic for topic, *_ in log.messages(("/b",))] == ["/b"]
    assert list(log.messages(())) == []
    assert not log.findings


@pytest.mark.parametrize("how", PACKED)
@pytest.mark.parametrize("more", [-1, 0, 1])
def test_a_chunk_whose_length_differs_from_the_declared_one_is_damaged(how: str, more: int, tmp_path: Path) -> None:
    log = bag(tmp_path, chunk(INSIDE, how, declared=len(INSIDE) + more))
    assert read(log) == ([] if more else [WHOLE])
    assert [found.kind for found in log.findings] == ["damaged"] * bool(more)
    if more:
        assert f"at byte {len(MAGIC)} of {log.path.stat().st_size}" in log.findings[0].message


@pytest.mark.parametrize(
    ("broken", "damage"),
    [
        pytest.param(b"", "", id="nothing broken"),
        pytest.param(INDEX, "", id="a record that is not needed"),
        pytest.param(record(field("ver", b"\x01")), "", id="no op"),
        pytest.param(bytes(100), "damaged", id="a hole of zeros"),
        pytest.param(struct.pack("<I", 1 << 20) + b"short", "damaged", id="a header beyond the file's end"),
        pytest.param(record(b"\x05\0\0\0" + b"op=\x02"), "damaged", id="a field longer than its header"),
        pytest.param(record(b"\x03\0\0\0" + b"op2"), "damaged", id="a field without a value"),
        pytest.param(record(b"\0\0\0\0"), "damaged", id="an empty field"),
        pytest.param(record(field("op", b"\x02")), "damaged", id="a message without a connection"),
        pytest.param(record(field("op", b"\x05")), "damaged", id="a chunk without a size"),
        pytest.param(message(1), "damaged", id="a message of an unknown connection"),
    ],
)
def test_a_damaged_bag_is_read_before_and_after_the_damage(broken: bytes, damage: str, tmp_path: Path) -> None:
    log = bag(tmp_path, INSIDE, broken, message())
    assert read(log) == [WHOLE, WHOLE]
    assert [found.kind for found in log.findings] == [damage] * bool(damage)
    if damage:
        place = f"at byte {len(MAGIC + INSIDE)} of {log.path.stat().st_size}"
        assert place in log.findings[0].message


def test_a_record_longer_than_its_chunk_is_damage_after_the_messages_before_it(tmp_path: Path) -> None:
    last = message(data=b"abcd")
    log = bag(tmp_path, chunk(INSIDE + last[:-8] + struct.pack("<I", 5) + b"abcd"))
    assert read(log) == [WHOLE]
    assert [found.kind for found in log.findings] == ["damaged"]


@pytest.mark.parametrize("less", [1, 5, 30])
def test_a_bag_that_ends_within_a_message_is_cut_off(less: int, tmp_path: Path) -> None:
    log = bag(tmp_path, INSIDE, message()[:-less])
    assert read(log) == [WHOLE]
    assert [(found.kind, found.start_t) for found in log.findings] == [("cut_off", 5.000000007)]


@pytest.mark.parametrize("at", range(0, 400, 19))
@pytest.mark.parametrize("how", PACKED)
def test_a_hole_costs_the_records_or_packed_chunks_that_it_touches(how: str, at: int, tmp_path: Path) -> None:
    """The connection is in the first chunk, and in the index at the end."""
    inside = [b"".join(message(seconds=10 * k + i) for i in range(3)) for k in range(4)]
    chunks = [chunk(connection(0) * (not k) + part, how) for k, part in enumerate(inside)]
    head = record(field("op", b"\x03") + field("index_pos", bytes(8)))
    ends = [len(b"".join(chunks[: k + 1])) for k in range(4)]
    data = bytearray(b"".join(chunks))
    data[at : at + 24] = bytes(24)
    head = record(field("op", b"\x03") + field("index_pos", struct.pack("<Q", len(MAGIC + head) + ends[-1])))
    log = bag(tmp_path, head, bytes(data), connection(0))
    touched = sum(end - len(part) < at + 24 and at < end for end, part in zip(ends, chunks, strict=True))
    assert len(read(log)) >= 12 - (3 * touched if how == "bz2" else 2)
    assert {found.kind for found in log.findings} <= {"damaged"}


@pytest.mark.parametrize("start", [b"#ROSBAG V1.2\n", b"#ROSBAG V2.1\n", b"", b"#ROSBAG V2.0"])
def test_a_file_of_another_format_is_refused(start: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.bag").write_bytes(start)
    with pytest.raises(RunError, match=r"is no ROS 1 bag of format 2.0; 'rosbag fix'"):
        read(Ros1Bag(tmp_path / "a.bag"))


def test_a_topic_may_have_two_types_and_chunks_have_a_known_compression(tmp_path: Path) -> None:
    """Two connections of one topic and type are two publishers."""
    assert read(bag(tmp_path, connection(0), connection(1), message(0), message(1))) == [WHOLE, WHOLE]
    other = "std_msgs/Int32"
    assert read(bag(tmp_path, connection(0), connection(1, "/b", other), message(1)))[0][0] == "/b"
    both = read(bag(tmp_path, connection(0), connection(1, kind=other), message(0), message(1)))
    assert [name for name, *_ in both] == ["/a", "/a (std_msgs/msg/Int32)"]
    with pytest.raises(RunError, match=r"chunks are compressed by 'zip'; wanted bz2 or lz4"):
        read(bag(tmp_path, chunk(b"", "zip", packed=b"")))


@pytest.mark.parametrize(
    ("records", "limits", "refused"),
    [
        pytest.param([connection(0), connection(1, "/b")] * 2, "bag_topics=2", "", id="repeated connections"),
        pytest.param([connection(k, f"/{k}") for k in range(3)], "bag_topics=2", "at most 2; ", id="topics"),
        pytest.param([chunk(INSIDE, "bz2", 5000, b"x")], "bag_chunk_bytes=5000", "", id="a declared size in bounds"),
        pytest.param(
            [chunk(INSIDE, "bz2", 5000, b"x")], "bag_chunk_bytes=4999", "got 5000 bytes, .*at most 4999", id="declared"
        ),
        pytest.param(
            [chunk(INSIDE, "bz2", 1, b"x" * 5000)], "bag_chunk_bytes=4999", "got 5000 bytes, .*at most 4999", id="there"
        ),
        pytest.param([record(field("op", b"\x03"), b" " * 1000)], "bag_chunk_bytes=1000", "", id="a long record"),
        pytest.param(
            [record(field("op", b"\x03"), b" " * 1001)], "bag_chunk_bytes=1000", "got 1001 bytes", id="a longer record"
        ),
    ],
)
def test_a_bag_stays_within_the_limits(records, limits, refused, tmp_path, monkeypatch):
    monkeypatch.setenv("SAFEDPA_LIMITS", limits)
    if refused:
        with pytest.raises(LimitError, match=refused):
            read(bag(tmp_path, *records))
    else:
        read(bag(tmp_path, *records))


@pytest.mark.parametrize("less", [0, 1])
def test_all_chunks_share_one_limit_of_expansion(less: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    inside = connection(0) + message(data=b" " * 500)
    log = bag(tmp_path, chunk(inside, "bz2"), chunk(inside, "bz2"))
    assert log.path.stat().st_size < 2 * len(inside) - 1
    monkeypatch.setenv("SAFEDPA_LIMITS", f"expansion=1,expansion_free_bytes={2 * len(inside) - less}")
    if less:
        with pytest.raises(LimitError, match=r"expansion"):
            read(log)
    else:
        assert len(read(log)) == 2


@pytest.mark.parametrize("more", [0, 1])
def test_a_header_longer_than_a_mebibyte_is_damage(more: int, tmp_path: Path) -> None:
    op = field("op", b"\x03")
    header = op + field("x", b" " * ((1 << 20) - len(op) - 6 + more))
    assert len(header) == (1 << 20) + more
    log = bag(tmp_path, connection(0), record(header), message())
    assert read(log) == [WHOLE]
    assert len(log.findings) == more
