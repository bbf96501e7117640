"""rosbag2 in SQLite, row by row: which rows are messages, what is refused, the limits; also packed and in folders."""

import os
import sqlite3
import struct
from contextlib import closing
from pathlib import Path, PosixPath
from typing import Any

import pytest
import zstandard
from tests.records.test_ros1_bag import bag as ros1_bag
from tests.records.test_ros1_bag import connection, message

from safedpa.errors import RunError
from safedpa.limits import LimitError
from safedpa.records import load_run
from safedpa.records.column_map.column_map import native_map
from safedpa.records.readers.bags import read_log_table, topic_log
from safedpa.records.readers.bags.rosbag2 import FolderBag, PackedBag, SqliteBag
from safedpa.robots.car.system import CAR

TOPICS = "CREATE TABLE topics (id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)"
MESSAGES = "CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id, timestamp, data)"


def encoded(value: float) -> bytes:
    """A std_msgs/Float32 in CDR, little-endian."""
    return b"\0\1\0\0" + struct.pack("<f", value)


def written(path: Path, *rows: tuple[Any, Any, Any], tables: tuple[str, ...] = (TOPICS, MESSAGES)) -> Path:
    """A bag with the topics /a, number 1, and /b, number 2."""
    with closing(sqlite3.connect(path)) as base:
        for table in tables:
            base.execute(table)
        if tables == (TOPICS, MESSAGES):
            named = [(1, "/a", "std_msgs/msg/Float32", "cdr"), (2, "/b", "std_msgs/msg/Float32", "cdr")]
            base.executemany("INSERT INTO topics VALUES (?, ?, ?, ?)", named)
            base.executemany("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", rows)
        base.commit()
    return path


@pytest.mark.parametrize(
    "odd",
    [
        pytest.param((9, 6, encoded(1.0)), id="of no topic"),
        pytest.param(("/a", 6, encoded(1.0)), id="of a topic by name"),
        pytest.param((1, None, encoded(1.0)), id="without a time"),
        pytest.param((1, "noon", encoded(1.0)), id="a text for a time"),
        pytest.param((1, 6.5, encoded(1.0)), id="a fraction for a time"),
        pytest.param((1, 6, "text"), id="letters"),
        pytest.param((1, 6, None), id="nothing"),
        pytest.param((1, 6, 3), id="a number"),
    ],
)
def test_a_row_that_is_no_message_is_left_out(odd: tuple[Any, Any, Any], tmp_path: Path) -> None:
    rows = [(1, 5, encoded(0.5)), odd, (2, 7, encoded(2.0)), (1, 8, encoded(4.0))]
    log = SqliteBag(written(tmp_path / "a.db3", *rows))
    assert list(log.messages(("/a",))) == [("/a", 5, encoded(0.5)), ("/a", 8, encoded(4.0))]
    if isinstance(odd[2], bytes):  # counting does not look at the bytes
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
def test_a_database_without_the_tables_of_a_bag_is_refused(tables: tuple[str, ...], lacking: str, tmp_path: Path):
    """A view could compute without end."""
    with pytest.raises(RunError, match=f"is a SQLite database, but no rosbag2: (it has no such table|its) '{lacking}'"):
        list(SqliteBag(written(tmp_path / "a.db3", tables=tables)).messages(None))


class Shorter(PosixPath):
    """A path that reports another size, as a file whose rows share their bytes is shorter than its messages."""

    size = 0

    def stat(self, *, follow_symlinks: bool = True) -> os.stat_result:
        found = list(super().stat(follow_symlinks=follow_symlinks))
        found[6] = self.size
        return os.stat_result(found)


@pytest.mark.parametrize("less", [0, 1])
def test_messages_longer_together_than_their_file_are_refused(less, tmp_path, monkeypatch):
    monkeypatch.setenv("SAFEDPA_LIMITS", "expansion_free_bytes=1")
    path = Shorter(written(tmp_path / "a.db3", *[(1, at, encoded(1.0)) for at in range(5)]))
    monkeypatch.setattr(Shorter, "size", 5 * 8 - less)
    if less:
        with pytest.raises(RunError, match="its messages are larger than the file; it is damaged or malicious"):
            list(SqliteBag(path).messages(("/a",)))
    else:
        assert len(list(SqliteBag(path).messages(("/a",)))) == 5


def test_messages_that_cannot_be_decoded_are_counted_and_a_topic_of_nothing_else_is_refused(tmp_path: Path) -> None:
    broken = [(1, 5, encoded(0.5)[:-1]), (1, 6, encoded(0.5)[:5])]
    log = SqliteBag(written(tmp_path / "a.db3", *broken, (1, 7, encoded(2.0))))
    assert log.series({"/a": ("data",)})["/a"].values["data"].tolist() == [2.0]
    assert [(found.kind, found.count) for found in log.findings] == [("unreadable_message", 2)]
    with pytest.raises(RunError, match="topic '/a': none of 2 messages is a std_msgs/msg/Float32"):
        SqliteBag(written(tmp_path / "b.db3", *broken)).series({"/a": ("data",)})


def test_a_log_lists_its_topics_and_names_what_is_missing(tmp_path: Path) -> None:
    """Two messages of /a, a second apart; none of /b."""
    path = written(tmp_path / "a.db3", (1, 1_000_000_005, encoded(0.5)), (1, 5, encoded(0.5)))
    log = SqliteBag(path)
    topic = log.topic("/a")
    assert (topic.count, topic.first, topic.last, topic.rate) == (2, 5, 1_000_000_005, 1.0)
    for name, problem in {"/b": "has no message; record it, or leave it out", "/c": "does not exist; "}.items():
        with pytest.raises(RunError, match=f"topic '{name}' {problem}"):
            log.series({"/a": ("data",), name: ("data",)})
    with pytest.raises(RunError, match="is a rosbag2 in SQLite, and the map's column 't' names no topic; wanted"):
        read_log_table(log, native_map(CAR), CAR)
    with pytest.raises(RunError, match=r"with 1 topics, and needs a column map: /a \(std_msgs/msg/Float32, 1 Hz\);"):
        load_run(path, CAR)


@pytest.mark.parametrize("less", [0, 1])
def test_a_packed_bag_expands_up_to_its_limit(less: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, packed = written(tmp_path / "whole.db3", (1, 5, encoded(0.5))), tmp_path / "a.db3.zstd"
    packed.write_bytes(zstandard.ZstdCompressor().compress(whole.read_bytes()))
    monkeypatch.setenv("SAFEDPA_LIMITS", f"expansion=1,expansion_free_bytes={whole.stat().st_size - less}")
    if less:
        with pytest.raises(LimitError, match=f"{packed}.*expansion"):
            list(PackedBag(packed).messages(None))
    else:
        assert topic_log(packed).topics()["/a"].count == 1


METADATA = """rosbag2_bagfile_information:
  version: 5
  relative_file_paths:
    - a.db3
  compression_format: {form}
  compression_mode: {mode}
"""


def folder_bag(folder: Path, form: str, mode: str, *data: bytes) -> FolderBag:
    folder.mkdir(exist_ok=True)
    (folder / "metadata.yaml").write_text(METADATA.format(form=form, mode=mode), encoding="utf-8")
    (folder / "a.db3").unlink(missing_ok=True)
    written(folder / "a.db3", *((1, at, one) for at, one in enumerate(data)))
    return FolderBag(folder)


@pytest.mark.parametrize(
    ("form", "mode", "refused"),
    [
        ("lz4", "MESSAGE", True),
        ("lz4", "message", True),
        ('""', "MESSAGE", True),
        ("zstd", "message", False),
        ("lz4", "FILE", False),
        ('""', '""', False),
    ],
)
def test_messages_of_a_folder_are_packed_by_zstd_or_not_at_all(form: str, mode: str, refused: bool, tmp_path: Path):
    if refused:
        with pytest.raises(RunError, match=f"messages are compressed by '{form.strip(chr(34))}'; wanted zstd"):
            folder_bag(tmp_path / "bag", form, mode)
    else:
        folder_bag(tmp_path / "bag", form, mode)


@pytest.mark.parametrize("name", ["a.db3", "'a.db3'", '"a.db3"', '"a\\u002edb3"', "folder/a.db3"])
def test_the_files_of_a_folder_are_named_in_yaml(name: str, tmp_path: Path) -> None:
    """Of a path the last part counts: a name leads to no other folder."""
    folder_bag(tmp_path / "bag", '""', '""', encoded(0.5))
    text = METADATA.format(form='""', mode='""').replace("- a.db3", f"- {name}\n    - 'it''s lost.db3'\n    - 'x.db3")
    (tmp_path / "bag" / "metadata.yaml").write_text(text, encoding="utf-8")
    log = FolderBag(tmp_path / "bag")
    assert [data for _, _, data in log.messages(("/a",))] == [encoded(0.5)]
    assert ["1 of the bag's 2 files are missing (it's lost.db3)" in one.message for one in log.findings] == [True]


def test_packed_messages_are_unpacked_up_to_a_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SAFEDPA_LIMITS", "bag_message_bytes=2000")
    packed = [zstandard.ZstdCompressor().compress(b" " * size) for size in (2000, 2001)]
    log = folder_bag(tmp_path / "bag", "zstd", "MESSAGE", packed[0], b"no zstd")
    assert [data for _, _, data in log.messages(("/a",))] == [b" " * 2000, b""]
    with pytest.raises(LimitError, match=r"more than 2000, wanted at most 2000; .*bag_message_bytes"):
        list(folder_bag(tmp_path / "bag", "zstd", "MESSAGE", packed[1]).messages(("/a",)))


@pytest.mark.parametrize(("letters", "listed"), [(24, ["/a", "/a2", "/b"]), (23, ["/a", "/a2"]), (11, [])])
def test_fields_are_listed_for_as_many_definitions_as_the_limit_allows(letters, listed, tmp_path, monkeypatch):
    """Each definition has twelve letters; that of /a2 is the one of /a and counts once."""
    monkeypatch.setenv("SAFEDPA_LIMITS", f"definitions_letters={letters}")
    parts = [connection(0), connection(1, "/b", "other_msgs/Value"), connection(2, "/a2"), message(0)]
    found = ros1_bag(tmp_path, *parts).topics()
    assert [name for name, topic in found.items() if topic.fields] == listed
    assert {name for name, topic in found.items() if "definitions_letters" in topic.problem} == found.keys() - listed
