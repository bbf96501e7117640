"""Reads the records of an MCAP file up to its first damage, in bounded memory.

Every record is measured before it is unpacked: compression lets one byte of a chunk expand to any size.
"""

from __future__ import annotations

import io
import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, final

from safedpa.errors import RunError
from safedpa.limits import limit, too_much

if TYPE_CHECKING:
    from mcap.records import Chunk

__all__ = ["DamageError", "channels_at_end", "records_of"]

_MAGIC = b"\x89MCAP0\r\n"
_MAX_SKIPPED = 10_000
"""Limit for records of unknown kinds in one chunk, and for unknown or too short ones outside of chunks."""
_MIN_RECORD_BYTES, _FIRST_PRIVATE_OPCODE = 6, 0x80
"""Bytes of the shortest record that is skipped (an empty message index); first opcode of private records."""
_HEAD = struct.Struct("<BQ")
"""Opcode and length of a record."""
_MESSAGE = struct.Struct("<HIQQ")
"""Channel, sequence number, log time, publish time."""
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


def channels_at_end(path: Path) -> list[Any] | None:
    """Channels listed in the index at the end of the file; None without an index (not closed, damaged, no MCAP)."""
    from mcap.records import Channel

    size = path.stat().st_size
    with _BoundedReader(path) as file:
        try:
            file.seek(max(0, size - _FOOTER.size))
            opcode, length, summary, _, _, magic = _FOOTER.unpack(file.read(_FOOTER.size))
            if (opcode, length, magic) != (2, 20, _MAGIC) or not 0 < summary < size:
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


def _records_in(file: IO[bytes], budget: _SizeBudget, *, validate: bool) -> Iterator[Any]:
    """Yields the records after the magic up to the footer.

    Indices, statistics and attachments are skipped: their lists have no limit of their own.
    """
    from mcap.data_stream import ReadDataStream
    from mcap.opcode import Opcode
    from mcap.records import Channel, Chunk, DataEnd, Message, Schema

    stream, most = ReadDataStream(file, calculate_crc=validate), limit("mcap_record_bytes")
    if validate:
        stream._crc = zlib.crc32(_MAGIC)
    skipped = 0
    while True:
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
            yield from _records_in_chunk(Chunk.read(stream), budget, validate=validate)
        elif opcode == Opcode.MESSAGE:
            yield Message.read(stream, length)
        elif opcode == Opcode.CHANNEL:
            budget.count_channel()
            yield Channel.read(stream)
        elif opcode == Opcode.SCHEMA:
            yield Schema.read(stream)
        elif opcode == Opcode.DATA_END and validate and DataEnd.read(stream).data_section_crc not in (0, before):
            raise ValueError("checksum of the data section")
        if stream.count < end:
            stream.read(end - stream.count)


@final
class _SizeBudget:
    """Counts the channels and the unpacked bytes of one file against their limits."""

    def __init__(self, path: Path, size: int) -> None:
        self._path = path
        self._channels = 0
        self._left = max(limit("expansion_free_bytes"), size * limit("expansion"))

    def count_channel(self) -> None:
        """Counts a channel; raises LimitError if there are too many."""
        self._channels += 1
        if self._channels > limit("mcap_channels"):
            raise too_much("mcap_channels", self._channels, str(self._path))

    def take(self, declared: int) -> None:
        """Counts a chunk of ``declared`` bytes; raises LimitError if it, or all chunks together, are too large."""
        if declared > limit("mcap_chunk_bytes"):
            raise too_much("mcap_chunk_bytes", f"{declared} bytes", str(self._path))
        self._left -= declared
        if self._left < 0:
            raise too_much("expansion", "more", str(self._path))


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

        with zstandard.ZstdDecompressor(max_window_size=limit("mcap_chunk_bytes")).stream_reader(chunk.data) as stream:
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
        raw: IO[bytes] = io.FileIO(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC))  # O_NONBLOCK for pipes
        super().__init__(raw)  # type: ignore[arg-type]
        self._most = limit("mcap_record_bytes")

    def read(self, size: int | None = -1, /) -> bytes:
        """Reads at most ``size`` bytes, and no more than the limit; a short read looks like the end of the file."""
        return super().read(size if size is None else min(size, self._most))
