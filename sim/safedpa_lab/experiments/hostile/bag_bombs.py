"""Bags and flight logs of some kilobytes that ask for much."""

from __future__ import annotations

import bz2
import sqlite3
import struct
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

_MEBI = 1 << 20
_ULOG = b"ULog\x01\x12\x35\x01" + bytes(8)
_ROS1 = b"#ROSBAG V2.0\n"
_MCAP = b"\x89MCAP0\r\n"
_MANY = 60_000


def _logged(kind: str, body: bytes) -> bytes:
    return struct.pack("<HB", len(body), ord(kind)) + body


def _subscriptions() -> bytes:
    described = _logged("F", b"a:uint64_t timestamp;" + b";".join(b"float x%d" % number for number in range(3900)))
    return _ULOG + described + b"".join(_logged("A", struct.pack("<BH", 0, number) + b"a") for number in range(_MANY))


def _described_by_itself() -> bytes:
    return _ULOG + _logged("F", b"a:" + b"a b;" * 12_000) + _logged("A", bytes(3) + b"a")


def _nothing_known() -> bytes:
    described = _logged("F", b"a:uint64_t timestamp;float x") + _logged("A", bytes(3) + b"a")
    return _ULOG + described + bytes(3 * 3_000_000)


def _header(fields: Mapping[str, bytes]) -> bytes:
    parts = [name.encode() + b"=" + value for name, value in fields.items()]
    return b"".join(struct.pack("<I", len(part)) + part for part in parts)


def _record(fields: Mapping[str, bytes], data: bytes) -> bytes:
    header = _header(fields)
    return struct.pack("<I", len(header)) + header + struct.pack("<I", len(data)) + data


def _connection(number: int, kind: bytes, definition: bytes) -> bytes:
    about = {"type": kind, "md5sum": b"*", "message_definition": definition}
    fields = {"op": b"\x07", "conn": struct.pack("<I", number), "topic": b"/t%d" % number}
    return _record(fields, _header(about))


def _empty_message() -> bytes:
    return _record({"op": b"\x02", "conn": bytes(4), "time": struct.pack("<II", 1, 0)}, b"")


def _chunks() -> bytes:
    size = 60 * _MEBI
    fields = {"op": b"\x05", "compression": b"bz2", "size": struct.pack("<I", size)}
    return _ROS1 + _record(fields, bz2.compress(bytes(size))) * 200


def _definitions() -> bytes:
    text = b"".join(b"float64 x%d\n" % number for number in range(2000))
    return _ROS1 + b"".join(_connection(k, b"a/B%d" % k, text) for k in range(300)) + _empty_message()


def _blank_lines() -> bytes:
    return _ROS1 + _connection(0, b"a/B", b" \n" * 65_000 + b"float64 x\n") + _empty_message()


def _database(statements: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bag.db3"
        base = sqlite3.connect(path)
        base.executescript(
            "CREATE TABLE topics (id, name TEXT, type TEXT, serialization_format TEXT);"
            "CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER);" + statements
        )
        base.commit()
        base.close()
        return path.read_bytes()


def _shared_bytes() -> bytes:
    """A column that came later takes its value from the schema, for every row."""
    return _database(
        "INSERT INTO topics VALUES(1,'/odom','nav_msgs/msg/Odometry','cdr');"
        "WITH RECURSIVE c(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM c LIMIT 200000)"
        "INSERT INTO messages SELECT n, 1, n FROM c;"
        f"ALTER TABLE messages ADD COLUMN data BLOB DEFAULT x'{'00' * 400_000}';"
    )


def _topics_without_numbers() -> bytes:
    return _database(
        "ALTER TABLE messages ADD COLUMN data BLOB;"
        "INSERT INTO topics VALUES('one','/odom','nav_msgs/msg/Odometry','cdr');"
        "INSERT INTO messages VALUES(1, 1, 1, x'00');"
    )


def _empty_records() -> bytes:
    import zstandard

    return zstandard.compress(_MCAP + bytes(7 * _MEBI), 19)


def _private_records() -> bytes:
    import zstandard

    return zstandard.compress(_MCAP + (b"\x80" + bytes(8)) * 800_000, 19)


def _references(last: str) -> bytes:
    """Each line names the one before it nine times."""
    text = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n"
    text += "".join(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, 12))
    return (text + f"rosbag2_bagfile_information:\n  {last}\n").encode()


def _merged() -> bytes:
    text = "a0: &a0 {" + ", ".join(f"k{k}: 1" for k in range(500)) + "}\n"
    text += "".join(f"a{k}: &a{k}\n  <<: [{', '.join(f'*a{j}' for j in range(k))}]\n" for k in range(1, 200))
    return text.encode()


def _one_file_often() -> bytes:
    return ("rosbag2_bagfile_information:\n  relative_file_paths:\n" + "    - x.db3\n" * 80_000).encode()


BAG_BOMBS: tuple[tuple[str, str, Callable[[], bytes]], ...] = (
    ("60 000 subscriptions of 3900 numbers", ".ulg", _subscriptions),
    ("a message made of itself", ".ulg", _described_by_itself),
    ("3 million messages that no one knows", ".ulg", _nothing_known),
    ("200 chunks of 60 MB", ".bag", _chunks),
    ("300 definitions of 27 KB", ".bag", _definitions),
    ("a definition of blank lines", ".bag", _blank_lines),
    ("200 000 rows that share 400 KB", ".db3", _shared_bytes),
    ("topics without numbers", ".db3", _topics_without_numbers),
    ("a million empty records", ".zstd", _empty_records),
    ("a million private records", ".zstd", _private_records),
    ("references to references, as a word", ".yaml", lambda: _references("compression_mode: *a11")),
    ("references to references, as a file", ".yaml", lambda: _references("relative_file_paths: [*a11]")),
    ("tables merged into tables", ".yaml", _merged),
    ("one file 80 000 times", ".yaml", _one_file_often),
)  # fmt: skip
"""What it is, its ending (``.yaml``: a bag's metadata, ``.zstd``: an MCAP file packed whole), its bytes."""
