"""Which process is started anew, asked, killed or waited for: each condition alone, with no process at all."""

from __future__ import annotations

import signal
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from safedpa.bus import VERDICT, Bus, HealthMessage, MemoryBroker, MemoryTransport, StateMessage, VerdictMessage
from safedpa.bus.wire.requests import Answer
from safedpa.errors import InputError
from safedpa_services.supervisor import child as module
from safedpa_services.supervisor import screen
from safedpa_services.supervisor import watch as watching
from safedpa_services.supervisor.child import Child
from safedpa_services.supervisor.story import Story
from safedpa_services.supervisor.supervisor import Supervisor
from safedpa_services.supervisor.view import view_of
from safedpa_services.supervisor.watch import Watch
from safedpa_services.terminal import terminal

STAMP = {"epoch": 1, "tick": 0, "robot_time": 0.0, "publish_time": 0.0}
REFUSED_ITS_INPUT, DIED = 2, 1


class Process:
    """What ``subprocess`` gives, with nothing behind it."""

    pid = 4711

    def __init__(self, code: int | None = None) -> None:
        self.code, self.asked = code, 0
        self.stdin = None

    def poll(self) -> int | None:
        return self.code

    def terminate(self) -> None:
        self.asked += 1

    def wait(self, _: float = 0.0) -> int:
        return self.code or 0


def child_of(tmp_path: Path, process: Process | None = None, **fields: Any) -> Child:
    child = Child("policy", "none", (), tmp_path / "log", **fields)
    child._process = process  # type: ignore[assignment]
    return child


@pytest.mark.parametrize(
    ("code", "begun", "essential", "done"),
    [
        (DIED, False, True, "started anew"),
        (DIED, True, False, "started anew"),
        (DIED, False, False, "started anew"),
        (REFUSED_ITS_INPUT, True, True, "started anew"),
        (REFUSED_ITS_INPUT, True, False, "started anew"),
        (REFUSED_ITS_INPUT, False, True, "the drive ends"),
        (REFUSED_ITS_INPUT, False, False, "left out"),
    ],
)
def test_what_died_is_started_anew_unless_it_would_refuse_its_input_once_more(
    code: int, begun: bool, essential: bool, done: str
) -> None:
    """Once a robot drives no drive ends by that; which of several robots drives makes no difference."""
    heard: list[str] = []
    died: Any = SimpleNamespace(
        name="policy", exit_code=code, essential=essential, last_words=lambda: "a word too many",
        restart_if_due=lambda: heard.append("started anew"),
    )  # fmt: skip
    watch: Any = SimpleNamespace(health={})
    robots: list[Any] = [SimpleNamespace(begun=False), SimpleNamespace(begun=begun)]
    for robot, others in ((robots[0], [(robots[1], watch)]), (robots[1], [(robots[0], watch)])):
        supervisor = Supervisor([died], robot, watch, lambda: False, lambda: None, others=others)
        if done == "the drive ends":
            with pytest.raises(InputError, match="a word too many"):
                supervisor._revive(died)
        else:
            supervisor._revive(died)
    assert heard == (["started anew"] * 2 if done == "started anew" else [])


@pytest.mark.parametrize(
    ("code", "told_before", "ends"),
    [(REFUSED_ITS_INPUT, False, True), (REFUSED_ITS_INPUT, True, False), (DIED, False, False)],
)
def test_a_robot_that_refuses_its_input_ends_the_drive_unless_it_ever_drove(
    code: int, told_before: bool, ends: bool
) -> None:
    heard: list[str] = []
    robot: Any = SimpleNamespace(
        name="robot", exit_code=code, essential=True, begun=True, last_words=lambda: "no such scene",
        restart_if_due=lambda: heard.append("started anew"),
    )  # fmt: skip
    watch: Any = SimpleNamespace(health={"robot": object()} if told_before else {})
    supervisor = Supervisor([], robot, watch, lambda: False, lambda: None)
    if ends:
        with pytest.raises(InputError, match="no such scene"):
            supervisor._revive(robot)
    else:
        supervisor._revive(robot)
    assert heard == ([] if ends else ["started anew"])


@pytest.mark.parametrize(
    ("started", "waits", "told", "begun"),
    [
        (False, False, False, False),
        (False, True, True, False),
        (True, False, False, True),
        (True, True, False, False),
        (True, True, True, True),
    ],
)
def test_the_work_of_who_waits_for_a_word_begins_with_it_and_that_of_others_at_once(
    started: bool, waits: bool, told: bool, begun: bool, tmp_path: Path
) -> None:
    child = child_of(tmp_path, Process() if started else None, waits=waits)
    child._told = told
    assert child.begun is begun


@pytest.mark.parametrize(
    ("waits", "told", "asked_to_wait"), [(True, False, True), (True, True, False), (False, False, False)]
)
def test_only_who_waits_and_was_not_told_yet_is_started_to_wait(
    waits: bool, told: bool, asked_to_wait: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands: list[list[str]] = []

    def opened(command: list[str], **_: Any) -> Process:
        commands.append(command)
        return Process()

    monkeypatch.setattr(module.subprocess, "Popen", opened)
    child = child_of(tmp_path, waits=waits)
    child._told = told
    child.start()
    assert ("--await-word" in commands[0]) is asked_to_wait
    assert "--supervised" in commands[0]


@pytest.mark.parametrize(("code", "killed"), [(None, True), (0, False), (-9, False)])
def test_only_what_runs_is_killed_or_asked_to_end_and_asked_once(
    code: int | None, killed: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The number of a process that has ended may be somebody else's by now."""
    groups: list[tuple[int, int]] = []
    monkeypatch.setattr(module.os, "killpg", lambda group, what: groups.append((group, what)))
    process = Process(code)
    child = child_of(tmp_path, process)
    child.kill()
    assert groups == ([(4711, signal.SIGKILL)] if killed else [])
    for _ in range(3):
        child.terminate()
    assert process.asked == killed
    never = child_of(tmp_path)
    never.kill()
    never.terminate()
    never.end(0.0)
    assert len(groups) == killed


def watched() -> Watch:
    return Watch(Bus(MemoryTransport(MemoryBroker()), "fleet"))


def state_of(values: tuple[float, ...], corridor: tuple[float, ...] = ()) -> StateMessage:
    return StateMessage(
        **STAMP, values=values, applied=(0.0, 0.0), applied_by="filter", period=0.05, lockstep=True, goal=(),
        obstacles=(), field=(), footprint=(), corridor=corridor,
    )  # fmt: skip


def verdict_of(status: str, **fields: Any) -> VerdictMessage:
    what = {**STAMP, "sentence": "", "action": (0.0, 0.0), "wish": (), "slack": 0.0, "active": (), "h_now": 1.0}
    what |= {"h_next": 1.0, "margin": 0.0, "solver": "", "microseconds": 1.0, "status": status}
    return VerdictMessage(**{**what, **fields})


@pytest.mark.parametrize(
    ("state", "verdict", "stands"),
    [
        (None, None, False),
        (None, verdict_of("stopped"), False),
        (state_of((0.0, 0.0, 0.0, 0.0)), None, False),
        (state_of((0.0, 0.0, 0.0, 0.0)), verdict_of("passed"), False),
        (state_of((0.0, 0.0, 0.0, 0.02)), verdict_of("stopped"), True),
        (state_of((0.0, 0.0, 0.0, -0.02)), verdict_of("stopped"), True),
        (state_of((0.0, 0.0, 0.0, 0.021)), verdict_of("stopped"), False),
        (state_of((0.0, 0.0, 0.0, -0.021)), verdict_of("stopped"), False),
        (state_of((0.0, 0.0, 0.0, 1.0), (0.1, 0.1)), verdict_of("stopped"), True),
        (state_of((0.0, 1.0)), verdict_of("stopped"), True),
    ],
)
def test_a_robot_stands_that_was_ordered_to_and_of_a_car_the_wheels_as_well(
    state: StateMessage | None, verdict: VerdictMessage | None, stands: bool
) -> None:
    watch = watched()
    watch.state, watch.verdict = state, verdict
    assert watch.stands() is stands


def test_a_verdict_that_is_repeated_counts_once_and_another_robots_never() -> None:
    """Of the same tick in another epoch, or of the same epoch in another tick, it is another."""
    broker = MemoryBroker()
    watch, bus = Watch(Bus(MemoryTransport(broker), "fleet")), Bus(MemoryTransport(broker), "fleet")
    for epoch, tick, robot in ((1, 0, "r1"), (1, 0, "r1"), (1, 1, "r1"), (2, 1, "r1"), (2, 2, "r2"), (2, 1, "r1")):
        bus.publish(VERDICT, robot, verdict_of("passed", epoch=epoch, tick=tick))
        watch.listen(0.0)
    assert watch.verdicts == {"passed": 3}


def health_of(service: str) -> HealthMessage:
    return HealthMessage(
        **STAMP, service=service, pid=4711, state="running", detail="", steps=1, stale=0, refused=0, latencies=()
    )


@pytest.mark.parametrize(
    ("silent", "code", "heartbeat", "shown"),
    [
        (0.5, None, True, "running"),
        (1.2, None, True, "silent"),
        (5.0, None, True, "silent"),
        (5.0, None, False, "running"),
        (0.5, -9, True, "ended"),
        (None, None, True, "starting"),
    ],
)
def test_the_table_says_of_each_process_whether_it_speaks(
    silent: float | None, code: int | None, heartbeat: bool, shown: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four heartbeats a second: silence of a second is shown."""
    monkeypatch.setattr(watching, "time", SimpleNamespace(monotonic=lambda: 1000.0))
    watch = watched()
    if silent is not None:
        watch.health["policy"] = (health_of("policy"), 1000.0 - silent)
    child = child_of(tmp_path, Process(code), heartbeat=heartbeat)
    console = terminal()
    with console.capture() as caught:
        console.print(view_of(watch, [], child, []))
    (row,) = [line for line in caught.get().splitlines() if line.startswith("policy")]
    assert row.split()[1] == shown


@pytest.mark.parametrize(
    ("verdict", "told"),
    [
        (None, False),
        (verdict_of("corrected"), False),
        (verdict_of("corrected", stands=7.0, standstill="the wall is near"), True),
    ],
)
def test_why_it_stands_is_shown_where_the_verdict_says_so(
    verdict: VerdictMessage | None, told: bool, tmp_path: Path
) -> None:
    watch = watched()
    watch.verdict = verdict
    console = terminal()
    with console.capture() as caught:
        console.print(view_of(watch, [], child_of(tmp_path), []))
    said = caught.get()
    assert ("stands for 7 s, the wall is near" in said) is told
    assert ("stands for" in said) is told


@pytest.mark.parametrize(
    ("pending", "candidates", "accepted"),
    [("", ("drag",), True), ("take", ("drag",), False), ("", ("tow",), False), ("", (), False), ("offer", (), False)],
)
def test_what_is_no_candidate_any_more_or_comes_amid_a_change_is_not_accepted(
    pending: str, candidates: tuple[str, ...], accepted: bool
) -> None:
    broker, asked = MemoryBroker(), list[str]()

    def answer(_: str, request: Any) -> Answer:
        asked.append(request.do)
        return Answer(ok=True, sentence="so be it", fingerprint="a", finding=1, candidates=candidates, pending=pending)

    diagnosis = Bus(MemoryTransport(broker), "fleet")
    diagnosis.answer_requests(answer)
    Story(Bus(MemoryTransport(broker), "fleet"), "r1", lambda _: None, True)._accept("drag")
    assert asked == (["status", "accept"] if accepted else ["status"])


def test_a_page_that_does_not_answer_keeps_the_supervisors_turn_for_a_twentieth_of_a_second(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It is asked for four times a second, beside all that the turn has to do; once it answered, not again."""
    now, asked = [50.0], list[float]()

    def connected(_: tuple[str, int], seconds: float) -> Any:
        asked.append(now[0])
        now[0] += seconds
        if len(asked) < 5:
            raise TimeoutError
        return SimpleNamespace(close=lambda: None)

    monkeypatch.setattr(screen.socket, "create_connection", connected)
    monkeypatch.setattr(screen, "time", SimpleNamespace(monotonic=lambda: now[0]))
    page, told = screen._Page("http://127.0.0.1:8080"), list[str]()
    while now[0] < 60.0 and not told:
        before = now[0]
        told = page.lines()
        assert now[0] - before <= 0.06
        now[0] += 0.01
    assert told == ["workbench http://127.0.0.1:8080"]
    assert [later - earlier for earlier, later in pairwise(asked)] == pytest.approx([0.25] * 4, abs=0.015)
    assert page.lines() == told
    assert len(asked) == 5
    assert screen._Page("").lines() == []
