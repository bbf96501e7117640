"""One structured line per event, and a flood costs one line a second."""

import io
import itertools
import json
import sys
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from safedpa.bus.logging import EVENT_LOG, EventLog, log_event


class Bench:
    """A log on a clock that the test turns."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.now = 0.0
        self.due: list[tuple[float, Callable[[], None]]] = []
        self.log = EventLog(self.lines.append, lambda: self.now, self.later)

    def later(self, seconds: float, work: Callable[[], None]) -> None:
        self.due.append((self.now + seconds, work))

    def turn_to(self, now: float) -> None:
        self.now = now
        ready = [work for at, work in self.due if at <= now]
        self.due = [entry for entry in self.due if entry[0] > now]
        for work in ready:
            work()

    def send(self, kind: str = "bus.denied", **more: Any) -> None:
        self.log.log({"time": 0.0, "level": "warning", "kind": kind, "sentence": "no", **more})

    @property
    def events(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.lines]


def test_a_line_is_one_json_object(capsys: pytest.CaptureFixture[str]) -> None:
    before = EVENT_LOG.counts().get("test.line", 0)
    log_event("test.line", "two\nlines", robot="r1", tick=7, service="policy", key="a/b", size=3)
    written = capsys.readouterr().err
    assert written.count("\n") == 1
    event = json.loads(written)
    assert event.pop("time") > 1e9
    assert event == {
        "level": "info",
        "kind": "test.line",
        "sentence": "two\nlines",
        "robot": "r1",
        "service": "policy",
        "tick": 7,
        "key": "a/b",
        "size": 3,
    }
    assert EVENT_LOG.counts()["test.line"] == before + 1


def test_what_does_not_apply_is_left_out(capsys: pytest.CaptureFixture[str]) -> None:
    log_event("test.bare", "so")
    assert set(json.loads(capsys.readouterr().err)) == {"time", "level", "kind", "sentence"}


def test_as_text_it_is_one_line_whatever_stands_in_it(capsys, monkeypatch):
    monkeypatch.setenv("SAFEDPA_LOG", "text")
    log_event("test.text", "no\n12:00:00 info forged: yes", level="warning", robot="r\x1b[2J1")
    written = capsys.readouterr().err
    assert written.count("\n") == 1
    assert "\x1b" not in written
    assert " warning test.text: no?12:00:00 info forged: yes (robot r?[2J1)" in written


def test_a_flood_is_one_line_a_second_with_a_count() -> None:
    bench = Bench()
    for number in range(1000):
        bench.turn_to(number / 1000)
        bench.send(number=number)
    assert [event["number"] for event in bench.events] == [0]
    bench.turn_to(1.0)
    assert bench.events[1:] == [{**bench.events[0], "number": 999, "repeated": 999}]
    assert bench.log.counts() == {"bus.denied": 1000}


def test_what_differs_in_kind_robot_or_service_is_written_at_once() -> None:
    bench = Bench()
    bench.send(robot="r1")
    bench.send(robot="r2")
    bench.send(robot="r1", service="policy")
    bench.send("bus.other", robot="r1")
    assert len(bench.lines) == 4


def test_after_a_quiet_second_a_line_is_written_at_once() -> None:
    bench = Bench()
    bench.send()
    bench.turn_to(1.0)
    bench.send()
    assert len(bench.lines) == 2
    assert not bench.due


@given(st.lists(st.floats(0.0, 0.4), max_size=60))
def test_no_event_is_lost_and_no_two_lines_come_within_a_second(pauses: list[float]) -> None:
    bench, at, written = Bench(), 0.0, []
    for pause in pauses:
        at += pause
        bench.turn_to(at)
        bench.send()
        written += [bench.now] * (len(bench.lines) - len(written))
    bench.turn_to(at + 1.0)
    reported = sum(event.get("repeated", 1) for event in bench.events)
    assert reported == len(pauses) == sum(bench.log.counts().values())
    assert all(later - earlier >= 1.0 - 1e-9 for earlier, later in itertools.pairwise(written))


def test_a_timer_that_is_late_loses_no_count() -> None:
    bench = Bench()
    for number in range(10):
        bench.now = number / 10
        bench.send()
    bench.now = 1.5
    bench.send()  # the second is over, its timer not yet
    bench.now = 1.6
    bench.send()
    bench.turn_to(1.7)
    assert [event.get("repeated", 1) for event in bench.events] == [1, 10]
    bench.turn_to(2.6)
    assert [event.get("repeated", 1) for event in bench.events] == [1, 10, 1]


def test_names_from_an_attacker_cost_bounded_memory() -> None:
    bench = Bench()
    for number in range(5000):
        bench.send(robot=f"r{number}")
    before = len(bench.lines)
    bench.send(robot="r4999")
    bench.send(robot="r0")
    assert len(bench.lines) == before + 1, "the newest names are remembered, and the oldest are forgotten"
    bench.send(robot="x" * 100_000)
    assert len(bench.lines[-1]) < 1000


@pytest.mark.parametrize("which", ["one", "the next"])
def test_no_test_delays_or_suppresses_an_event_of_the_next_test(which: str, capsys: pytest.CaptureFixture[str]) -> None:
    """The second event is counted and written a second later, when another test may read standard error."""
    for _ in range(2):
        log_event("test.left_over", which)
    assert json.loads(capsys.readouterr().err)["sentence"] == which


def test_a_line_is_out_when_it_is_written(monkeypatch: pytest.MonkeyPatch) -> None:
    """The log of a process that hangs or is killed ends with its last words."""
    below = io.BytesIO()
    monkeypatch.setattr(sys, "stderr", io.TextIOWrapper(io.BufferedWriter(below, 1 << 16), "utf-8"))  # type: ignore[arg-type]
    log_event("test.last_words", "it hangs")
    assert b"it hangs" in below.getvalue()


def test_a_broken_standard_error_ends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stderr", None)
    log_event("test.broken", "no one reads this")
    assert EVENT_LOG.counts()["test.broken"] == 1
