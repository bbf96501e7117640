"""Later, in order, by one thread."""

import json
import threading
import time

import pytest

from safedpa.bus.logging import DelayedCaller, EventLog


def alarm_threads() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "safedpa-alarm"]


def ended(threads: list[threading.Thread]) -> None:
    for thread in threads:
        thread.join(10.0)
        assert not thread.is_alive()


def test_each_work_is_done_once_at_its_moment_in_the_order_of_moments() -> None:
    alarm, done, begun = DelayedCaller(), list[tuple[str, float]](), time.monotonic()
    before = alarm_threads()
    for name, seconds in (("last", 0.3), ("first", 0.1), ("second", 0.2), ("at once", -1.0)):
        alarm(seconds, lambda name=name: done.append((name, time.monotonic() - begun)))  # type: ignore[misc]
    mine = [thread for thread in alarm_threads() if thread not in before]
    ended(mine)
    assert [name for name, _ in done] == ["at once", "first", "second", "last"]
    for (_, at), least in zip(done, (0.0, 0.1, 0.2, 0.3), strict=True):
        assert at >= least
    assert len(mine) == 1


def test_of_one_moment_the_first_comes_first() -> None:
    alarm, done, gate = DelayedCaller(), list[int](), threading.Event()
    alarm(-1.0, lambda: gate.wait(10.0) and None)
    for number in range(20):
        alarm(-1.0, lambda number=number: done.append(number))  # type: ignore[misc]
    gate.set()
    deadline = time.monotonic() + 10.0
    while len(done) < 20 and time.monotonic() < deadline:
        time.sleep(0.01)
    assert done == list(range(20))


def test_when_nothing_is_left_its_thread_ends_and_the_next_work_has_another() -> None:
    alarm, done = DelayedCaller(), list[int]()
    for number in range(3):
        before = alarm_threads()
        alarm(0.01, lambda number=number: done.append(number))  # type: ignore[misc]
        ended([thread for thread in alarm_threads() if thread not in before])
    assert done == [0, 1, 2]


def test_work_that_fails_is_reported_and_the_other_work_is_done(capsys: pytest.CaptureFixture[str]) -> None:
    alarm, done = DelayedCaller(), list[int]()
    before = alarm_threads()
    alarm(0.0, lambda: {}.pop(0))
    alarm(0.05, lambda: done.append(1))
    ended([thread for thread in alarm_threads() if thread not in before])
    assert done == [1]
    assert "KeyError" in capsys.readouterr().err


def test_a_log_with_a_hundred_robots_in_trouble_has_one_thread_more(capsys: pytest.CaptureFixture[str]) -> None:
    """A thread for each of two hundred robots and kinds a second would make a late service later."""
    lines: list[str] = []
    log = EventLog(lines.append)
    before = alarm_threads()
    running = threading.active_count()
    for _ in range(3):
        for number in range(100):
            log.log({"time": 0.0, "level": "info", "kind": "a", "sentence": "no", "robot": f"r{number}"})
    assert threading.active_count() <= running + 1
    ended([thread for thread in alarm_threads() if thread not in before])
    assert len(lines) == 200
    assert [json.loads(line).get("repeated") for line in lines] == [None] * 100 + [2] * 100
    assert not capsys.readouterr().err
