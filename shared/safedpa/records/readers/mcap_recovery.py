"""Records of an MCAP file, each measured before it is opened: the format lets a byte of a chunk become any number."""

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
_MOST_PASSED_OVER = 10_000
"""Records of private kinds in one chunk, and those of them outside of chunks, with what is too short for its kind."""
_SHORTEST, _FIRST_PRIVATE = 6, 0x80
"""Bytes of the shortest record that is passed over (an empty index of messages); opcodes."""
_HEAD = struct.Struct("<BQ")
"""Opcode and length of a record."""
_MESSAGE = struct.Struct("<HIQQ")
"""Channel, number, when it was logged, when it was published."""
_FOOTER = struct.Struct("<BQQQI8s")
"""Opcode 2, length 20, where the summary begins, where its offsets begin, checksum; then the magic again."""


class DamageError(Exception):
    """The file is damaged or cut off from ``offset`` on."""

    def __init__(self, offset: int, size: int) -> None:
        super().__init__(f"damaged at byte {offset} of {size}")
        self.offset, self.size = offset, size


def records_of(path: Path, *, validate: bool = True) -> Iterator[Any]:
    """Records of the file, chunks opened, up to its end.

    Raises RunError where it is no MCAP file, LimitError naming the limit that a record passes, and DamageError where it
    cannot be read further. Memory is bounded by the limits whatever the file says.
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
            except _damages() as error:
                raise DamageError(file.tell(), size) from error
            yield record


def channels_at_end(path: Path) -> list[Any] | None:
    """Channels that the index at the file's end names; None where it has none: not closed, damaged, or no MCAP file."""
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
        except _damages():
            return None


def _damages() -> tuple[type[Exception], ...]:
    """What reading damaged bytes raises."""
    import zstandard
    from mcap.exceptions import McapError

    return McapError, ValueError, struct.error, zstandard.ZstdError, RuntimeError, EOFError


def _records_in(file: IO[bytes], budget: _SizeBudget, *, validate: bool) -> Iterator[Any]:
    """Records behind the magic up to the data's end or the footer. What holds lists without end is passed over:
    indices, statistics, attachments."""
    from mcap.data_stream import ReadDataStream
    from mcap.opcode import Opcode
    from mcap.records import Channel, Chunk, DataEnd, Message, Schema

    stream, most = ReadDataStream(file, calculate_crc=validate), limit("mcap_record_bytes")
    if validate:
        stream._crc = zlib.crc32(_MAGIC)
    passed_over = 0
    while True:
        before = stream.checksum() if validate else 0
        opcode, length = stream.read1(), stream.read8()
        if length > most:
            raise ValueError(f"a record of {length} bytes")
        passed_over += length < _SHORTEST or opcode >= _FIRST_PRIVATE
        if opcode == 0 or passed_over > _MOST_PASSED_OVER:
            raise ValueError("records that no one knows")
        end = stream.count + length
        if opcode == Opcode.FOOTER:
            return
        if opcode == Opcode.CHUNK:
            yield from _opened(Chunk.read(stream), budget, validate=validate)
        elif opcode == Opcode.MESSAGE:
            yield Message.read(stream, length)
        elif opcode == Opcode.CHANNEL:
            budget.one_more_channel()
            yield Channel.read(stream)
        elif opcode == Opcode.SCHEMA:
            yield Schema.read(stream)
        elif opcode == Opcode.DATA_END and validate and DataEnd.read(stream).data_section_crc not in (0, before):
            raise ValueError("the data are not what was written")
        if stream.count < end:
            stream.read(end - stream.count)


@final
class _SizeBudget:
    """How many bytes the chunks of one file may become."""

    def __init__(self, path: Path, size: int) -> None:
        self._path = path
        self._channels = 0
        self._left = max(limit("expansion_free_bytes"), size * limit("expansion"))

    def one_more_channel(self) -> None:
        """Raises LimitError where there are too many."""
        self._channels += 1
        if self._channels > limit("mcap_channels"):
            raise too_much("mcap_channels", self._channels, str(self._path))

    def take(self, reported: int) -> None:
        """Raises LimitError where a chunk, or all of them together, would be too large."""
        if reported > limit("mcap_chunk_bytes"):
            raise too_much("mcap_chunk_bytes", f"{reported} bytes", str(self._path))
        self._left -= reported
        if self._left < 0:
            raise too_much("expansion", "more", str(self._path))


def _opened(chunk: Chunk, budget: _SizeBudget, *, validate: bool) -> Iterator[Any]:
    from mcap.data_stream import ReadDataStream
    from mcap.opcode import Opcode
    from mcap.records import Channel, Message, Schema

    data = _data(chunk, budget)
    if validate and chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise ValueError("the chunk is not what was written")
    at, size, passed_over = 0, len(data), 0
    while at < size:
        opcode, length = _HEAD.unpack_from(data, at)
        begin = at + _HEAD.size
        at = begin + length
        if at > size or opcode == 0 or (opcode == Opcode.MESSAGE and length < _MESSAGE.size):
            raise ValueError("a record is none, or longer than its chunk")
        if opcode == Opcode.MESSAGE:
            number, sequence, logged, published = _MESSAGE.unpack_from(data, begin)
            content = data[begin + _MESSAGE.size : at]
            yield Message(channel_id=number, log_time=logged, data=content, publish_time=published, sequence=sequence)
        elif opcode == Opcode.CHANNEL:
            budget.one_more_channel()
            yield Channel.read(ReadDataStream(io.BytesIO(data[begin:at])))
        elif opcode == Opcode.SCHEMA:
            yield Schema.read(ReadDataStream(io.BytesIO(data[begin:at])))
        else:
            passed_over += 1
            if passed_over > _MOST_PASSED_OVER:
                raise ValueError("a chunk of records that no one knows")


def _data(chunk: Chunk, budget: _SizeBudget) -> bytes:
    """What the chunk holds: never more than it says, and that was measured."""
    reported = chunk.uncompressed_size
    budget.take(max(reported, len(chunk.data)))
    if chunk.compression == "zstd":
        import zstandard

        with zstandard.ZstdDecompressor(max_window_size=limit("mcap_chunk_bytes")).stream_reader(chunk.data) as stream:
            data: bytes = stream.read(reported + 1)
    elif chunk.compression == "lz4":
        import lz4.frame  # type: ignore[import-untyped]

        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=reported + 1)
    elif chunk.compression == "":
        data = chunk.data
    else:
        raise ValueError(f"chunks packed by {chunk.compression!r}")
    if len(data) != reported:
        raise ValueError(f"a chunk holds other than the {reported} bytes that it says")
    return data


@final
class _BoundedReader(io.BufferedReader):
    """A file of which no one reads more at once than a record may have: lengths within a record can be damaged, too."""

    def __init__(self, path: Path) -> None:
        raw: IO[bytes] = io.FileIO(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC))  # a pipe would wait
        super().__init__(raw)  # type: ignore[arg-type]
        self._most = limit("mcap_record_bytes")

    def read(self, size: int | None = -1, /) -> bytes:
        """At most ``size`` bytes; fewer than asked for is an end of the file to anyone who reads a record."""
        return super().read(size if size is None else min(size, self._most))
