"""Flight logs of PX4 that are written byte by byte: stamps in microseconds, gaps, and how much is described at most.

Source: the PX4 guide, ULog file format: a head of 16 bytes, then messages of a length, a kind and a content.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from pathlib import Path

import pytest

from safedpa.errors import RunError
from safedpa.limits import LimitError
from safedpa.records.bags import topic_log

STAMPS = (1_000_001, 1_020_003, 3_500_007)
"""us since the flight controller's start."""


def message(kind: str, content: bytes) -> bytes:
    return struct.pack("<HB", len(content), ord(kind)) + content


def described(name: str, fields: str = "uint64_t timestamp;float x;") -> bytes:
    return message("F", f"{name}:{fields}".encode())


def subscribed(name: str, number: int, instance: int = 0) -> bytes:
    return message("A", struct.pack("<BH", instance, number) + name.encode())


def logged(number: int, stamp: int, value: float) -> bytes:
    return message("D", struct.pack("<HQf", number, stamp, value))


def flight_log(path: Path, messages: Iterable[bytes]) -> Path:
    path.write_bytes(b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0) + b"".join(messages))
    return path


def test_times_are_nanoseconds_from_the_first_message_to_the_last(tmp_path: Path) -> None:
    rows = [logged(7, stamp, 0.5 * k) for k, stamp in enumerate(STAMPS)]
    path = flight_log(tmp_path / "a.ulg", [described("speed"), subscribed("speed", 7), *rows])
    log = topic_log(path)
    topic = log.topics()["speed"]
    nanoseconds = [1_000_001_000, 1_020_003_000, 3_500_007_000]
    assert (topic.first, topic.last, topic.count) == (nanoseconds[0], nanoseconds[-1], 3)
    series = log.series({"speed": ("x",)})["speed"]
    assert series.values["x"].tolist() == [0.0, 0.5, 1.0]
    assert topic.rate == pytest.approx(2.0 / 2.500006)
    for times in (series.receipt, series.stamp):
        assert times is not None
        assert times.tolist() == nanoseconds
    assert not log.findings


def test_how_long_the_logger_fell_behind_is_told_in_seconds(tmp_path: Path) -> None:
    gaps = [message("O", struct.pack("<H", milliseconds)) for milliseconds in (250, 1500)]
    rows = [logged(7, stamp, 0.0) for stamp in STAMPS]
    log = topic_log(flight_log(tmp_path / "a.ulg", [described("speed"), subscribed("speed", 7), *rows, *gaps]))
    assert log.topics()["speed"].count == 3
    (found,) = log.findings
    assert (found.kind, found.count) == ("dropout", 2)
    assert "fell behind 2 times, 1.75 s in all" in found.message


@pytest.mark.parametrize("more", [0, 1])
def test_so_many_messages_are_described_and_subscribed_and_no_more(
    more: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SAFEDPA_LIMITS", "bag_topics=3")
    row = logged(0, STAMPS[0], 0.0)
    kinds = [described(f"kind{k}") for k in range(3 + more)]
    many_kinds = flight_log(tmp_path / "kinds.ulg", [*kinds, subscribed("kind0", 0), row])
    topics = [subscribed("kind0", k, k) for k in range(3 + more)]
    many_topics = flight_log(tmp_path / "topics.ulg", [described("kind0"), *topics, row])
    for path in (many_kinds, many_topics):
        if more:
            with pytest.raises(LimitError, match="bag_topics"):
                topic_log(path).topics()
        else:
            assert "kind0" in topic_log(path).topics()


def test_a_message_of_as_many_numbers_as_are_allowed_is_read(tmp_path: Path) -> None:
    parts = [described("wide", "uint64_t timestamp;float[4095] x;"), subscribed("wide", 3)]
    row = message("D", struct.pack("<HQ4095f", 3, STAMPS[0], *range(4095)))
    series = topic_log(flight_log(tmp_path / "a.ulg", [*parts, row])).series({"wide": ("x[0]", "x[4094]")})["wide"]
    assert [values.tolist() for values in series.values.values()] == [[0.0], [4094.0]]


@pytest.mark.parametrize("fields", ["uint64_t timestamp;float[4096] x;", "uint64_t timestamp;pair[2048] x;"])
def test_a_message_of_more_numbers_is_refused_and_those_of_messages_within_it_count(
    fields: str, tmp_path: Path
) -> None:
    parts = [described("pair", "float x;float y;"), described("wide", fields), subscribed("pair", 0)]
    with pytest.raises(RunError, match="'wide' would have more than 4096 numbers"):
        topic_log(flight_log(tmp_path / "a.ulg", parts)).topics()


@pytest.mark.parametrize(("topics", "refused"), [(24, False), (25, True)])
def test_all_topics_together_have_a_hundred_thousand_numbers_and_no_more(
    topics: int, refused: bool, tmp_path: Path
) -> None:
    """Of 4000 and one for the time each: 24 have 96,024 and 25 have 100,025."""
    parts = [described("wide", "uint64_t timestamp;float[4000] x;"), *(subscribed("wide", k, k) for k in range(topics))]
    log = topic_log(flight_log(tmp_path / "a.ulg", [*parts, wide_row(topics - 1)]))
    if refused:
        with pytest.raises(RunError, match="more than 100000 numbers together"):
            log.topics()
    else:
        assert log.topics()["wide#23"].count == 1


def wide_row(number: int) -> bytes:
    """A message of 4000 numbers and its time."""
    return message("D", struct.pack("<HQ4000f", number, STAMPS[0], *range(4000)))
