"""Reads rosbag2 recordings: SQLite files, MCAP files, and folders of them, compressed or not.

A SQLite file (``.db3``) is treated as hostile: it is opened read-only, its tables must not be views, the size of a row
is limited, and functions in its schema are not run. MCAP files with ROS messages are also written by other recorders.
"""

from __future__ import annotations

import json
import re
import shutil
import sqlite3
import tempfile
from collections.abc import Collection, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from safedpa.errors import RunError
from safedpa.extras import need
from safedpa.limits import limit, readable, text_of_file, too_much
from safedpa.records.readers.bags.messages import AbstractBag, DeclaredTopic
from safedpa.records.readers.mcap_recovery import (
    DamageError,
    channels_at_end,
    damage_finding,
    undamaged_records,
)
from safedpa.records.readers.own_process import allow_for
from safedpa.records.run import Finding
from safedpa.ros.definitions import plain_type

__all__ = [
    "FolderBag",
    "McapBag",
    "PackedBag",
    "SqliteBag",
    "check_readable_mcap",
    "is_bag_folder",
    "is_recording_of_the_bus",
    "open_bag_file",
]

MAGIC = b"SQLite format 3\0"
_MAX_TRIES = 200
"""Tries to find the next whole row after damage."""
_UNSAFE_SIZE = "it is damaged or malicious; sqlite3 FILE.db3 .recover restores what is left"
_TABLES = {"topics": {"id", "name", "type", "serialization_format"}, "messages": {"topic_id", "timestamp", "data"}}
_DEFINITIONS = "message_definitions"
"""A further table, which bags have since ROS 2 Iron."""


class SqliteBag(AbstractBag):
    """A rosbag2 file in SQLite (``.db3``)."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, "rosbag2 in SQLite")

    def messages(self, topics: Collection[str] | None) -> Iterator[tuple[str, int, bytes]]:
        """Yields (topic, receipt time in ns, encoded message) in file order; stops at damage, with a finding."""
        size = self.path.stat().st_size
        if size > limit("bag_bytes"):
            raise too_much("bag_bytes", f"{size} bytes", str(self.path))
        try:
            with self._closed() as path, closing(self._connect(path)) as base:
                self._check(base)
                numbers = self._declare(base)
                chosen = {number: name for number, name in numbers.items() if self.is_chosen(name, topics)}
                yield from self._rows(base, chosen, every=topics is None)
        except (sqlite3.Error, UnicodeDecodeError) as error:  # the message may quote bytes that are not text
            raise RunError(
                f"{self.path}: cannot be read as SQLite ({readable(str(error), 100)}); if it was cut off, "
                "sqlite3 FILE.db3 .recover brings back what is left"
            ) from error

    @contextmanager
    def _closed(self) -> Iterator[Path]:
        """Yields the file; if messages are only in its write-ahead log, a copy that takes them in.

        SQLite reads a write-ahead log only where it may write, and an input is never written.
        """
        log = self.path.with_name(f"{self.path.name}-wal")
        if not log.is_file() or not log.stat().st_size:
            yield self.path
            return
        if log.stat().st_size > limit("bag_bytes"):
            raise too_much("bag_bytes", f"{log.stat().st_size} bytes", str(log))
        sentence = f"the bag was not closed: messages in {log.name} are read as well; some of the last may be missing"
        self.findings.append(Finding("cut_off", sentence))
        with tempfile.TemporaryDirectory(prefix="safedpa-bag-") as folder:
            copy = Path(folder) / "bag.db3"
            shutil.copyfile(self.path, copy)
            shutil.copyfile(log, f"{copy}-wal")
            with closing(sqlite3.connect(copy)) as base:
                base.execute("PRAGMA trusted_schema = OFF")
                base.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
                base.execute("PRAGMA journal_mode = DELETE").fetchall()
            yield copy

    def _connect(self, path: Path) -> sqlite3.Connection:
        from urllib.parse import quote

        base = sqlite3.connect(f"file:{quote(str(path.resolve()))}?mode=ro&immutable=1", uri=True)
        base.text_factory = lambda text: text.decode("utf-8", "replace")
        base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, limit("bag_message_bytes"))
        base.setlimit(sqlite3.SQLITE_LIMIT_ATTACHED, 0)
        base.execute("PRAGMA trusted_schema = OFF")
        base.execute("PRAGMA cell_size_check = ON")
        base.execute("PRAGMA temp_store = MEMORY")  # sorting must not fill the disk
        return base

    def _check(self, base: sqlite3.Connection) -> None:
        """Raises RunError if the database is not a bag."""
        columns = self._columns(base)
        for table, wanted in _TABLES.items():
            if not wanted <= columns.get(table, set()):
                raise RunError(f"{self.path}: is a SQLite database, but no rosbag2: it has no such table '{table}'")

    def _columns(self, base: sqlite3.Connection) -> dict[str, set[str]]:
        """Columns of each table of a bag. Raises RunError for a view or virtual table, which can have endless rows."""
        names = (*_TABLES, _DEFINITIONS)
        entries = base.execute(f"SELECT name, type, rootpage FROM sqlite_master WHERE name IN {names}").fetchmany(10)
        for name, kind, page in entries:
            if kind != "table" or not page:  # a virtual table has no page
                raise RunError(f"{self.path}: is a SQLite database, but no rosbag2: its '{name}' is no plain table")
        return {name: {row[1] for row in base.execute(f"PRAGMA table_info({name})")} for name, _, _ in entries}

    def _declare(self, base: sqlite3.Connection) -> dict[int, str]:
        texts: dict[str, tuple[str, str]] = {}
        if {"topic_type", "encoding", "encoded_message_definition"} <= self._columns(base).get(_DEFINITIONS, set()):
            asked = f"SELECT topic_type, encoding, encoded_message_definition FROM {_DEFINITIONS}"
            for kind, form, text in base.execute(asked).fetchmany(limit("bag_topics")):
                if form in ("ros2msg", "ros2idl"):
                    texts[str(kind)] = (str(text), str(form))
        rows = base.execute("SELECT id, name, type, serialization_format FROM topics").fetchmany(
            limit("bag_topics") + 1
        )
        if len(rows) > limit("bag_topics"):
            raise too_much("bag_topics", len(rows), str(self.path))
        names = {}
        for number, name, kind, encoding in rows:
            text, form = texts.get(str(kind), ("", ""))
            declared = DeclaredTopic(readable(plain_type(str(kind))), str(encoding), text, form)
            key = self.declare(str(name), declared)
            if isinstance(number, int):
                names[number] = key
        return names

    def _rows(
        self, base: sqlite3.Connection, chosen: dict[int, str], *, every: bool
    ) -> Iterator[tuple[str, int, bytes]]:
        data = "x''" if every else "data"  # without a selection messages are only counted
        marks = ",".join("?" * len(chosen)) if len(chosen) <= 500 else ""
        where = f" AND topic_id IN ({marks})" if marks and not every else ""
        query = f"SELECT rowid, topic_id, timestamp, {data} FROM messages WHERE rowid > ?{where} ORDER BY rowid"
        selection = tuple(chosen) if where else ()
        left = max(limit("expansion_free_bytes"), self.path.stat().st_size)  # corrupt rows may share bytes
        last, skip, reason, start, previous = -1, 0, "", None, None
        for _ in range(_MAX_TRIES):
            try:
                for row, number, at, content in base.execute(query, (last + skip, *selection)):
                    if row <= last:  # zeros in a page are rows of number 0
                        reason = reason or "rows without a number"
                        start = previous if start is None else start
                        continue
                    if skip and start is None:
                        start = at
                    last, skip, previous = row, 0, at
                    if number in chosen and isinstance(at, int) and isinstance(content, bytes):
                        left -= len(content)
                        if left < 0:
                            raise RunError(f"{self.path}: its messages are larger than the file; {_UNSAFE_SIZE}")
                        yield chosen[number], at, content
                break
            except (sqlite3.DatabaseError, UnicodeDecodeError) as error:
                reason = reason or readable(str(error), 60)
                skip += 1 + skip // 8  # rows of a damaged page; the next whole one is looked for
        if reason:
            near = start / 1e9 if isinstance(start, int) else None
            sentence = f"the bag is damaged ({reason}); what can be read before and after the damage is read"
            self.findings.append(Finding("damaged", sentence, start_t=near))


class McapBag(AbstractBag):
    """An MCAP file whose channels contain CDR or ROS 1 messages."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, "MCAP file")
        self._last: int | None = None
        """Time of receipt of the last message that was read [ns]."""

    def messages(self, topics: Collection[str] | None) -> Iterator[tuple[str, int, bytes]]:
        """Yields (topic, receipt time in ns, encoded message) in file order; stops at damage, with a finding."""
        from mcap.records import Channel, Message, Schema

        size = self.path.stat().st_size
        if size > limit("bag_bytes"):
            raise too_much("bag_bytes", f"{size} bytes", str(self.path))
        schemas: dict[int, tuple[str, str, bytes]] = {}
        chosen: dict[int, str] = {}
        damage: list[DamageError] = []
        seen, before = 0, None
        for record in undamaged_records(self.path, damage):
            if len(damage) > seen:
                seen, before = len(damage), before or self._last
            if isinstance(record, Message):
                self._last = record.log_time
                name = chosen.get(record.channel_id)
                if name is not None:
                    yield name, record.log_time, record.data
            elif isinstance(record, Schema):
                schemas[record.id] = (record.name, record.encoding, record.data)
            elif isinstance(record, Channel):
                kind, form, text = schemas.get(record.schema_id, ("", "", b""))
                declared = (kind, record.message_encoding, text.decode("utf-8", "replace"), form)
                name = self.declare(record.topic, DeclaredTopic(readable(plain_type(declared[0])), *declared[1:]))
                if self.is_chosen(name, topics):
                    chosen[record.id] = name
        if damage:
            self.findings.append(damage_finding(damage, "bag", before or self._last))


def is_recording_of_the_bus(path: Path) -> bool:
    """Whether an MCAP file is a recording of the bus; also True if it is unreadable: the bus reader reports why."""
    from mcap.records import Channel

    from safedpa.records.readers.table import require_file

    require_file(path)
    channels = channels_at_end(path)
    if channels is None:
        records = undamaged_records(path, [])
        channels = list(islice((record for record in records if isinstance(record, Channel)), 1))
    return not channels or any(channel.message_encoding == "msgpack" for channel in channels)


def check_readable_mcap(path: Path) -> None:
    """Raises RunError that says where an MCAP file is damaged or cut off if nothing in it can be read."""
    damage: list[DamageError] = []
    if any(True for _ in undamaged_records(path, damage)) or not damage:
        return
    first = damage[0]
    what = f"cut off after {first.size} bytes" if first.offset >= first.size else f"damaged at byte {first.offset}"
    raise RunError(f"{path}: is an MCAP file that is {what}; nothing can be read; copy it again, or name another log")


_SUFFIXES = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")
_MAX_FILES = 10_000
_KEY = re.compile(r"( +)([a-z_]+):[ \t]*(.*)")
_DIGITS = re.compile(r"([0-9]+)")
_ITEM = re.compile(r" +- (.*)")


def is_bag_folder(path: Path) -> bool:
    """Whether a folder contains a bag: its metadata or its files."""
    return path.is_dir() and bool((path / "metadata.yaml").is_file() or _files_in(path))


def _files_in(folder: Path) -> list[Path]:
    """The files of a bag in the order of their numbers: bag_2 before bag_10."""
    files = [item for item in folder.iterdir() if item.name.endswith(_SUFFIXES) and item.is_file()]
    return sorted(files, key=lambda file: [int(part) if part.isdigit() else part for part in _DIGITS.split(file.name)])


class FolderBag(AbstractBag):
    """All files of a folder as one bag; metadata.yaml gives the order of the files but not their content."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, "rosbag2 folder")
        about = _metadata(path)
        self._files = list(dict.fromkeys(path / Path(name).name for name in about.files))
        present = [file for file in self._files if file.is_file()]
        if len(present) < len(self._files):
            lost = [file.name for file in self._files if not file.is_file()]
            self.findings.append(
                Finding(
                    "cut_off",
                    f"{len(lost)} of the bag's {len(self._files)} files are missing ({readable(lost[0])}); "
                    "the others are read",
                )
            )
        self._files = present or _files_in(path)
        if not self._files:
            raise RunError(f"{path}: metadata.yaml names no existing file; wanted .mcap or .db3 files next to it")
        self._packed_messages = about.mode.upper() == "MESSAGE"
        if self._packed_messages and about.format != "zstd":
            raise RunError(
                f"{path}: messages are compressed by '{readable(about.format)}'; wanted zstd; use ros2 bag convert"
            )

    def messages(self, topics: Collection[str] | None) -> Iterator[tuple[str, int, bytes]]:
        """Yields (topic, receipt time in ns, encoded message), file by file."""
        for file in self._files:
            bag = open_bag_file(file)
            bag.declared = self.declared
            for name, at, data in bag.messages(topics):
                yield name, at, _unpack_message(data) if self._packed_messages and data else data
            self.findings += bag.findings


class PackedBag(AbstractBag):
    """A file of a bag that was compressed as a whole by zstd."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, "packed rosbag2")

    def messages(self, topics: Collection[str] | None) -> Iterator[tuple[str, int, bytes]]:
        """Yields (topic, receipt time in ns, encoded message) of the file, which is unpacked to a temporary folder."""
        with tempfile.TemporaryDirectory(prefix="safedpa-bag-") as folder:
            file = Path(folder) / self.path.name.removesuffix(".zstd")
            self._unpack(file)
            bag = open_bag_file(file)
            bag.declared = self.declared
            try:
                yield from bag.messages(topics)
            except RunError as error:
                raise RunError(str(error).replace(str(file), str(self.path))) from error
            self.findings += bag.findings

    def _unpack(self, to: Path) -> None:
        import zstandard

        left = max(limit("expansion_free_bytes"), self.path.stat().st_size * limit("expansion"))
        try:
            unpacker = zstandard.ZstdDecompressor(max_window_size=limit("bag_chunk_bytes"))
            with self.path.open("rb") as packed, to.open("wb") as out, unpacker.stream_reader(packed) as stream:
                while piece := stream.read(1 << 20):
                    left -= len(piece)
                    if left < 0:
                        raise too_much("expansion", "more", str(self.path))
                    allow_for(len(piece))
                    out.write(piece)
        except zstandard.ZstdError as error:
            raise RunError(f"{self.path}: cannot be unpacked ({str(error)[:80]}); wanted a zstd file") from error


def open_bag_file(file: Path) -> AbstractBag:
    """Opens the bag in one file, by its suffix."""
    if file.name.endswith(".zstd"):
        return PackedBag(file)
    return SqliteBag(file) if file.suffix == ".db3" else McapBag(file)


def _unpack_message(data: bytes) -> bytes:
    import zstandard

    most = limit("bag_message_bytes")
    try:
        with zstandard.ZstdDecompressor(max_window_size=most).stream_reader(data) as stream:
            found: bytes = stream.read(most + 1)
    except zstandard.ZstdError:
        return b""  # counted as unreadable
    if len(found) > most:
        raise too_much("bag_message_bytes", f"more than {most}")
    return found


@dataclass(frozen=True)
class _Metadata:
    """The used part of metadata.yaml; everything else is read from the files."""

    files: tuple[str, ...] = ()
    mode: str = ""
    format: str = ""


def _metadata(folder: Path) -> _Metadata:
    """Reads metadata.yaml; empty if it is missing or damaged, because the files are readable without it.

    It is parsed line by line, as rosbag2 writes it: YAML references could expand a kilobyte to any number of entries.
    """
    need("ros", what="reading ROS logs")
    path = folder / "metadata.yaml"
    if not path.is_file():
        return _Metadata()
    try:
        lines = text_of_file(path, "yaml_bytes").splitlines()
    except UnicodeDecodeError:
        return _Metadata()
    names: list[str] = []
    values: dict[str, str] = {}
    margin, key = None, ""
    for line in lines:
        entry = _KEY.fullmatch(line)
        if entry and margin in (None, entry[1]):
            margin, key = entry[1], entry[2]
            values.setdefault(key, _scalar(entry[3]))
        elif key == "relative_file_paths" and len(names) < _MAX_FILES and (item := _ITEM.fullmatch(line)):
            names.append(_scalar(item[1]))
    return _Metadata(
        tuple(filter(None, names)), values.get("compression_mode", ""), values.get("compression_format", "")
    )


def _scalar(written: str) -> str:
    """A YAML scalar on one line; empty if its quotes do not end."""
    text = written.strip()
    if text.startswith("'"):
        return text[1:-1].replace("''", "'") if len(text) > 1 and text.endswith("'") else ""
    if text.startswith('"'):
        try:
            return str(json.loads(text))
        except (ValueError, RecursionError):
            return ""
    return text
