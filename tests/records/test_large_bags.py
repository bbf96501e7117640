"""What a bag costs: definitions by what is looked at, messages by what is asked for."""

import sqlite3
import time
import tracemalloc
from pathlib import Path

import pytest
from tests.records.ros_logs import bag

from safedpa.limits import LimitError
from safedpa.records import load_column_map, load_run
from safedpa.records.readers.bags import topic_log
from safedpa.robots.car.system import CAR
from safedpa.ros.definitions import parsed, summarize_definition

FORMS = ("mcap", "mcap-zstd", "mcap-file", "db3", "db3-file", "db3-message", "bag", "bag-lz4")
_MEBI = 1 << 20


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        pytest.param("float64 x\n", "", id="one line"),
        pytest.param("".join(f"float64 x{k}\n" for k in range(9)) + "float64 y", "", id="ten lines"),
        pytest.param("".join(f"float64 x{k}\n" for k in range(11)), "definition_lines", id="eleven lines"),
        pytest.param(f"int8[] x [{'1,' * 10}1]\n", "definition_lines", id="ten commas"),
        pytest.param(f"float64 {'x' * 993}", "definition_letters", id="too many letters"),
        pytest.param("# a comment\n\n \t\r\n" * 900 + "float64 x # metres\n", "", id="comments do not count"),
        pytest.param("#" * 16_001, "definition_letters", id="too long a comment"),
    ],
)
def test_a_definition_is_measured_without_comments_before_it_is_parsed(text, problem, monkeypatch):
    monkeypatch.setenv("SAFEDPA_LIMITS", "definition_lines=10,definition_letters=1000")
    parsed.cache_clear()  # of what was read before in this process
    if problem:
        with pytest.raises(LimitError, match=problem):
            parsed("a/msg/B", text, "ros2msg")
    else:
        assert parsed("a/msg/B", text, "ros2msg")["a/msg/B"][0].name in ("x", "x0")


def test_the_longest_definitions_are_not_listed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Odometry has more lines than a command; with two lines less than both have, it is named and left out."""
    path = next(bag(tmp_path / "drive", "db3", 5).glob("*.db3"))
    with sqlite3.connect(path) as base:
        rows = base.execute("SELECT encoded_message_definition FROM message_definitions").fetchall()
    lines = sum(summarize_definition(text, "ros2msg")[1] for (text,) in rows)
    monkeypatch.setenv("SAFEDPA_LIMITS", f"definitions_lines={lines}")
    assert not any(topic.problem for topic in topic_log(path).topics().values())
    monkeypatch.setenv("SAFEDPA_LIMITS", f"definitions_lines={lines - 1}")
    problems = {name: topic.problem for name, topic in topic_log(path).topics().items()}
    assert not problems["/drive"]
    assert "definitions_letters" in problems["/odom"]


@pytest.mark.parametrize("form", ["ros1msg", "ros2idl"])
def test_a_line_of_blanks_costs_as_much_as_one_of_letters(form: str) -> None:
    def seconds(text: str) -> float:
        began = time.process_time()
        for _ in range(5):
            summarize_definition(text, form)
        return time.process_time() - began

    assert seconds("x" + " " * 60_000 + "y") < 1000.0 * (seconds("x" * 60_000) + 1e-6)


@pytest.mark.long
@pytest.mark.parametrize("form", FORMS)
def test_pictures_that_are_not_requested_take_no_memory(form: str, tmp_path: Path) -> None:
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
