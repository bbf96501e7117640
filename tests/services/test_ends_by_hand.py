"""How processes begin and end under the supervisor: each word, signal and wait alone, with no process at all."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from tests.services.test_children_by_hand import Process, child_of, health_of, state_of, watched
from tests.services.test_supervised_by_hand import Hearing, Noting

from safedpa.bus.wire.requests import Answer
from safedpa.errors import BusError, SafedpaError
from safedpa_services.supervisor import child as child_module
from safedpa_services.supervisor import supervisor as module
from safedpa_services.supervisor import watch as watching
from safedpa_services.supervisor.supervisor import Supervisor


@pytest.mark.parametrize(("waits", "piped", "told"), [(True, True, True), (False, True, False), (True, False, False)])
def test_only_who_waits_for_a_word_is_told_one(waits: bool, piped: bool, told: bool, tmp_path: Path) -> None:
    reading, writing = os.pipe()
    os.set_blocking(reading, False)
    process: Any = Process()
    with open(writing, "wb", buffering=0) as pipe:
        process.stdin = pipe if piped else None
        child = child_of(tmp_path, process, waits=waits)
        child.begin()
    with open(reading, "rb") as said:
        assert said.read() == (b"begin\n" if told else b"")
    assert child.begun


@pytest.mark.parametrize(("obeys", "killed"), [(True, []), (False, [4711])])
def test_who_does_not_end_when_asked_is_killed_with_its_group_after_its_patience(
    obeys: bool, killed: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    groups, waits = list[int](), list[float]()
    monkeypatch.setattr(child_module.os, "killpg", lambda group, _: groups.append(group))

    class Slow(Process):
        def wait(self, seconds: float = -1.0) -> int:
            waits.append(seconds)
            if seconds >= 0.0 and not obeys:
                raise subprocess.TimeoutExpired("it", seconds)
            return 0

    process: Any = Slow()
    closed: list[int] = []
    process.stdin = SimpleNamespace(close=lambda: closed.append(1))
    child_of(tmp_path, process).end(6.0)
    assert (process.asked, groups, waits[0], closed) == (1, killed, 6.0, [1])
    assert waits[1:] == ([] if obeys else [-1.0]), "until it is gone"


@pytest.mark.parametrize(
    ("told", "pid", "silent", "hung"),
    [(True, 4711, 10.5, True), (True, 4711, 9.5, False), (True, 7, 10.5, False), (False, 4711, 10.5, False)],
)
def test_only_the_process_that_spoke_and_fell_silent_has_hung(
    told: bool, pid: int, silent: float, hung: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that was started in its place has its time to begin."""
    monkeypatch.setattr(watching, "time", SimpleNamespace(monotonic=lambda: 1000.0))
    watch = watched()
    if told:
        watch.health["policy"] = (health_of("policy"), 1000.0 - silent)
    assert watch.has_hung("policy", pid, 10.0) is hung
    assert watch.silent_for("policy") == (pytest.approx(silent) if told else float("inf"))


@pytest.mark.parametrize(
    ("state", "answer", "took"),
    [
        (True, Answer(ok=True, sentence=""), True),
        (True, Answer(ok=False, sentence="refused"), False),
        (True, None, False),
        (True, BusError("closed"), False),
        (False, Answer(ok=True, sentence=""), False),
    ],
)
def test_an_order_to_stop_was_taken_where_the_filter_says_so(
    state: bool, answer: Any, took: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    watch = watched()
    watch.state = state_of((0.0, 0.0, 0.0, 1.0)) if state else None
    asked: list[tuple[str, str, float]] = []

    def request(robot: str, what: Any, seconds: float, kind: str) -> Any:
        asked.append((robot, what.do, seconds))
        assert kind == "order"
        if isinstance(answer, Exception):
            raise answer
        return answer

    monkeypatch.setattr(watch.bus, "request", request)
    assert watch.stop_robot() is took
    assert [(robot, do) for robot, do, _ in asked] == ([("r1", "stop")] if state else [])
    assert all(1.0 <= seconds <= 4.0 for _, _, seconds in asked)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [0.0]

    def sleep(seconds: float) -> None:
        now[0] += seconds

    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: now[0], sleep=sleep))
    return now


@pytest.mark.parametrize(("stopped_at", "waited"), [(0.0, 0.0), (1.0, 1.0), (99.0, 5.0)])
def test_who_is_told_to_stop_waits_for_the_other_robots_no_longer(
    stopped_at: float, waited: float, clock: list[float]
) -> None:
    watch: Any = Hearing(clock, {}, 0.0)
    first, other = Noting("robot", []), Noting("robot 2", [])
    supervisor = Supervisor(
        [], first, watch, lambda: clock[0] >= stopped_at, lambda: None, others=[(other, watch)]  # type: ignore[arg-type, list-item]
    )  # fmt: skip
    supervisor._await_others()
    assert clock[0] == pytest.approx(waited, abs=0.06)


@pytest.mark.parametrize("hurried", [False, True])
def test_who_is_in_a_hurry_orders_nobody_to_stop(hurried: bool, clock: list[float]) -> None:
    """The order waits for its answer."""
    asked: list[int] = []

    class Asked(Hearing):
        def stop_robot(self) -> bool:
            asked.append(1)
            return False

    watch: Any = Asked(clock, {}, 0.0)
    robot: Any = Noting("robot", [])
    Supervisor([], robot, watch, lambda: True, lambda: None, lambda: hurried)._brake()
    assert asked == ([] if hurried else [1])


@pytest.mark.parametrize(
    ("hurried_at", "ends_at", "stands_at", "waited"),
    [(1.0, 99.0, 99.0, 1.0), (99.0, 2.0, 99.0, 2.0), (99.0, 99.0, 3.0, 3.0), (99.0, 99.0, 99.0, 5.0)],
)
def test_it_waits_for_a_robot_to_stand_until_it_stands_or_ends_or_somebody_is_in_a_hurry(
    hurried_at: float, ends_at: float, stands_at: float, waited: float, clock: list[float]
) -> None:
    class Driving(Noting):
        exit_code = property(lambda _: 0 if clock[0] >= ends_at else None, lambda _, __: None)  # type: ignore[assignment]

    watch: Any = Hearing(clock, {}, stands_at)
    robot: Any = Driving("robot", [])
    Supervisor([], robot, watch, lambda: True, lambda: None, lambda: clock[0] >= hurried_at)._brake()
    assert clock[0] == pytest.approx(waited, abs=0.06)


@pytest.mark.parametrize(("essential", "restarts", "waited"), [(True, 0, 120.0), (True, 1, 30.0), (False, 0, 0.0)])
def test_what_is_not_heard_ends_the_start_after_its_time_and_what_only_looks_on_does_not(
    essential: bool, restarts: int, waited: float, clock: list[float]
) -> None:
    service: Any = Noting("policy", [], essential=essential)
    service.restarts, service.last_words = restarts, lambda: "it says why"
    watch: Any = Hearing(clock, {}, 0.0)
    supervisor = Supervisor([service], None, watch, lambda: clock[0] > 500.0, lambda: None)
    if essential:
        with pytest.raises(SafedpaError, match=r"policy: not ready after \d+ s: it says why"):
            supervisor._await_services()
    else:
        supervisor._await_services()
    assert clock[0] == pytest.approx(waited, abs=0.11)


@pytest.mark.parametrize("stopped_at", [0.0, 1.0, 30.0])
def test_who_is_stopped_while_services_start_waits_no_longer_and_nothing_drives(
    stopped_at: float, clock: list[float]
) -> None:
    """A person who presses Ctrl-C meanwhile would look at nothing for two minutes."""
    done: list[Any] = []
    service: Any = Noting("policy", done)
    robot: Any = Noting("robot", done, begun=False)
    watch: Any = Hearing(clock, {}, 0.0)
    supervisor = Supervisor([service], robot, watch, lambda: clock[0] >= stopped_at, lambda: None)
    assert supervisor.run() == 0
    assert clock[0] == pytest.approx(stopped_at, abs=0.26)
    assert not robot.begun
    assert [name for name, what in done if what == "asked"] == ["robot", "policy"]


def test_the_robots_begin_when_the_services_are_heard_and_not_before(clock: list[float]) -> None:
    """One that needs nothing of its own is not waited for, nor is one that only looks on."""
    began: list[float] = []

    class Beginning(Noting):
        def begin(self) -> None:
            super().begin()
            began.append(clock[0])

    class Later(Hearing):
        def listen(self, wait: float) -> None:
            super().listen(wait)
            if clock[0] >= 2.0:
                self.health["policy"] = object()

    watch: Any = Later(clock, {}, 0.0)
    services: list[Any] = [Noting("policy", []), Noting("recorder", [], essential=False)]
    robots: list[Any] = [Beginning("robot", [], begun=False), Beginning("robot 2", [], begun=False)]
    supervisor = Supervisor(
        services, robots[0], watch, lambda: clock[0] > 3.0, lambda: None, others=[(robots[1], watch)]
    )
    supervisor.run()
    assert began == pytest.approx([2.0, 2.0], abs=0.06)
