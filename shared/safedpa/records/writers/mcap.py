"""Records bus messages to an MCAP file that stays readable after a kill, a power cut or a full disk.

Each channel has the JSON Schema of its message, for MCAP tools that do not know this project.
"""

from __future__ import annotations

import ast
import contextlib
import errno
import inspect
import json
import os
from dataclasses import MISSING, fields
from functools import cache
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, BinaryIO, final

from safedpa.bus.messages import messages
from safedpa.bus.messages.messages import Message
from safedpa.bus.messages.topics import topic_of
from safedpa.errors import RecordingError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from mcap.writer import Writer

__all__ = ["McapRecorder", "schema_of"]

_CHUNK_BYTES = 64 * 1024
"""About half a second of three robots. A chunk ends after half a second anyway, so that a kill loses less than a
second; smaller chunks only add indexes."""
_FLUSH_NANOSECONDS = 500_000_000
_INDEXES = "_Writer__chunk_indices"
"""Attribute of the library's writer with the index of each chunk, which it keeps until the end: 50 MB for an hour of
three robots. It has no option for that."""


@final
class McapRecorder:
    """Writes one MCAP file with a channel per key; messages are msgpack as on the bus.

    Messages older than 0.5 s (by log time) are in the file after each ``write``; ``flush`` writes the rest. ``sync``
    waits for the disk: the first ``acknowledged`` messages then survive a power cut. When the disk is full, the file is
    truncated to its last complete record and stays readable; every later call but ``close`` raises RecordingError.
    An existing file is never overwritten: ``path`` then ends in -2, -3, ... ``about`` is stored as the metadata record
    ``safedpa``.
    """

    def __init__(self, path: str | Path, about: Mapping[str, str] | None = None) -> None:
        from mcap.writer import Writer

        self.path = _free_path(Path(path))
        self._schemas: dict[type[Message], int] = {}
        self._channels: dict[str, int] = {}
        self._sequences: dict[int, int] = {}
        self._last_flush_ns: int | None = None
        self._newest_ns: int | None = None
        self._failure = ""
        self.written = 0
        """Number of messages written so far."""
        self.acknowledged = 0
        """Number of messages, from the first, that are known to be on the disk."""
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = _WholeRecordFile(self.path.open("wb", buffering=0))
            _sync_folder(self.path.parent)
        except OSError as error:
            raise RecordingError(
                f"{self.path}: cannot be written ({error.strerror}); choose another folder for the recording"
            ) from error
        self._writer: Writer | None = Writer(self._file, chunk_size=_CHUNK_BYTES)
        if hasattr(self._writer, _INDEXES):  # another release of the library may name it otherwise
            setattr(self._writer, _INDEXES, _PackedIndexes())
        self._attempt(lambda writer: (writer.start(profile="safedpa"), writer.flush()))
        if about:
            self._attempt(lambda writer: (writer.add_metadata("safedpa", dict(about)), writer.flush()))

    def write(self, key: str, payload: bytes, log_time_ns: int, publish_time_ns: int) -> None:
        """Adds one encoded message; times are in nanoseconds since 1970.

        Raises RecordingError if the file cannot grow, and InputError if the key is not one of this project.
        """
        if key not in self._channels:
            self._register(key)
        channel = self._channels[key]
        sequence = self._sequences[channel] = self._sequences[channel] + 1
        self._attempt(
            lambda writer: writer.add_message(
                channel, max(log_time_ns, 0), payload, max(publish_time_ns, 0), sequence=sequence
            )
        )
        self.written += 1
        self._newest_ns = log_time_ns
        if self._last_flush_ns is None:
            self._last_flush_ns = log_time_ns
        elif log_time_ns - self._last_flush_ns >= _FLUSH_NANOSECONDS:
            self.flush()

    def flush(self) -> None:
        """Writes the present chunk to the operating system. Raises RecordingError."""
        self._last_flush_ns = self._newest_ns
        self._attempt(lambda writer: writer.flush())

    def sync(self) -> None:
        """Flushes, and waits until everything is on the disk and acknowledged. Raises RecordingError."""
        self._last_flush_ns = self._newest_ns
        self._attempt(lambda writer: self._file.sync(after=writer.flush))
        self.acknowledged = self.written

    def close(self) -> None:
        """Writes the index, closes and syncs the file; does nothing after a failure. Raises RecordingError."""
        if self._writer is not None and not self._failure:
            try:
                self._attempt(lambda writer: self._file.sync(after=writer.finish))
                self.acknowledged = self.written
            finally:
                self._writer = None
                self._file.close()
        self._writer = None

    def _register(self, key: str) -> None:
        kind = topic_of(key)[2].message
        if kind not in self._schemas:
            name, text = f"safedpa.{kind.__name__}", schema_of(kind)
            self._attempt(lambda writer: self._schemas.update({kind: writer.register_schema(name, "jsonschema", text)}))
        schema, metadata = self._schemas[kind], {"message": kind.__name__}
        self._attempt(
            lambda writer: self._channels.update(
                {key: writer.register_channel(key, "msgpack", schema, metadata=metadata)}
            )
        )
        self._sequences[self._channels[key]] = 0

    def _attempt(self, work: Callable[[Writer], object]) -> None:
        if self._failure:
            raise RecordingError(self._failure)
        if self._writer is None:
            raise RecordingError(f"{self.path}: the recording is closed; open a new one")
        try:
            work(self._writer)
        except OSError as error:
            self._failure = (
                f"{self.path}: the recording stopped after {self._file.whole_bytes} bytes ({error.strerror}); what was "
                "written before is readable; free space or choose another folder, then record again"
            )
            self._file.cut_back()
            self._file.close()
            raise RecordingError(self._failure) from error

    def __enter__(self) -> McapRecorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


@final
class _WholeRecordFile:
    """An unbuffered file that knows the length of its complete records.

    The MCAP writer passes complete records to each ``write``, so a kill leaves complete records behind.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.whole_bytes = 0

    def write(self, data: bytes) -> int:
        rest = memoryview(data)
        while rest:
            rest = rest[self._file.write(rest) :]
        self.whole_bytes += len(data)
        return len(data)

    def tell(self) -> int:
        return self.whole_bytes

    def flush(self) -> None:
        """Does nothing: the file is unbuffered."""

    def sync(self, after: Callable[[], None]) -> None:
        """Calls ``after``, then waits until everything written is on the disk (not for a pipe, which cannot sync)."""
        after()
        try:
            os.fsync(self._file.fileno())
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.EROFS, errno.ENOTSUP):
                raise

    def cut_back(self) -> None:
        """Truncates the file to its last complete record."""
        with contextlib.suppress(OSError):  # a device cannot be truncated
            os.ftruncate(self._file.fileno(), self.whole_bytes)

    def close(self) -> None:
        self._file.close()


@final
class _PackedIndexes:
    """A list of records that keeps their bytes, in place of objects that take ten times the memory."""

    def __init__(self) -> None:
        self._records = bytearray()

    def append(self, index: Any) -> None:
        from mcap.data_stream import RecordBuilder

        builder = RecordBuilder()
        index.write(builder)
        self._records += builder.end()

    def __iter__(self) -> Iterator[_PackedIndexes]:
        yield self

    def write(self, builder: Any) -> None:
        """Writes all records."""
        builder.write(bytes(self._records))


def _sync_folder(folder: Path) -> None:
    """Syncs the folder entry too: otherwise a power cut could leave the content without a file name."""
    number = os.open(folder, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):  # not every file system supports it
            os.fsync(number)
    finally:
        os.close(number)


def _free_path(path: Path) -> Path:
    free, number = path, 1
    while free.is_file() and free.stat().st_size:
        number += 1
        free = path.with_name(f"{path.stem}-{number}{path.suffix}")
    return free


_NUMBER = {"type": "number"}
_VECTOR = {"type": "array", "items": _NUMBER}
_TYPES: dict[str, dict[str, Any]] = {
    "Count": {"type": "integer", "minimum": 0},
    "Number": _NUMBER,
    "Positive": {"type": "number", "exclusiveMinimum": 0},
    "bool": {"type": "boolean"},
    "str": {"type": "string"},
    "Vector": _VECTOR,
    "Rows": {"type": "array", "items": _VECTOR},
    "tuple[str, ...]": {"type": "array", "items": {"type": "string"}},
}
_ENTRY = {item.name: _TYPES[str(item.type)] for item in fields(messages.RosterEntry)}
_TYPES["tuple[RosterEntry, ...]"] = {"type": "array", "items": {"type": "object", "properties": _ENTRY}}


def schema_of(kind: type[Message]) -> bytes:
    """Returns the JSON Schema of a message; the description of a field is the docstring below it."""
    meanings = {name: text for owner in reversed(kind.__mro__) for name, text in _field_texts().get(owner.__name__, ())}
    properties = {
        item.name: {**_TYPES[str(item.type)], **({"description": meanings[item.name]} if item.name in meanings else {})}
        for item in fields(kind)
    }
    table = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": kind.__name__,
        "description": inspect.cleandoc(kind.__doc__ or ""),
        "type": "object",
        "properties": properties,
        "required": [item.name for item in fields(kind) if item.default is MISSING],
    }
    return json.dumps(table).encode()


@cache
def _field_texts() -> dict[str, tuple[tuple[str, str], ...]]:
    """(field, description) pairs by message, from the source of the messages; empty if there is no source."""
    try:
        tree = ast.parse(inspect.getsource(messages))
    except OSError:
        return {}
    classes = (node for node in tree.body if isinstance(node, ast.ClassDef))
    return {node.name: tuple(_descriptions_in_class(node.body)) for node in classes}


def _descriptions_in_class(body: list[ast.stmt]) -> list[tuple[str, str]]:
    found = []
    for node, following in pairwise(body):
        if not (isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)):
            continue
        if isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant):
            found.append((node.target.id, " ".join(str(following.value.value).split())))
    return found
