"""Reads ROS 1 bags of format 2.0 sequentially: without their index, and up to a truncation.

Format (wiki.ros.org/Bags/Format/2.0): a record is a header and data, each after its length. A header consists of
``name=value`` fields, each after its length; ``op`` is the kind of record. Chunks contain connections and messages.
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
from safedpa.records.readers.own_process import allow_for
from safedpa.records.run import Finding
from safedpa.ros.definitions import plain_type

__all__ = ["Ros1Bag"]

MAGIC = b"#ROSBAG V2.0\n"
_LENGTH = struct.Struct("<I")
_TIME = struct.Struct("<II")
_MESSAGE, _CHUNK, _CONNECTION = 2, 5, 7
_MAX_HEADER_BYTES = 1 << 20
"""Largest header of a record; long message definitions are in the data of a connection."""


class Ros1Bag(AbstractBag):
    """A ROS 1 bag (``.bag``)."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, "ROS 1 bag")
        self._names: dict[int, str] = {}

    def messages(self, topics: Collection[str] | None) -> Iterator[tuple[str, int, bytes]]:
        """Yields (topic, receipt time in ns, encoded message) in file order; stops at damage, with a finding."""
        size = self.path.stat().st_size
        if size > limit("bag_bytes"):
            raise too_much("bag_bytes", f"{size} bytes", str(self.path))
        budget = max(limit("expansion_free_bytes"), size * limit("expansion"))
        with self.path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise RunError(f"{self.path}: is no ROS 1 bag of format 2.0; 'rosbag fix' converts older ones")
            while True:
                at = file.tell()
                try:
                    head = _record(file, size)
                    if head is None:
                        return
                    fields, length = head
                    operation = fields[b"op"][0] if fields.get(b"op") else 0
                    if operation == _CHUNK:
                        data = self._unpack_chunk(fields, file.read(length), budget)
                        budget -= len(data)
                        yield from self._in_chunk(data, topics)
                    elif operation == _MESSAGE:  # in bags without chunks
                        yield from self._message(fields, file.read(length), topics)
                    elif operation == _CONNECTION:
                        self._connection(fields, file.read(length))
                    else:
                        file.seek(length, 1)
                except (_DamageError, struct.error, KeyError, OSError, EOFError, ValueError, RuntimeError):
                    self.findings.append(_damaged(at, size))
                    return

    def _unpack_chunk(self, fields: dict[bytes, bytes], packed: bytes, budget: int) -> bytes:
        """Unpacks a chunk; never produces more than its declared size, which must fit the remaining ``budget``."""
        (declared_size,) = _LENGTH.unpack(fields[b"size"])
        if max(declared_size, len(packed)) > limit("bag_chunk_bytes"):
            raise too_much("bag_chunk_bytes", f"{max(declared_size, len(packed))} bytes", str(self.path))
        if declared_size > budget:
            raise too_much("expansion", "more", str(self.path))
        allow_for(declared_size)
        how = fields[b"compression"]
        if how == b"none":
            data = packed
        elif how == b"bz2":
            data = bz2.BZ2Decompressor().decompress(packed, declared_size + 1)
        elif how == b"lz4":
            import lz4.frame  # type: ignore[import-untyped]

            data = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=declared_size + 1)
        else:
            raise RunError(
                f"{self.path}: chunks are compressed by '{readable(how.decode('latin-1'), 20)}'; wanted bz2 or lz4"
            )
        if len(data) != declared_size:
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
        declared = DeclaredTopic(
            kind, "ros1", about.get(b"message_definition", b"").decode("utf-8", "replace"), "ros1msg"
        )
        before = self.declared.get(name)
        if before is not None and before.type != kind:
            raise RunError(
                f"{self.path}: topic '{readable(name)}' has two types, {before.type} and {kind}; filter the bag first: "
                "rosbag filter IN.bag OUT.bag EXPRESSION"
            )
        self._names[number] = name
        self.declared[name] = declared


class _DamageError(Exception):
    pass


def _record(file: IO[bytes], size: int) -> tuple[dict[bytes, bytes], int] | None:
    """Header fields of the next record and the length of its data; None at the end of the file."""
    start = file.read(4)
    if not start:
        return None
    (length,) = _LENGTH.unpack(start)
    if length > _MAX_HEADER_BYTES:
        raise _DamageError
    fields = _fields(file.read(length))
    (count,) = _LENGTH.unpack(file.read(4))  # raises struct.error if the header ends beyond the file
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
        "cut_off", f"the bag is cut off or damaged at byte {at} of {size}; read up to there, the rest ignored"
    )
