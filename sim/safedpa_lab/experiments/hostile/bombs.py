"""Small inputs that ask for much, one of each kind for every loader: refused, soon, and in little memory."""

from __future__ import annotations

import bz2
import io
import json
import sqlite3
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

_ULOG = b"ULog\x01\x12\x35\x01" + bytes(8)
_ROS1 = b"#ROSBAG V2.0\n"
_MCAP = b"\x89MCAP0\r\n"
_MANY = 60_000
_MEBI = 1 << 20


def _logged(kind: str, body: bytes) -> bytes:
    return struct.pack("<HB", len(body), ord(kind)) + body


def _subscriptions() -> bytes:
    described = _logged("F", b"a:uint64_t timestamp;" + b";".join(b"float x%d" % number for number in range(3900)))
    return _ULOG + described + b"".join(_logged("A", struct.pack("<BH", 0, number) + b"a") for number in range(_MANY))


def _nothing_known() -> bytes:
    return _ULOG + _logged("F", b"a:uint64_t timestamp;float x") + _SUBSCRIBED + bytes(3 * 3_000_000)


_SUBSCRIBED = _logged("A", bytes(3) + b"a")


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


def _bag(connections: bytes) -> bytes:
    message = _record({"op": b"\x02", "conn": bytes(4), "time": struct.pack("<II", 1, 0)}, b"")
    return _ROS1 + connections + message


def _chunks() -> bytes:
    size = 60 * _MEBI
    fields = {"op": b"\x05", "compression": b"bz2", "size": struct.pack("<I", size)}
    return _ROS1 + _record(fields, bz2.compress(bytes(size))) * 200


def _definitions() -> bytes:
    text = b"".join(b"float64 x%d\n" % number for number in range(2000))
    return _bag(b"".join(_connection(k, b"a/B%d" % k, text) for k in range(300)))


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


def _packed(records: bytes) -> bytes:
    import zstandard

    return zstandard.compress(_MCAP + records, 19)


def _references(last: str) -> bytes:
    """Each line names the one before it nine times."""
    text = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n"
    text += "".join(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, 12))
    return (text + f"rosbag2_bagfile_information:\n  {last}\n").encode()


def _merged() -> bytes:
    text = "a0: &a0 {" + ", ".join(f"k{k}: 1" for k in range(500)) + "}\n"
    text += "".join(f"a{k}: &a{k}\n  <<: [{', '.join(f'*a{j}' for j in range(k))}]\n" for k in range(1, 200))
    return text.encode()


@dataclass(frozen=True)
class Bomb:
    """One hostile input: what it is, its ending, how its bytes are made."""

    name: str
    ending: str
    make: Callable[[], bytes]


def _text(text: str) -> Callable[[], bytes]:
    return text.encode


def _mcap(compression: str, packed: bytes, reported: int) -> bytes:
    name = compression.encode()
    body = struct.pack("<QQQII", 0, 1, reported, 0, len(name)) + name + struct.pack("<Q", len(packed)) + packed
    header = struct.pack("<BQII", 1, 8, 0, 0)
    return _MCAP + header + struct.pack("<BQ", 6, len(body)) + body


def _zstd(reported: int | None = None) -> bytes:
    import zstandard

    size = 2048 * _MEBI
    packer = zstandard.ZstdCompressor(level=3).compressobj(size=size)
    piece = bytes(_MEBI)
    packed = b"".join([*(packer.compress(piece) for _ in range(size // _MEBI)), packer.flush()])
    return _mcap("zstd", packed, size if reported is None else reported)


def _many_chunks() -> bytes:
    """Each of its chunks is allowed, all together are not."""
    import zstandard

    size = 8 * _MEBI
    private = struct.pack("<BQ", 0x80, 0) * (size // 9)
    one = _mcap("zstd", zstandard.compress(private, 19), len(private))
    return one + one[len(_MCAP) + 17 :] * 400


def _lz4() -> bytes:
    import lz4.frame  # type: ignore[import-untyped]

    return _mcap("lz4", lz4.frame.compress(bytes(256 * _MEBI)), 1000)


def _parquet(rows: int, columns: int = 7) -> bytes:
    import numpy as np
    import pyarrow
    from pyarrow import parquet

    names = ["t", "x", "y", "yaw", "speed", "target_speed", "steer"]
    names += [f"c{number}" for number in range(columns - len(names))]
    constant = pyarrow.array(np.ones(rows))
    sink = io.BytesIO()
    parquet.write_table(pyarrow.table(dict.fromkeys(names, constant)), sink, compression="zstd")
    return sink.getvalue()


def _tensors(header: object, length: int | None = None) -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(text) if length is None else length) + text


def _zip() -> bytes:
    sink = io.BytesIO()
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("heights.npy", bytes(1024 * _MEBI))
    return sink.getvalue()


def _zip_that_lies() -> bytes:
    """Its directory claims 10 bytes."""
    packed = zlib.compress(bytes(200 * _MEBI))[2:-4]
    sink = io.BytesIO()
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_STORED) as archive:
        for number in range(3000):
            archive.writestr(f"{number}.npy", packed[:100])
    return sink.getvalue()


_LONG = "1" * 100_000
_PATHS = "rosbag2_bagfile_information:\n  relative_file_paths:\n"
_CAR = "format = 1\nrobot = 'car'\n[base]\nkind='kinematic_bicycle'\ndrive='speed_servo'\n"
_EMPTY = {"dtype": "F32", "shape": [0], "data_offsets": [0, 0]}
_HUGE = {"dtype": "F32", "shape": [1 << 30] * 4, "data_offsets": [0, 0]}
BOMBS: tuple[Bomb, ...] = (
    Bomb("a key of 50 000 parts", ".toml", _text("a" + ".a" * 50_000 + " = 1\n")),
    Bomb("a table's name of 30 000 parts", ".toml", _text("[a" + ".a" * 30_000 + "]\n")),
    Bomb("arrays in arrays", ".toml", _text("x = " + "[" * 50_000)),
    Bomb("tables in tables", ".toml", _text("x = " + "{a=" * 30_000)),
    Bomb("a number of 100 000 digits", ".toml", _text(f"format = {_LONG}\n")),
    Bomb("a string without an end", ".toml", _text('"""\\' * 40_000)),
    Bomb("a file of 200 MB", ".toml", lambda: b"#" * (200 * _MEBI)),
    Bomb("1000 effects", ".toml", _text(_CAR + "[[effects]]\nname='payload'\n" * 1000)),
    Bomb("a key of 50 000 parts in a column map", ".map", _text("a" + ".a" * 50_000 + " = 1\n")),
    Bomb("a million columns", ".csv", _text(",".join(f"c{n}" for n in range(1_000_000)) + "\n1\n")),
    Bomb("5000 columns", ".csv", _text(",".join(f"c{n}" for n in range(5000)) + "\n" + "1," * 4999 + "1\n")),
    Bomb("one line of 50 MB", ".csv", lambda: b"t,x,y,yaw,speed,target_speed,steer\n" + b"1" * (50 * _MEBI)),
    Bomb("30 million equal rows", ".parquet", lambda: _parquet(30_000_000)),
    Bomb("10 000 columns", ".parquet", lambda: _parquet(1, 10_000)),
    Bomb("a description of 2 GB", ".parquet", lambda: b"PAR1" + bytes(99) + b"\x00\x94\x35\x77PAR1"),
    Bomb("a chunk of 2 GB in 65 KB", ".mcap", _zstd),
    Bomb("a chunk that says less than it holds", ".mcap", lambda: _zstd(1000)),
    Bomb("a chunk of lz4 that says less than it holds", ".mcap", _lz4),
    Bomb("400 chunks of 8 MB", ".mcap", _many_chunks),
    Bomb("a chunk that says 2^63 bytes", ".mcap", lambda: _mcap("zstd", b"x" * 100, 1 << 63)),
    Bomb("a header of 2^40 bytes", ".safetensors", lambda: _tensors(b"{}", 1 << 40)),
    Bomb("arrays in the header", ".safetensors", lambda: _tensors(b'{"a":' + b"[" * 100_000)),
    Bomb("a shape of 2^120 numbers", ".safetensors", lambda: _tensors({"a": _HUGE})),
    Bomb("a number of 100 000 digits", ".safetensors", lambda: _tensors(b'{"a":{"shape":[' + _LONG.encode() + b"]}}")),
    Bomb("12 000 tensors", ".safetensors", lambda: _tensors({f"t{n}": _EMPTY for n in range(12_000)})),
    Bomb("a gigabyte in a megabyte", ".npz", _zip),
    Bomb("3000 members", ".npz", _zip_that_lies),
    Bomb("4 million empty tables", ".msgpack", lambda: b"\x81\xa1x\xdd\x00\x3d\x09\x00" + b"\x80" * 4_000_000),
    Bomb("arrays in arrays", ".msgpack", lambda: b"\x81\xa1x" + b"\x91" * 4_000_000),
    Bomb("a list that says 2^32 entries", ".msgpack", lambda: b"\x81\xa8document\xdd\xff\xff\xff\xff"),
    Bomb(
        "10 000 fields", ".msgpack",
        lambda: b"\xde\x27\x10" + b"".join(b"\xa5%05d\xc0" % number for number in range(10_000)),
    ),
    Bomb("arrays in arrays", ".json", _text("[" * 100_000)),
    Bomb("a number of 100 000 digits", ".json", _text(f'{{"coverage": {_LONG}}}')),
    Bomb("10 million bytes", ".json", _text('"' + "a" * 10_000_000 + '"')),
    Bomb("60 000 subscriptions of 3900 numbers", ".ulg", _subscriptions),
    Bomb("a message made of itself", ".ulg", lambda: _ULOG + _logged("F", b"a:" + b"a b;" * 12_000) + _SUBSCRIBED),
    Bomb("3 million messages that no one knows", ".ulg", _nothing_known),
    Bomb("200 chunks of 60 MB", ".bag", _chunks),
    Bomb("300 definitions of 27 KB", ".bag", _definitions),
    Bomb("a definition of blank lines", ".bag", lambda: _bag(_connection(0, b"a/B", b" \n" * 65_000 + b"float64 x\n"))),
    Bomb("200 000 rows that share 400 KB", ".db3", _shared_bytes),
    Bomb("topics without numbers", ".db3", _topics_without_numbers),
    Bomb("a million empty records", ".zstd", lambda: _packed(bytes(7 * _MEBI))),
    Bomb("a million private records", ".zstd", lambda: _packed((b"\x80" + bytes(8)) * 800_000)),
    Bomb("references to references, as a word", ".yaml", lambda: _references("compression_mode: *a11")),
    Bomb("references to references, as a file", ".yaml", lambda: _references("relative_file_paths: [*a11]")),
    Bomb("tables merged into tables", ".yaml", _merged),
    Bomb("one file 80 000 times", ".yaml", _text(_PATHS + "    - x.db3\n" * 80_000)),
)  # fmt: skip
"""What is too long, too deep, too wide, or becomes too much when it is opened. Endings: ``.yaml`` is a bag's metadata,
``.zstd`` an MCAP file packed whole."""
