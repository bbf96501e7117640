"""PX4 flight logs written byte by byte: times, gaps, damage and limits.

Source: the PX4 guide, ULog file format: a head of 16 bytes, then messages of a length, a kind and a content.
"""

import struct
from collections.abc import Iterable
from pathlib import Path

import pytest

from safedpa.errors import InputError, RunError
from safedpa.limits import LimitError
from safedpa.records.readers.bags import topic_log
from safedpa.records.readers.bags.ulog import UlogLog

STAMPS = (1_000_001, 1_020_003, 3_500_007)
"""us since the flight controller's start."""
START = b"ULog\x01\x12\x35\x01"


def message(kind: str, content: bytes) -> bytes:
    return struct.pack("<HB", len(content), ord(kind)) + content


def described(name: str, fields: str = "uint64_t timestamp;float x;") -> bytes:
    return message("F", f"{name}:{fields}".encode())


def subscribed(name: str, number: int, instance: int = 0) -> bytes:
    return message("A", struct.pack("<BH", instance, number) + name.encode())


def logged(number: int, stamp: int, *values: float) -> bytes:
    return message("D", struct.pack(f"<HQ{len(values)}f", number, stamp, *values))


HEAD = [described("speed"), subscribed("speed", 7)]
ROWS = [logged(7, stamp, 0.5 * k) for k, stamp in enumerate(STAMPS)]


def flight_log(path: Path, messages: Iterable[bytes], start: bytes = START) -> Path:
    path.write_bytes(start + struct.pack("<Q", 0) + b"".join(messages))
    return path


def test_times_are_nanoseconds_from_the_first_message_to_the_last(tmp_path: Path) -> None:
    log = topic_log(flight_log(tmp_path / "a.ulg", [*HEAD, *ROWS]))
    topic, series = log.topics()["speed"], log.series({"speed": ("x",)})["speed"]
    nanoseconds = [1_000_001_000, 1_020_003_000, 3_500_007_000]
    assert (topic.first, topic.last, topic.count) == (nanoseconds[0], nanoseconds[-1], 3)
    assert topic.rate == pytest.approx(2.0 / 2.500006)
    assert series.stamp is not None
    assert series.receipt.tolist() == series.stamp.tolist() == nanoseconds
    assert series.values["x"].tolist() == [0.0, 0.5, 1.0]
    assert not log.findings


def test_dropouts_of_the_logger_are_reported_in_seconds(tmp_path: Path) -> None:
    gaps = [message("O", struct.pack("<H", milliseconds)) for milliseconds in (250, 1500)]
    log = topic_log(flight_log(tmp_path / "a.ulg", [*HEAD, *ROWS, *gaps]))
    assert log.topics()["speed"].count == 3
    (found,) = log.findings
    assert (found.kind, found.count) == ("dropout", 2)
    assert "fell behind 2 times, 1.75 s in all" in found.message


@pytest.mark.parametrize(
    ("messages", "refused"),
    [
        pytest.param([], "the flight log contains no message; name another one", id="empty"),
        pytest.param(HEAD[:1], "the flight log contains no message; name another one", id="only described"),
        pytest.param(HEAD, "the flight log contains no message; name another one", id="only subscribed"),
        pytest.param(
            [message("B", bytes(8) + b"\x02" + bytes(31)), *HEAD, *ROWS],
            "is a damaged PX4 flight log",
            id="other flags",
        ),
        pytest.param([message("Z", b"x"), *HEAD, *ROWS], "is a damaged PX4 flight log", id="unknown first"),
        pytest.param([HEAD[0][:-3]], "is a damaged PX4 flight log; fetch it", id="cut off in a description"),
        pytest.param(
            [*HEAD, *ROWS, *[message("z", b"")] * 200_001], "is a damaged PX4", id="more than 200,000 unknown"
        ),
        pytest.param([*HEAD, *ROWS, *[message("z", b"")] * 200_000], "", id="unknown within bounds"),
    ],
)
def test_a_damaged_or_empty_flight_log_is_refused(messages: list[bytes], refused: str, tmp_path: Path) -> None:
    log = topic_log(flight_log(tmp_path / "a.ulg", messages))
    if refused:
        with pytest.raises(RunError, match=refused):
            log.topics()
    else:
        assert log.topics()["speed"].count == 3


@pytest.mark.parametrize("start", [b"ULoG\x01\x12\x35", b"ULog\x01\x12\x36", b""])
def test_a_file_that_does_not_begin_as_a_flight_log_is_refused(start: bytes, tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"is no PX4 flight log; wanted a .ulg file"):
        UlogLog(flight_log(tmp_path / "a.ulg", [*HEAD, *ROWS], start + b"\x01")).topics()


def test_an_unknown_field_or_topic_is_named(tmp_path: Path) -> None:
    log = topic_log(flight_log(tmp_path / "a.ulg", [*HEAD, *ROWS]))
    with pytest.raises(InputError, match="field 'y' of speed: "):
        log.series({"speed": ("x", "y")})
    with pytest.raises(RunError, match="sped"):
        log.series({"sped": ("x",)})


@pytest.mark.parametrize("less", [0, 1])
@pytest.mark.parametrize("case", ["kinds", "topics", "bytes"])
def test_a_flight_log_stays_within_its_limits(case: str, less: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    kinds = [*(described(f"kind{k}") for k in range(3)), subscribed("kind0", 0), logged(0, STAMPS[0], 0.0)]
    topics = [described("kind0"), *(subscribed("kind0", k, k) for k in range(3)), logged(0, STAMPS[0], 0.0)]
    path = flight_log(tmp_path / "a.ulg", topics if case == "topics" else kinds)
    name, size = ("table_bytes", path.stat().st_size) if case == "bytes" else ("bag_topics", 3)
    monkeypatch.setenv("SAFEDPA_LIMITS", f"{name}={size - less}")
    if less:
        with pytest.raises(LimitError, match=name):
            topic_log(path).topics()
    else:
        assert topic_log(path).topics()["kind0"].count == 1


def test_a_message_may_have_4096_numbers(tmp_path: Path) -> None:
    parts = [described("wide", "uint64_t timestamp;float[4095] x;"), subscribed("wide", 3)]
    log = topic_log(flight_log(tmp_path / "a.ulg", [*parts, logged(3, STAMPS[0], *range(4095))]))
    series = log.series({"wide": ("x[0]", "x[4094]")})["wide"]
    assert [values.tolist() for values in series.values.values()] == [[0.0], [4094.0]]


@pytest.mark.parametrize("fields", ["uint64_t timestamp;float[4096] x;", "uint64_t timestamp;pair[2048] x;"])
def test_a_message_of_more_numbers_is_refused(fields: str, tmp_path: Path) -> None:
    """Those of messages within it count."""
    parts = [described("pair", "float x;float y;"), described("wide", fields), subscribed("pair", 0)]
    with pytest.raises(RunError, match="'wide' would have more than 4096 numbers"):
        topic_log(flight_log(tmp_path / "a.ulg", parts)).topics()


@pytest.mark.parametrize(("topics", "refused"), [(24, False), (25, True)])
def test_all_topics_together_have_a_hundred_thousand_numbers_at_most(topics: int, refused: bool, tmp_path: Path):
    """4001 numbers each: 24 topics have 96,024 and 25 have 100,025."""
    parts = [described("wide", "uint64_t timestamp;float[4000] x;"), *(subscribed("wide", k, k) for k in range(topics))]
    log = topic_log(flight_log(tmp_path / "a.ulg", [*parts, logged(topics - 1, STAMPS[0], *range(4000))]))
    if refused:
        with pytest.raises(RunError, match="more than 100000 numbers in total"):
            log.topics()
    else:
        assert log.topics()["wide#23"].count == 1
