"""Reads ROS 1 bags of format 2.0 sequentially: without their index, and past damage.

Format (wiki.ros.org/Bags/Format/2.0): a record is a header and data, each after its length. A header consists of
``name=value`` fields, each after its length; ``op`` is the kind of record. Chunks contain connections and messages.
"""

from __future__ import annotations

import bz2
import contextlib
import io
import re
import struct
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import IO

from safedpa.errors import RunError
from safedpa.limits import LimitError, limit, readable, too_much
from safedpa.records.readers.bags.messages import AbstractBag, DeclaredTopic
from safedpa.records.readers.own_process import allow_for
from safedpa.records.run import Finding
from safedpa.ros.definitions import plain_type

__all__ = ["Ros1Bag"]

MAGIC = b"#ROSBAG V2.0\n"
_LENGTH = struct.Struct("<I")
_TIME = struct.Struct("<II")
_INDEX = struct.Struct("<Q")
_MESSAGE, _CHUNK, _CONNECTION = b"\x02", b"\x05", b"\x07"
_USED = (_MESSAGE, _CHUNK, _CONNECTION)
_OPERATION = re.compile(rb"\x04\0\0\0op=[\x02\x05\x07]")
"""The field of a header with the kind of a record."""
_MAX_FIELDS_BYTES = 512
"""Longest header that is looked for after damage; that of a connection has the topic."""
_PIECE_BYTES = 1 << 20
_MAX_DAMAGES = 1000
"""Damaged places after which a file is given up."""
_MAX_HEADER_BYTES = 1 << 20
"""Largest header of a record; long message definitions are in the data of a connection."""


class Ros1Bag(AbstractBag):
    """A ROS 1 bag (``.bag``)."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, "ROS 1 bag")
        self._names: dict[int, str] = {}

    def messages(self, topics: Collection[str] | None) -> Iterator[tuple[str, int, bytes]]:
        """Yields (topic, receipt time in ns, encoded message) in file order, without damaged records.

        Reading continues at the next whole record; the damage is a finding.
        """
        size = self.path.stat().st_size
        if size > limit("bag_bytes"):
            raise too_much("bag_bytes", f"{size} bytes", str(self.path))
        budget, damage, last = max(limit("expansion_free_bytes"), size * limit("expansion")), list[int](), None
        with self.path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise RunError(f"{self.path}: is no ROS 1 bag of format 2.0; 'rosbag fix' converts older ones")
            self._read_connections_at_end(file, size)
            following: int | None = len(MAGIC)
            while following is not None:
                at = file.seek(following)
                try:
                    head = _record(file, size)
                    if head is None:
                        break
                    fields, length = head
                    following = file.tell() + length
                    data = file.read(length) if fields.get(b"op") in _USED else b""
                    if fields.get(b"op") == _CHUNK:
                        data = self._unpack_chunk(fields, data, budget)
                        budget -= len(data)
                        found = self._in_chunk(data, topics, damage, at)
                    else:
                        found = self._in_record(fields, data, topics)
                    for message in found:
                        last = message[1] if not damage else last
                        yield message
                except _DAMAGE:
                    damage.append(at)
                    following = _next_record(file, at, size) if len(damage) < _MAX_DAMAGES else None
        if damage:
            self.findings.append(_damage_finding(damage, following is None, size, last))

    def _in_record(
        self, fields: dict[bytes, bytes], data: bytes, topics: Collection[str] | None
    ) -> Iterator[tuple[str, int, bytes]]:
        operation = fields.get(b"op")
        if operation == _MESSAGE:
            yield from self._message(fields, data, topics)
        elif operation == _CONNECTION:
            self._connection(fields, data)

    def _read_connections_at_end(self, file: IO[bytes], size: int) -> None:
        """Reads the connections that the index at the end lists: those inside a damaged chunk are lost."""
        try:
            file.seek(len(MAGIC))
            head = _record(file, size)
            if head is None:
                return
            file.seek(_INDEX.unpack(head[0][b"index_pos"])[0])
            while (head := _record(file, size)) is not None and head[0].get(b"op") == _CONNECTION:
                self._connection(head[0], file.read(head[1]))
        except _DAMAGE:
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

    def _in_chunk(
        self, data: bytes, topics: Collection[str] | None, damage: list[int], chunk: int
    ) -> Iterator[tuple[str, int, bytes]]:
        """Messages of a chunk, without damaged records: ``damage`` gets the byte of the ``chunk`` for each."""
        at, size = 0, len(data)
        while at < size:
            begin = at
            try:
                (length,) = _LENGTH.unpack_from(data, at)
                body = at + 4 + length
                fields = _fields(data[at + 4 : body])
                (count,) = _LENGTH.unpack_from(data, body)
                at = body + 4 + count
                if at > size or b"op" not in fields:
                    raise _DamageError
                yield from self._in_record(fields, data[body + 4 : at], topics)
            except _DAMAGE:
                following = _next_record(io.BytesIO(data), begin, size)
                if following is None or len(damage) >= _MAX_DAMAGES:
                    raise
                damage.append(chunk)
                at = following

    def _message(
        self, fields: dict[bytes, bytes], data: bytes, topics: Collection[str] | None
    ) -> Iterator[tuple[str, int, bytes]]:
        (number,) = _LENGTH.unpack(fields[b"conn"])
        name = self._names.get(number)
        if name is None:
            raise _DamageError
        if self.is_chosen(name, topics):
            seconds, nanoseconds = _TIME.unpack(fields[b"time"])
            yield name, seconds * 1_000_000_000 + nanoseconds, data

    def _connection(self, fields: dict[bytes, bytes], data: bytes) -> None:
        (number,) = _LENGTH.unpack(fields[b"conn"])
        about = _fields(data)
        name = fields[b"topic"].decode("utf-8", "replace")
        if len(self._names) >= limit("bag_topics") and number not in self._names:
            raise too_much("bag_topics", len(self._names) + 1, str(self.path))
        kind = readable(plain_type(about[b"type"].decode("utf-8", "replace")))
        text = about.get(b"message_definition", b"").decode("utf-8", "replace")
        self._names[number] = self.declare(name, DeclaredTopic(kind, "ros1", text, "ros1msg"))


class _DamageError(Exception):
    pass


_DAMAGE = (_DamageError, struct.error, KeyError, OSError, EOFError, ValueError, RuntimeError)
"""Exceptions that reading damaged bytes can raise."""


def _record(file: IO[bytes], size: int) -> tuple[dict[bytes, bytes], int] | None:
    """Header fields of the next record and the length of its data; None at the end of the file."""
    start = file.read(4)
    if not start:
        return None
    (length,) = _LENGTH.unpack(start)
    if length > _MAX_HEADER_BYTES:
        raise _DamageError
    fields = _fields(file.read(length))
    if not fields:  # a hole of zeros looks like empty records
        raise _DamageError
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


def _next_record(file: IO[bytes], at: int, size: int) -> int | None:
    """Byte at which the next record that is used begins after a damaged one; None if there is none.

    If the damaged record ends before another one, that follows. Else a record is recognised by its field ``op``, and by
    a header in which that field is whole.
    """
    file.seek(at)
    with contextlib.suppress(*_DAMAGE):
        head = _record(file, size)
        if head is not None and head[0].get(b"op") in _USED:
            end = file.seek(head[1], 1)
            if end == size or _is_record(file, end, size):
                return end
    place = at + 1
    while place < size:
        file.seek(place)
        piece = file.read(_PIECE_BYTES)
        for found in _OPERATION.finditer(piece):
            for start in range(max(at + 1, place + found.start() - _MAX_FIELDS_BYTES), place + found.start() - 3):
                if _is_record(file, start, size, place + found.end()):
                    return start
        if len(piece) < _PIECE_BYTES:
            return None
        place += _PIECE_BYTES - _MAX_FIELDS_BYTES
    return None


def _is_record(file: IO[bytes], at: int, size: int, within: int = 0) -> bool:
    """Whether a record begins at a byte, whose header contains the byte before ``within``."""
    file.seek(at)
    start = file.read(4)
    if len(start) < 4 or (within and not within <= at + 4 + _LENGTH.unpack(start)[0] <= within + _MAX_FIELDS_BYTES):
        return False
    file.seek(at)
    try:
        head = _record(file, size)
    except (*_DAMAGE, LimitError):
        return False
    return head is not None and len(head[0].get(b"op", b"")) == 1


def _damage_finding(damage: list[int], is_last: bool, size: int, last: int | None) -> Finding:
    """The finding for damaged records; ``is_last``: nothing follows the last one; ``last``: time before the first."""
    start = None if last is None else last / 1e9
    more = f" and at {len(damage) - 1} later places" if len(damage) > 1 else ""
    if is_last:
        text = f"the bag is cut off or damaged at byte {damage[0]} of {size}{more}; whole records are read"
        return Finding("cut_off", text, start_t=start)
    text = f"the bag is damaged at byte {damage[0]} of {size}{more}; the damaged records are left out"
    return Finding("damaged", text, len(damage), start)
