"""ROS 1 bags, format 2.0, read front to back: so without their index, and up to where they were cut off.

The format (wiki.ros.org/Bags/Format/2.0): records of a header and data, each behind its length; a header holds
``name=value`` fields behind theirs; ``op`` says what a record is. Chunks hold connections and messages, packed or not.
"""

from __future__ import annotations

import bz2
import struct
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import IO

from safedpa.errors import RunError
from safedpa.limits import limit, readable, too_much
from safedpa.records.readers.bags.messages import AbstractBag, DeclaredTopic
from safedpa.records.run import Finding
from safedpa.ros.definitions import plain_type

__all__ = ["Ros1Bag"]

MAGIC = b"#ROSBAG V2.0\n"
_LENGTH = struct.Struct("<I")
_TIME = struct.Struct("<II")
_MESSAGE, _CHUNK, _CONNECTION = 2, 5, 7
_LONGEST_HEADER = 1 << 20
"""Bytes of a record's header; a connection's definition stands in its data."""


class Ros1Bag(AbstractBag):
    """A ``.bag`` of ROS 1."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, "ROS 1 bag")
        self._names: dict[int, str] = {}

    def messages(self, topics: Collection[str] | None) -> Iterator[tuple[str, int, bytes]]:
        """(topic, receipt in ns, encoded message) in the file's order; a damaged end is told and left out."""
        size = self.path.stat().st_size
        if size > limit("bag_bytes"):
            raise too_much("bag_bytes", f"{size} bytes", str(self.path))
        budget = max(limit("expansion_free_bytes"), size * limit("expansion"))
        with self.path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise RunError(f"{self.path}: is no ROS 1 bag of format 2.0; 'rosbag fix' brings older ones up to it")
            while True:
                at = file.tell()
                try:
                    head = _record(file, size)
                    if head is None:
                        return
                    fields, length = head
                    operation = fields[b"op"][0] if fields.get(b"op") else 0
                    if operation == _CHUNK:
                        data = self._opened(fields, file.read(length), budget)
                        budget -= len(data)
                        yield from self._in_chunk(data, topics)
                    elif operation == _MESSAGE:  # of bags without chunks
                        yield from self._message(fields, file.read(length), topics)
                    elif operation == _CONNECTION:
                        self._connection(fields, file.read(length))
                    else:
                        file.seek(length, 1)
                except (_DamageError, struct.error, KeyError, OSError, EOFError, ValueError, RuntimeError):
                    self.findings.append(_damaged(at, size))
                    return

    def _opened(self, fields: dict[bytes, bytes], packed: bytes, budget: int) -> bytes:
        """What a chunk holds, never more than it says, and no more than the file may still become."""
        (reported,) = _LENGTH.unpack(fields[b"size"])
        if max(reported, len(packed)) > limit("bag_chunk_bytes"):
            raise too_much("bag_chunk_bytes", f"{max(reported, len(packed))} bytes", str(self.path))
        if reported > budget:
            raise too_much("expansion", "more", str(self.path))
        how = fields[b"compression"]
        if how == b"none":
            data = packed
        elif how == b"bz2":
            data = bz2.BZ2Decompressor().decompress(packed, reported + 1)
        elif how == b"lz4":
            import lz4.frame  # type: ignore[import-untyped]

            data = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=reported + 1)
        else:
            raise RunError(
                f"{self.path}: chunks are packed by '{readable(how.decode('latin-1'), 20)}'; wanted bz2 or lz4"
            )
        if len(data) != reported:
            raise _DamageError
        return data

    def _in_chunk(self, data: bytes, topics: Collection[str] | None) -> Iterator[tuple[str, int, bytes]]:
        at, size = 0, len(data)
        while at < size:
            (length,) = _LENGTH.unpack_from(data, at)
            body = at + 4 + length
            fields = _fields(data[at + 4 : body])
            (count,) = _LENGTH.unpack_from(data, body)
            at = body + 4 + count
            if at > size:
                raise _DamageError
            operation = fields[b"op"][0]
            if operation == _MESSAGE:
                yield from self._message(fields, data[body + 4 : at], topics)
            elif operation == _CONNECTION:
                self._connection(fields, data[body + 4 : at])

    def _message(
        self, fields: dict[bytes, bytes], data: bytes, topics: Collection[str] | None
    ) -> Iterator[tuple[str, int, bytes]]:
        (number,) = _LENGTH.unpack(fields[b"conn"])
        name = self._names.get(number)
        if name is None:
            raise _DamageError
        if topics is None or name in topics:
            seconds, nanoseconds = _TIME.unpack(fields[b"time"])
            yield name, seconds * 1_000_000_000 + nanoseconds, data

    def _connection(self, fields: dict[bytes, bytes], data: bytes) -> None:
        (number,) = _LENGTH.unpack(fields[b"conn"])
        about = _fields(data)
        name = fields[b"topic"].decode("utf-8", "replace")
        if len(self._names) >= limit("bag_topics") and number not in self._names:
            raise too_much("bag_topics", len(self._names) + 1, str(self.path))
        kind = readable(plain_type(about[b"type"].decode("utf-8", "replace")))
        reported = DeclaredTopic(
            kind, "ros1", about.get(b"message_definition", b"").decode("utf-8", "replace"), "ros1msg"
        )
        before = self.declared.get(name)
        if before is not None and before.type != kind:
            raise RunError(
                f"{self.path}: topic '{readable(name)}' has two types, {before.type} and {kind}; filter the bag first: "
                "rosbag filter IN.bag OUT.bag EXPRESSION"
            )
        self._names[number] = name
        self.declared[name] = reported


class _DamageError(Exception):
    pass


def _record(file: IO[bytes], size: int) -> tuple[dict[bytes, bytes], int] | None:
    """Fields of the next record, and how long its data are; None at the file's end."""
    start = file.read(4)
    if not start:
        return None
    (length,) = _LENGTH.unpack(start)
    if length > _LONGEST_HEADER:
        raise _DamageError
    fields = _fields(file.read(length))
    (count,) = _LENGTH.unpack(file.read(4))  # raises where the header went beyond the end
    if file.tell() + count > size:
        raise _DamageError
    if count > limit("bag_chunk_bytes"):
        raise too_much("bag_chunk_bytes", f"{count} bytes", "a record of the bag")
    return fields, count


def _fields(data: bytes) -> dict[bytes, bytes]:
    fields: dict[bytes, bytes] = {}
    at = 0
    while at < len(data):
        (length,) = _LENGTH.unpack_from(data, at)
        entry = data[at + 4 : at + 4 + length]
        name, found, value = entry.partition(b"=")
        if not found or len(entry) != length:
            raise _DamageError
        fields[name] = value
        at += 4 + length
    return fields


def _damaged(at: int, size: int) -> Finding:
    return Finding(
        "cut_off", f"the bag is cut off or damaged at byte {at} of {size}; read up to there, the rest left out"
    )
