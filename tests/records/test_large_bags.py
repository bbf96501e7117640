"""What a bag costs: definitions by what is looked at, messages by what is asked for."""

from __future__ import annotations

import time
import tracemalloc
from pathlib import Path
from typing import Any

import pytest
from tests.records.ros_logs import bag

from safedpa.errors import InputError
from safedpa.limits import LimitError, limit
from safedpa.records import load_column_map, load_run
from safedpa.records.bags import topic_log
from safedpa.robots.car.system import CAR
from safedpa.ros.definitions import known_fields, parsed, what_it_says
from safedpa_lab.experiments.hostile.bombs import BOMBS, attempt

FORMS = ("mcap", "mcap-zstd", "mcap-file", "db3", "db3-file", "db3-message", "bag", "bag-lz4")
_MEBI = 1 << 20


@pytest.fixture
def lines_parsed(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many lines the library's grammar was given, call by call."""
    import rosbags.typesys

    known_fields(False), known_fields(True)
    parsed.cache_clear()  # of whatever was read before in this process
    given: list[int] = []
    original = rosbags.typesys.get_types_from_msg

    def counting(text: str, name: str) -> Any:
        given.append(text.count("\n") + text.count(","))
        return original(text, name)

    monkeypatch.setattr(rosbags.typesys, "get_types_from_msg", counting)
    return given


def test_of_many_definitions_no_more_is_parsed_than_the_limit_says(tmp_path: Path, lines_parsed: list[int]) -> None:
    bomb = next(bomb for bomb in BOMBS if bomb.name == "300 definitions of 27 KB")
    path = tmp_path / f"bomb{bomb.ending}"
    path.write_bytes(bomb.make())
    assert attempt(path)
    assert sum(lines_parsed) <= limit("definitions_lines")


def test_long_definitions_are_not_parsed_and_their_topics_are_told(lines_parsed: list[int], tmp_path: Path) -> None:
    text = "".join(f"float64 x{number}\n" for number in range(limit("definition_lines") + 1))
    with pytest.raises(LimitError, match="definition_lines"):
        parsed("a/msg/Long", text, "ros2msg")
    with pytest.raises(LimitError, match="definition_lines"):
        parsed("a/msg/Wide", f"int8[] x [{'1,' * 30_000}1]\n", "ros2msg")
    assert not lines_parsed
    topics = topic_log(bag(tmp_path / "drive", "bag")).topics()
    assert all(not topic.problem for topic in topics.values())
    assert lines_parsed


def test_lines_that_say_nothing_are_not_parsed(lines_parsed: list[int]) -> None:
    comments = "# a long word about nothing\n\n \t\r\n" * 3000
    found = parsed("a/msg/Talks", f"{comments}float64 x # metres\n{comments}string NAME=a # b\n", "ros1msg")
    assert [item.name for item in found["a/msg/Talks"]] == ["x"]
    assert sum(lines_parsed) == 2
    with pytest.raises(InputError):
        parsed("a/msg/Talks", "#" * 17 * limit("definition_letters"), "ros1msg")


@pytest.mark.parametrize("form", ["ros1msg", "ros2idl"])
def test_a_line_of_blanks_costs_as_much_as_one_of_letters(form: str) -> None:
    def seconds(text: str) -> float:
        began = time.process_time()
        for _ in range(5):
            what_it_says(text, form)
        return time.process_time() - began

    assert seconds("x" + " " * 60_000 + "y") < 1000.0 * (seconds("x" * 60_000) + 1e-6)


@pytest.mark.long
@pytest.mark.parametrize("form", FORMS)
def test_pictures_that_nobody_asked_for_take_no_memory(form: str, tmp_path: Path) -> None:
    """Of a bag what is kept is what the map names; the rest passes by, a chunk at a time."""
    columns = load_column_map("f1tenth_bag")
    peaks = []
    for pictures in (1, 6, 30):
        path = bag(tmp_path / f"drive{pictures}", form, 40, pictures=pictures)
        tracemalloc.start()
        try:
            assert len(load_run(path, CAR, columns).t) == 40
            peaks.append(tracemalloc.get_traced_memory()[1])
        finally:
            tracemalloc.stop()
    assert peaks[2] < peaks[1] + 4 * _MEBI, f"bytes at most: {peaks}"
