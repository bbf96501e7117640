"""Bags in SQLite whose rows are written one by one: which of them are messages, and how much they may be together."""

from __future__ import annotations

import os
import sqlite3
import struct
from contextlib import closing
from pathlib import Path, PosixPath
from typing import Any

import pytest
import zstandard
from tests.records.test_ros1_bag_bounds_by_hand import bag as ros1_bag
from tests.records.test_ros1_bag_bounds_by_hand import connection, message

from safedpa.errors import RunError
from safedpa.limits import LimitError
from safedpa.records import load_run
from safedpa.records.bags import read_log_table, topic_log
from safedpa.records.bags.folder_bag import PackedBag
from safedpa.records.bags.sqlite_bag import SqliteBag
from safedpa.records.column_map import native_map
from safedpa.robots.car.system import CAR

TOPICS = "CREATE TABLE topics (id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)"
MESSAGES = "CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id, timestamp, data)"


def encoded(value: float) -> bytes:
    """A std_msgs/Float32 in CDR, little-endian."""
    return b"\0\1\0\0" + struct.pack("<f", value)


def written(path: Path, *rows: tuple[Any, Any, Any], tables: tuple[str, ...] = (TOPICS, MESSAGES)) -> Path:
    """A bag with the topics /a, of number 1, and /b, of number 2."""
    with closing(sqlite3.connect(path)) as base:
        for table in tables:
            base.execute(table)
        if tables == (TOPICS, MESSAGES):
            named = [(1, "/a", "std_msgs/msg/Float32", "cdr"), (2, "/b", "std_msgs/msg/Float32", "cdr")]
            base.executemany("INSERT INTO topics VALUES (?, ?, ?, ?)", named)
            base.executemany("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", rows)
        base.commit()
    return path


ODD = {
    "of no topic": (9, 6, encoded(1.0)),
    "of a topic by name": ("/a", 6, encoded(1.0)),
    "at no time": (1, None, encoded(1.0)),
    "at a time in words": (1, "noon", encoded(1.0)),
    "at a broken time": (1, 6.5, encoded(1.0)),
}
WITHOUT_BYTES = {"of letters": (1, 6, "text"), "of nothing": (1, 6, None), "a number": (1, 6, 3)}


@pytest.mark.parametrize("odd", [*ODD, *WITHOUT_BYTES])
def test_a_row_that_is_no_message_is_left_out(odd: str, tmp_path: Path) -> None:
    row = {**ODD, **WITHOUT_BYTES}[odd]
    log = SqliteBag(written(tmp_path / "a.db3", (1, 5, encoded(0.5)), row, (2, 7, encoded(2.0)), (1, 8, encoded(4.0))))
    whole = [("/a", 5, encoded(0.5)), ("/a", 8, encoded(4.0))]
    assert list(log.messages(("/a",))) == whole
    if odd in ODD:  # counting looks at no message's bytes
        assert [(name, at) for name, at, _ in log.messages(None)] == [("/a", 5), ("/b", 7), ("/a", 8)]
    assert log.series({"/a": ("data",)})["/a"].values["data"].tolist() == [0.5, 4.0]


@pytest.mark.parametrize(
    ("tables", "lacking"),
    [
        ((), "topics"),
        ((TOPICS,), "messages"),
        ((MESSAGES,), "topics"),
        ((TOPICS, "CREATE TABLE messages (id, topic_id, timestamp)"), "messages"),
        (("CREATE TABLE topics (id, name, type)", MESSAGES), "topics"),
        ((TOPICS, "CREATE VIEW messages AS SELECT 1 AS topic_id, 2 AS timestamp, x'00' AS data"), "messages"),
    ],
)
def test_a_base_without_the_tables_of_a_bag_is_none(tables: tuple[str, ...], lacking: str, tmp_path: Path) -> None:
    """A view could compute for ever."""
    with pytest.raises(RunError, match=f"is a SQLite database, but no rosbag2: it has no table '{lacking}' of one"):
        list(SqliteBag(written(tmp_path / "a.db3", tables=tables)).messages(None))


class Shorter(PosixPath):
    """A file that is told to be so long, as one whose rows share their bytes is shorter than they are together."""

    told = 0

    def stat(self, *, follow_symlinks: bool = True) -> os.stat_result:
        found = list(super().stat(follow_symlinks=follow_symlinks))
        found[6] = self.told
        return os.stat_result(found)


@pytest.mark.parametrize("less", [0, 1])
def test_messages_are_not_longer_together_than_their_file(
    less: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SAFEDPA_LIMITS", "expansion_free_bytes=1")
    path = Shorter(written(tmp_path / "a.db3", *[(1, at, encoded(1.0)) for at in range(5)]))
    monkeypatch.setattr(Shorter, "told", 5 * 8 - less)
    if less:
        with pytest.raises(RunError, match="its messages are longer than the file; it was damaged or made to harm"):
            list(SqliteBag(path).messages(("/a",)))
    else:
        assert len(list(SqliteBag(path).messages(("/a",)))) == 5


@pytest.mark.parametrize("good", [0, 1])
def test_of_messages_that_are_not_what_they_say_some_are_left_out_and_all_are_refused(
    good: int, tmp_path: Path
) -> None:
    rows = [(1, 5, encoded(0.5)[:-1]), (1, 6, encoded(0.5)[:5]), *[(1, 7, encoded(2.0))] * good]
    log = SqliteBag(written(tmp_path / "a.db3", *rows))
    if good:
        assert log.series({"/a": ("data",)})["/a"].values["data"].tolist() == [2.0]
        assert [(found.kind, found.count) for found in log.findings] == [("unreadable_message", 2)]
    else:
        with pytest.raises(RunError, match="topic '/a': none of its 2 messages is a std_msgs/msg/Float32"):
            log.series({"/a": ("data",)})


@pytest.mark.parametrize("less", [0, 1])
def test_a_packed_bag_becomes_so_many_bytes(less: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = written(tmp_path / "whole.db3", (1, 5, encoded(0.5)))
    packed = tmp_path / "a.db3.zstd"
    packed.write_bytes(zstandard.ZstdCompressor().compress(whole.read_bytes()))
    monkeypatch.setenv("SAFEDPA_LIMITS", f"expansion=1,expansion_free_bytes={whole.stat().st_size - less}")
    if less:
        with pytest.raises(LimitError, match=f"{packed}.*expansion"):
            list(PackedBag(packed).messages(None))
    else:
        assert [(name, at) for name, at, _ in topic_log(packed).messages(None)] == [("/a", 5)]  # type: ignore[attr-defined]


@pytest.mark.parametrize(("letters", "listed"), [(24, ["/a", "/a2", "/b"]), (23, ["/a", "/a2"]), (11, [])])
def test_fields_of_topics_are_listed_as_far_as_all_their_definitions_may_be_long(
    letters: int, listed: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each has twelve letters; /a2 is of the kind of /a, which counts once."""
    monkeypatch.setenv("SAFEDPA_LIMITS", f"definitions_letters={letters}")
    parts = [connection(0), connection(1, "/b", "other_msgs/Value"), connection(2, "/a2"), message(0)]
    found = ros1_bag(tmp_path, *parts).topics()
    assert [name for name, topic in found.items() if topic.fields] == listed
    assert [name for name, topic in found.items() if "definitions_letters" in topic.problem] == [
        name for name in ("/a", "/a2", "/b") if name not in listed
    ]


def test_a_topic_without_messages_and_one_that_is_not_there_are_told(tmp_path: Path) -> None:
    log = SqliteBag(written(tmp_path / "a.db3", (1, 5, encoded(0.5))))
    assert log.topic("/a").count == 1
    with pytest.raises(RunError, match="topic '/b' has no message; record it, or leave it out of the map"):
        log.series({"/a": ("data",), "/b": ("data",)})
    with pytest.raises(RunError, match="topic '/c' is not there; "):
        log.series({"/c": ("data",)})


def test_columns_of_a_table_are_none_of_a_log_of_topics(tmp_path: Path) -> None:
    log = SqliteBag(written(tmp_path / "a.db3", (1, 5, encoded(0.5))))
    with pytest.raises(RunError, match="is a rosbag2 in SQLite, and the map's column 't' names no topic; wanted"):
        read_log_table(log, native_map(CAR), CAR)


def test_a_log_of_topics_wants_a_map_and_says_what_is_in_it(tmp_path: Path) -> None:
    """Two messages a second apart: one per second; what has none is not named."""
    path = written(tmp_path / "a.db3", (1, 5, encoded(0.5)), (1, 1_000_000_005, encoded(0.5)))
    with pytest.raises(RunError) as caught:
        load_run(path, CAR)
    assert "with 1 topics, and no map says which are whose: /a (std_msgs/msg/Float32, 1 Hz);" in str(caught.value)
