"""Writes a log of topics as MCAP, SQLite or ULog, and a table as CSV or Parquet."""

from __future__ import annotations

import gzip
import math
import sqlite3
import struct
from contextlib import closing
from functools import cache
from pathlib import Path
from typing import Any, Final

from safedpa_lab.log_faults.drive import COMMAND, NAMES, STATE, Drive, Message, Table, Topics

__all__ = ["topic_map", "write_table", "write_topics"]

_CHUNK_BYTES: Final = 8192
_SECOND: Final = 1_000_000_000
_SYNC: Final = 20
"""Messages of a flight log from one synchronisation mark to the next."""
_SYNC_BYTES: Final = bytes((0x2F, 0x73, 0x13, 0x20, 0x25, 0x0C, 0xBB, 0x12))
_TYPES: Final = {"": "geometry_msgs/msg/TwistStamped", "plain": "geometry_msgs/msg/Twist"}
_ODOMETRY: Final = "nav_msgs/msg/Odometry"
_FIELDS: Final = {
    "x": "pose.pose.position.x",
    "y": "pose.pose.position.y",
    "yaw": "pose.pose.orientation",
    "speed": "twist.twist.linear.x",
}


def topic_map(log: Topics, form: str) -> str:
    """The column map of a log of topics."""
    if form == "ulg":
        sources = {name: ("pose", name) for name in NAMES[1:5]} | {"target_speed": ("cmd", "v"), "steer": ("cmd", "s")}
        clock = "pose"
    else:
        turn = log.field.replace("linear.x", "angular.z")
        sources = {name: (STATE, path) for name, path in _FIELDS.items()}
        sources |= {"target_speed": (COMMAND, log.field), "steer": (COMMAND, turn)}
        clock = STATE
    lines = [f'{name} = {{ topic = "{topic}", field = "{path}" }}' for name, (topic, path) in sources.items()]
    return "\n".join(['format = 1\nrobot = "car"\n[columns]', f't = {{ topic = "{clock}", clock = "header" }}', *lines])


def write_topics(log: Topics, drive: Drive, path: Path) -> None:
    """Writes the log in the format of the suffix of the path: ``.mcap``, ``.db3`` or ``.ulg``."""
    {".mcap": _write_mcap, ".db3": _write_sqlite, ".ulg": _write_ulog}[path.suffix](log, drive, path)


@cache
def _store() -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def _type_of(message: Message) -> str:
    return _ODOMETRY if message.topic == STATE else _TYPES[message.form]


def _definition(kind: str) -> str:
    text: str = _store().generate_msgdef(kind, ros_version=2)[0]
    return text


def _encoded(message: Message, drive: Drive) -> bytes:
    store = _store()
    types = store.types
    _, x, y, yaw, speed, target, steer = drive.values[message.row].tolist()
    second, nanosecond = divmod(round(message.stamp * _SECOND), _SECOND)
    stamp = types["builtin_interfaces/msg/Time"](second, nanosecond)
    head = types["std_msgs/msg/Header"](stamp=stamp, frame_id="odom")
    vector, twist = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Twist"]
    if message.topic == COMMAND:
        asked = twist(linear=vector(target, 0.0, 0.0), angular=vector(0.0, 0.0, steer))
        found = asked if message.form == "plain" else types["geometry_msgs/msg/TwistStamped"](header=head, twist=asked)
        return bytes(store.serialize_cdr(found, _TYPES[message.form]))
    covariance = _zeros()
    pose = types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](x, y, 0.0),
        orientation=types["geometry_msgs/msg/Quaternion"](0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)),
    )
    moved = twist(linear=vector(speed, 0.0, 0.0), angular=vector(0.0, 0.0, 0.0))
    odometry = types[_ODOMETRY](
        header=head,
        child_frame_id="base",
        pose=types["geometry_msgs/msg/PoseWithCovariance"](pose, covariance),
        twist=types["geometry_msgs/msg/TwistWithCovariance"](moved, covariance),
    )
    return bytes(store.serialize_cdr(odometry, _ODOMETRY))


@cache
def _zeros() -> Any:
    import numpy as np

    return np.zeros(36)


def _write_mcap(log: Topics, drive: Drive, path: Path) -> None:
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file, chunk_size=_CHUNK_BYTES)
        writer.start(profile="ros2", library="log-faults")
        channels: dict[tuple[str, str], int] = {}
        for message in log.messages:
            key = (message.topic, _type_of(message))
            if key not in channels:
                schema = writer.register_schema(key[1], "ros2msg", _definition(key[1]).encode())
                channels[key] = writer.register_channel(key[0], "cdr", schema)
            at = round(message.receipt * _SECOND)
            writer.add_message(channels[key], at, _encoded(message, drive), at)
        writer.finish()


def _write_sqlite(log: Topics, drive: Drive, path: Path) -> None:
    with closing(sqlite3.connect(path)) as base:
        base.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)")
        base.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)")
        base.execute(
            "CREATE TABLE message_definitions(topic_type TEXT, encoding TEXT, encoded_message_definition TEXT)"
        )
        numbers: dict[tuple[str, str], int] = {}
        for message in log.messages:
            key = (message.topic, _type_of(message))
            if key not in numbers:
                numbers[key] = len(numbers) + 1
                base.execute("INSERT INTO topics VALUES (?, ?, ?, 'cdr')", (numbers[key], *key))
                base.execute("INSERT INTO message_definitions VALUES (?, 'ros2msg', ?)", (key[1], _definition(key[1])))
            row = (numbers[key], round(message.receipt * _SECOND), _encoded(message, drive))
            base.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", row)
        base.commit()


def _write_ulog(log: Topics, drive: Drive, path: Path) -> None:
    def record(kind: str, content: bytes) -> bytes:
        return struct.pack("<HB", len(content), ord(kind)) + content

    def subscribed(name: str, number: int) -> bytes:
        return record("A", struct.pack("<BH", 0, number) + name.encode())

    parts = [
        b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0),
        record("F", b"pose:uint64_t timestamp;double x;double y;double yaw;double speed;"),
        record("F", b"cmd:uint64_t timestamp;double v;double s;"),
        subscribed("pose", 0),
        subscribed("cmd", 1),
    ]
    command = 1
    for place, message in enumerate(log.messages):
        if place % _SYNC == 0:
            parts.append(record("S", _SYNC_BYTES))
        if place == log.resubscribed:
            command = 2
            parts.append(subscribed("cmd", command))
        at, values = round(message.stamp * 1e6), drive.values[message.row].tolist()
        if message.topic == STATE:
            parts.append(record("D", struct.pack("<HQ4d", 0, at, *values[1:5])))
        else:
            parts.append(record("D", struct.pack("<HQ2d", command, at, *values[5:])))
    path.write_bytes(b"".join(parts))


def write_table(table: Table, path: Path) -> None:
    """Writes the table in the format of the suffix of the path: ``.csv`` or ``.parquet``."""
    if path.suffix == ".parquet":
        import pyarrow
        from pyarrow import parquet

        header = table.header or list(table.cells)
        columns = pyarrow.table(dict(zip(header, table.cells.values(), strict=True)))
        parquet.write_table(columns, path, write_page_checksum=True)
        return
    lines = [*table.before]
    if table.header != []:
        lines.append(table.delimiter.join(table.header or table.cells))
    for row, cells in enumerate(zip(*table.cells.values(), strict=True)):
        if row in table.lines:
            lines.append(table.lines[row])
        lines.append(table.delimiter.join(_cell(cell, table) for cell in cells) + table.tail)
    data = ("\n".join(lines) + "\n").encode(table.encoding)
    path.write_bytes(gzip.compress(data) if table.packed else data)


def _cell(cell: Any, table: Table) -> str:
    if cell is None:
        return ""
    text = repr(cell) if isinstance(cell, float) else str(cell)
    text = text.replace(".", table.decimal) if isinstance(cell, float) else text
    return f'"{text}"' if table.quoted and table.delimiter in text else text
