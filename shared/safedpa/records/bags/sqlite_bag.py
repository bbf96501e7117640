"""rosbag2 in SQLite (``.db3``): one table of topics, one of messages, read by the standard library alone.

Nothing in the file is believed to be harmless: it is opened for reading, its tables must be tables, a row has a largest
size, and functions of a schema are not run.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Collection, Iterator
from contextlib import closing
from pathlib import Path

from safedpa.errors import RunError
from safedpa.limits import limit, readable, too_much
from safedpa.records.bags.messages_log import AbstractBag, Declared
from safedpa.records.run import Finding
from safedpa.ros.definitions import plain_type

__all__ = ["SqliteBag"]

MAGIC = b"SQLite format 3\0"
_CURE = "it was damaged or made to harm: sqlite3 FILE.db3 .recover brings back what is there"
_WANTED = {"topics": {"id", "name", "type", "serialization_format"}, "messages": {"topic_id", "timestamp", "data"}}


class SqliteBag(AbstractBag):
    """A ``.db3`` of rosbag2."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, "rosbag2 in SQLite")

    def messages(self, topics: Collection[str] | None) -> Iterator[tuple[str, int, bytes]]:
        """(topic, receipt in ns, encoded message) in the file's order; a damaged end is told and left out."""
        size = self.path.stat().st_size
        if size > limit("bag_bytes"):
            raise too_much("bag_bytes", f"{size} bytes", str(self.path))
        try:
            with closing(self._opened()) as base:
                self._check(base)
                numbers = self._declare(base)
                chosen = {number: name for number, name in numbers.items() if topics is None or name in topics}
                yield from self._rows(base, chosen, every=topics is None)
        except (sqlite3.Error, UnicodeDecodeError) as error:  # its own message may quote bytes that are no text
            raise RunError(
                f"{self.path}: cannot be read as SQLite ({readable(str(error), 100)}); if it was cut off, "
                "sqlite3 FILE.db3 .recover brings back what is left"
            ) from error

    def _opened(self) -> sqlite3.Connection:
        from urllib.parse import quote

        base = sqlite3.connect(f"file:{quote(str(self.path.resolve()))}?mode=ro&immutable=1", uri=True)
        base.text_factory = lambda text: text.decode("utf-8", "replace")
        base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, limit("bag_message_bytes"))
        base.setlimit(sqlite3.SQLITE_LIMIT_ATTACHED, 0)
        base.execute("PRAGMA trusted_schema = OFF")
        base.execute("PRAGMA cell_size_check = ON")
        return base

    def _check(self, base: sqlite3.Connection) -> None:
        """Raises RunError where the file is no bag."""
        kinds = dict(base.execute("SELECT name, type FROM sqlite_master").fetchmany(1000))
        for table, wanted in _WANTED.items():
            present = {row[1] for row in base.execute(f"PRAGMA table_info({table})")} if table in kinds else set()
            if kinds.get(table) != "table" or not wanted <= present:
                raise RunError(f"{self.path}: is a SQLite database, but no rosbag2: it has no table '{table}' of one")
        log = self.path.with_name(self.path.name + "-wal")
        if log.exists() and log.stat().st_size:
            sentence = f"{log.name} holds messages that never came into the bag: it was not closed; without them"
            self.findings.append(Finding("cut_off", f"{sentence} the rest is read. 'ros2 bag reindex' takes them in"))

    def _declare(self, base: sqlite3.Connection) -> dict[int, str]:
        texts: dict[str, tuple[str, str]] = {}
        columns = {row[1] for row in base.execute("PRAGMA table_info(message_definitions)")}
        if {"topic_type", "encoding", "encoded_message_definition"} <= columns:
            asked = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            for kind, form, text in base.execute(asked).fetchmany(limit("bag_topics")):
                if form in ("ros2msg", "ros2idl"):
                    texts[str(kind)] = (str(text), str(form))
        rows = base.execute("SELECT id, name, type, serialization_format FROM topics").fetchmany(
            limit("bag_topics") + 1
        )
        if len(rows) > limit("bag_topics"):
            raise too_much("bag_topics", len(rows), str(self.path))
        for _, name, kind, encoding in rows:
            self.declared[str(name)] = Declared(
                readable(plain_type(str(kind))), str(encoding), *texts.get(str(kind), ("", ""))
            )
        return {number: str(name) for number, name, _, _ in rows if isinstance(number, int)}

    def _rows(
        self, base: sqlite3.Connection, chosen: dict[int, str], *, every: bool
    ) -> Iterator[tuple[str, int, bytes]]:
        data = "x''" if every else "data"  # counting needs no message
        marks = ",".join("?" * len(chosen)) if len(chosen) <= 500 else ""
        where = f" WHERE topic_id IN ({marks})" if marks and not every else ""
        cursor = base.execute(
            f"SELECT topic_id, timestamp, {data} FROM messages{where}", tuple(chosen) if where else ()
        )
        left = max(limit("expansion_free_bytes"), self.path.stat().st_size)  # rows may share their bytes in the file
        try:
            for number, at, content in cursor:
                if number in chosen and isinstance(at, int) and isinstance(content, bytes):
                    left -= len(content)
                    if left < 0:
                        raise RunError(f"{self.path}: its messages are longer than the file; {_CURE}")
                    yield chosen[number], at, content
        except (sqlite3.DatabaseError, UnicodeDecodeError) as error:
            sentence = f"the bag is damaged ({readable(str(error), 60)}); read up to there, the rest left out"
            self.findings.append(Finding("cut_off", sentence))
