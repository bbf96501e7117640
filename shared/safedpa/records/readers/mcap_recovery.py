"""Reads the records of an MCAP file up to its first damage, or past it, in bounded memory.

Every record is measured before it is unpacked: compression lets one byte of a chunk expand to any size.
"""

from __future__ import annotations

import io
import os
import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, final

from safedpa.errors import RunError
from safedpa.limits import limit, too_much
from safedpa.records.readers.own_process import allow_for
from safedpa.records.run import Finding

if TYPE_CHECKING:
    from mcap.records import Chunk

__all__ = ["DamageError", "channels_at_end", "damage_finding", "records_of", "undamaged_records"]

_MAGIC = b"\x89MCAP0\r\n"
_READ = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
"""Opens a file; without the second flag a pipe without a writer would block."""
_MAX_SKIPPED = 10_000
"""Limit for records of unknown kinds in one chunk, and for unknown or too short ones outside of chunks."""
_MIN_RECORD_BYTES, _FIRST_PRIVATE_OPCODE = 6, 0x80
"""Bytes of the shortest record that is skipped (an empty message index); first opcode of private records."""
_HEAD = struct.Struct("<BQ")
"""Opcode and length of a record."""
_MESSAGE = struct.Struct("<HIQQ")
"""Channel, sequence number, log time, publish time."""
_RECORD = re.compile(rb"(?=[\x05\x06].{4}\0{4})", re.DOTALL)
"""The head of a message or a chunk: its opcode, and a length below 4 GiB."""
_CHAIN = 4
"""Records that must follow each other for the first to be one."""
_FOOTER_OPCODE, _CHUNK_OPCODE, _LAST_OPCODE = 2, 6, 15
_SHORTEST = {5: _MESSAGE.size, 6: 40}
"""Bytes of the shortest message and chunk."""
_PIECE_BYTES = 1 << 20
_MAX_DAMAGES = 1000
"""Damaged places after which a file is given up."""
_FOOTER = struct.Struct("<BQQQI8s")
"""Opcode 2, length 20, start of the summary, start of its offsets, checksum, magic."""


class DamageError(Exception):
    """The file is damaged or truncated at byte ``offset``."""

    def __init__(self, offset: int, size: int) -> None:
        super().__init__(f"damaged at byte {offset} of {size}")
        self.offset, self.size = offset, size


def records_of(path: Path, *, validate: bool = True) -> Iterator[Any]:
    """Yields the records of the file, with chunks unpacked, up to its end.

    Raises RunError if it is not an MCAP file, LimitError if a record passes a limit, and DamageError at the first
    damage. Memory is bounded by the limits, whatever the file contains.
    """
    size = path.stat().st_size
    with _BoundedReader(path) as file:
        if file.read(len(_MAGIC)) != _MAGIC:
            raise RunError(f"{path}: is no MCAP file; wanted a recording of the bus")
        records = _records_in(file, _SizeBudget(path, size), validate=validate)
        while True:
            try:
                record = next(records)
            except StopIteration:
                return
            except _damage_errors() as error:
                raise DamageError(file.tell(), size) from error
            yield record


def undamaged_records(path: Path, damage: list[DamageError]) -> Iterator[Any]:
    """Yields the records of the file like ``records_of``, and continues behind damage at the next whole chunk.

    The damage is appended to ``damage``. Channels and schemas whose definitions were lost are taken from the summary at
    the end of the file, if there is one.
    """
    size = path.stat().st_size
    with _BoundedReader(path) as file:
        if file.read(len(_MAGIC)) != _MAGIC:
            raise RunError(f"{path}: is no MCAP file; wanted a recording of the bus")
        budget, place = _SizeBudget(path, size), _Place(0)
        for _ in range(_MAX_DAMAGES):
            place.start = file.tell()
            # after damage the checksum of all data cannot fit
            records = _records_in(file, budget, validate=True, whole=not damage, place=place)
            while True:
                try:
                    record = next(records)
                except StopIteration:
                    return
                except _damage_errors():
                    damage.append(DamageError(min(file.tell(), size), size))
                    break
                yield record
            if len(damage) == 1:
                yield from _definitions(file, size, budget)
            following = _next_record(file, place, size)
            if following is None:
                return
            file.seek(following)


def _definitions(file: IO[bytes], size: int, budget: _SizeBudget) -> list[Any]:
    """Schemas and channels in the summary at the end of the file; none without a summary."""
    from mcap.records import Channel, Schema

    try:
        summary = _summary_start(file, size)
        if summary is None:
            return []
        file.seek(summary)
        records = list(_records_in(file, budget, validate=False))
    except _damage_errors():
        return []
    # a channel names its schema, which must be known before
    return [one for kind in (Schema, Channel) for one in records if isinstance(one, kind)]


def _summary_start(file: IO[bytes], size: int) -> int | None:
    """Byte at which the summary begins, as the footer says; None without a footer or a summary."""
    file.seek(max(0, size - _FOOTER.size))
    opcode, length, summary, _, _, magic = _FOOTER.unpack(file.read(_FOOTER.size))
    return summary if (opcode, length, magic) == (2, 20, _MAGIC) and 0 < summary < size else None


def _next_record(file: IO[bytes], place: _Place, size: int) -> int | None:
    """Byte at which the next chunk or message begins after a damaged record at ``place``; None if there is none.

    It is recognised by its opcode, and by the heads of the records that follow it. In a file with chunks only a chunk
    counts: what is left of a damaged one has no checksum.
    """
    file.seek(place.start)
    head = file.read(_HEAD.size)
    at = place.start + 1
    if len(head) == _HEAD.size:
        end: int = place.start + _HEAD.size + _HEAD.unpack(head)[1]
        if end < size and _continues(file, end, size):
            return end
    while at < size:
        file.seek(at)
        piece = file.read(_PIECE_BYTES)
        for found in _RECORD.finditer(piece):
            if place.chunked and piece[found.start()] != _CHUNK_OPCODE:
                continue
            if _continues(file, at + found.start(), size):
                return at + found.start()
        if len(piece) < _PIECE_BYTES:
            return None
        at += _PIECE_BYTES - _HEAD.size
    return None


def _continues(file: IO[bytes], at: int, size: int) -> bool:
    """Whether ``_CHAIN`` records follow each other from ``at`` on, or up to the end of the file."""
    most = limit("mcap_record_bytes")
    for number in range(_CHAIN):
        file.seek(at)
        head = file.read(_HEAD.size)
        if len(head) < _HEAD.size:
            return number > 1
        opcode, length = _HEAD.unpack(head)
        if not 0 < opcode <= _LAST_OPCODE or length > most or length < _SHORTEST.get(opcode, 0):
            return False
        if opcode == _FOOTER_OPCODE:
            return True
        at += _HEAD.size + length
        if at > size:
            return number > 1  # the file is cut off as well
    return True


def damage_finding(damage: list[DamageError], what: str, last: int | None) -> Finding:
    """The finding for damage, and where reading could not continue; ``last`` is the time [ns] of the message before."""
    start = None if last is None else last * 1e-9
    first = damage[0]
    if len(damage) == 1 and first.offset >= first.size:
        text = f"the {what} was not closed: it is cut off at byte {first.size} and has no index; read up to there"
        return Finding("cut_off", text, start_t=start)
    places = f"{len(damage)} places, first" if len(damage) > 1 else "one place,"
    text = f"the {what} is damaged at {places} at byte {first.offset} of {first.size}; the damaged chunks are left out"
    return Finding("damaged", text, len(damage), start)


def channels_at_end(path: Path) -> list[Any] | None:
    """Channels listed in the index at the end of the file; None without an index (not closed, damaged, no MCAP)."""
    from mcap.records import Channel

    size = path.stat().st_size
    with _BoundedReader(path) as file:
        try:
            summary = _summary_start(file, size)
            if summary is None:
                return None
            file.seek(summary)
            records = _records_in(file, _SizeBudget(path, size), validate=False)
            return [record for record in records if isinstance(record, Channel)] or None
        except _damage_errors():
            return None


def _damage_errors() -> tuple[type[Exception], ...]:
    """Exceptions that reading damaged bytes can raise."""
    import zstandard
    from mcap.exceptions import McapError

    return McapError, ValueError, struct.error, zstandard.ZstdError, RuntimeError, EOFError


@dataclass
class _Place:
    """The byte at which the record that is being read begins, and whether a chunk was read before."""

    start: int
    chunked: bool = False


def _records_in(
    file: IO[bytes], budget: _SizeBudget, *, validate: bool, whole: bool = True, place: _Place | None = None
) -> Iterator[Any]:
    """Yields the records up to the footer; ``whole``: from the magic on, so that the checksum of all data is known.

    Indices, statistics and attachments are skipped: their lists have no limit of their own.
    """
    from mcap.data_stream import ReadDataStream
    from mcap.opcode import Opcode
    from mcap.records import Channel, Chunk, DataEnd, Message, Schema

    stream, most = ReadDataStream(file, calculate_crc=validate), limit("mcap_record_bytes")
    if validate:
        stream._crc = zlib.crc32(_MAGIC)
    skipped, checked = 0, validate and whole
    place = place or _Place(0)
    begin = file.tell()
    while True:
        place.start = begin + stream.count
        before = stream.checksum() if validate else 0
        opcode, length = stream.read1(), stream.read8()
        if length > most:
            raise ValueError(f"a record of {length} bytes")
        skipped += length < _MIN_RECORD_BYTES or opcode >= _FIRST_PRIVATE_OPCODE
        if opcode == 0 or skipped > _MAX_SKIPPED:
            raise ValueError("unknown records")
        end = stream.count + length
        if opcode == Opcode.FOOTER:
            return
        if opcode == Opcode.CHUNK:
            place.chunked = True
            yield from _records_in_chunk(Chunk.read(stream), budget, validate=validate)
        elif opcode == Opcode.MESSAGE:
            yield Message.read(stream, length)
        elif opcode == Opcode.CHANNEL:
            budget.count_channel()
            yield Channel.read(stream)
        elif opcode == Opcode.SCHEMA:
            yield Schema.read(stream)
        elif opcode == Opcode.DATA_END and checked and DataEnd.read(stream).data_section_crc not in (0, before):
            raise ValueError("checksum of the data section")
        if stream.count < end:
            stream.read(end - stream.count)
            if file.tell() < begin + end:
                raise ValueError("the file ends within a record")


_NO_CHUNK = 1 << 40
"""Bytes that no chunk of a recording has."""


@final
class _SizeBudget:
    """Counts the channels and the unpacked bytes of one file against their limits."""

    def __init__(self, path: Path, size: int) -> None:
        self._path = path
        self._channels = 0
        self._left = max(limit("expansion_free_bytes"), size * limit("expansion"))
        self.chunk_bytes = limit("mcap_chunk_bytes")
        """Limit of an unpacked chunk, looked up once."""

    def count_channel(self) -> None:
        """Counts a channel; raises LimitError if there are too many."""
        self._channels += 1
        if self._channels > limit("mcap_channels"):
            raise too_much("mcap_channels", self._channels, str(self._path))

    def take(self, declared: int) -> None:
        """Counts a chunk of ``declared`` bytes; raises LimitError if it, or all chunks together, are too large.

        Raises ValueError for a length that no chunk has: it is damaged.
        """
        if declared > max(_NO_CHUNK, self.chunk_bytes):
            raise ValueError(f"a chunk of {declared} bytes")
        if declared > self.chunk_bytes:
            raise too_much("mcap_chunk_bytes", f"{declared} bytes", str(self._path))
        self._left -= declared
        if self._left < 0:
            raise too_much("expansion", "more", str(self._path))
        allow_for(declared)


def _records_in_chunk(chunk: Chunk, budget: _SizeBudget, *, validate: bool) -> Iterator[Any]:
    from mcap.data_stream import ReadDataStream
    from mcap.opcode import Opcode
    from mcap.records import Channel, Message, Schema

    data = _unpack(chunk, budget)
    if validate and chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise ValueError("checksum of a chunk")
    at, size, skipped = 0, len(data), 0
    while at < size:
        opcode, length = _HEAD.unpack_from(data, at)
        begin = at + _HEAD.size
        at = begin + length
        if at > size or opcode == 0 or (opcode == Opcode.MESSAGE and length < _MESSAGE.size):
            raise ValueError("a record is invalid or longer than its chunk")
        if opcode == Opcode.MESSAGE:
            number, sequence, logged, published = _MESSAGE.unpack_from(data, begin)
            content = data[begin + _MESSAGE.size : at]
            yield Message(channel_id=number, log_time=logged, data=content, publish_time=published, sequence=sequence)
        elif opcode == Opcode.CHANNEL:
            budget.count_channel()
            yield Channel.read(ReadDataStream(io.BytesIO(data[begin:at])))
        elif opcode == Opcode.SCHEMA:
            yield Schema.read(ReadDataStream(io.BytesIO(data[begin:at])))
        else:
            skipped += 1
            if skipped > _MAX_SKIPPED:
                raise ValueError("unknown records in a chunk")


def _unpack(chunk: Chunk, budget: _SizeBudget) -> bytes:
    """Unpacks a chunk; never produces more than its declared size, which is checked first."""
    declared = chunk.uncompressed_size
    budget.take(max(declared, len(chunk.data)))
    if chunk.compression == "zstd":
        import zstandard

        with zstandard.ZstdDecompressor(max_window_size=budget.chunk_bytes).stream_reader(chunk.data) as stream:
            data: bytes = stream.read(declared + 1)
    elif chunk.compression == "lz4":
        import lz4.frame  # type: ignore[import-untyped]

        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=declared + 1)
    elif chunk.compression == "":
        data = chunk.data
    else:
        raise ValueError(f"compression {chunk.compression!r}")
    if len(data) != declared:
        raise ValueError(f"a chunk does not have its declared {declared} bytes")
    return data


@final
class _BoundedReader(io.BufferedReader):
    """A file whose reads are bounded by the record limit: lengths inside a damaged record can be arbitrary."""

    def __init__(self, path: Path) -> None:
        raw: IO[bytes] = io.FileIO(os.open(path, _READ))
        super().__init__(raw)  # type: ignore[arg-type]
        self._most = limit("mcap_record_bytes")

    def read(self, size: int | None = -1, /) -> bytes:
        """Reads at most ``size`` bytes, and no more than the limit; a short read looks like the end of the file."""
        return super().read(size if size is None else min(size, self._most))
