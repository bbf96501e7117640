"""Untrusted work in a process of its own: its limits, how its end is reported, and which process is ended."""

import os
import resource
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.bus.fleet import Clock
from tests.waiting import until

from safedpa.bus.service.sandbox import JobProcess

pytestmark = pytest.mark.processes
MEMORY = "trying it took more than 1024 MiB of memory, or ended its process"


@pytest.fixture
def clock() -> Clock:
    """The clock of the twenty seconds that a work may take."""
    return Clock()


def opened(clock: Callable[[], float]) -> Iterator[JobProcess]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(__file__).parent))
        found = JobProcess("works:carry_out", clock)
        yield found
        found.close()


@pytest.fixture
def apart(clock: Clock) -> Iterator[JobProcess]:
    yield from opened(clock)


@pytest.fixture(scope="module")
def shared() -> Iterator[JobProcess]:
    """One process for many works."""
    yield from opened(lambda: 0.0)


def outcome_of(apart: JobProcess, work: Any) -> dict[str, Any] | None:
    found: list[Any] = []
    ticket = apart.submit(work)
    until(lambda: found or found.extend(filter(None, [ticket.outcome()])))
    return found[0] if found else None


def ended(process: int) -> bool:
    """Whether it is gone, or is kept only until its end is noticed."""
    try:
        return b") Z " in Path(f"/proc/{process}/stat").read_bytes()
    except OSError:
        return True


def test_a_work_has_five_seconds_of_processor_and_a_gibibyte_and_writes_no_file(shared: JobProcess) -> None:
    assert outcome_of(shared, "limits") == {
        "CPU": [5, 5], "AS": [1 << 30, 1 << 30], "CORE": [0, 0], "FSIZE": [0, 0],
    }  # fmt: skip
    assert resource.getrlimit(resource.RLIMIT_FSIZE)[0] != 0, "the limits are the work's alone"


def test_it_runs_behind_everybody_else(shared: JobProcess) -> None:
    assert outcome_of(shared, "priority") == {"nice": min(os.nice(0) + 5, 19), "policy": os.SCHED_OTHER}


@pytest.mark.parametrize(
    ("work", "outcome"),
    [
        ("a text", {"document": "a text"}),
        (("raise", ValueError("two\n  lines")), {"problem": "two lines"}),
        (("raise", ValueError("x" * 400)), {"problem": "x" * 300}),
        (("raise", KeyError()), {"problem": "KeyError"}),
        (("raise", ValueError("  \n")), {"problem": "ValueError"}),
        ("list", {"problem": "its answer cannot be read"}),
        (("kill", signal.SIGKILL), {"problem": "trying it took more than 5 s of processor time"}),
        (("kill", signal.SIGXCPU), {"problem": "trying it took more than 5 s of processor time"}),
        (
            ("kill", signal.SIGSEGV),
            {"problem": f"{MEMORY} (code -11)"},
        ),
        (("exit", 1), {"problem": f"{MEMORY} (code 1)"}),
        ("answer and go on", {"document": "early"}),
    ],
    ids=lambda value: str(value)[:24],
)
def test_the_outcome_of_a_work_or_its_error_is_reported_in_one_line(work, outcome, shared):
    """The next work is done all the same, also where a work goes on after its answer."""
    assert outcome_of(shared, work) == outcome
    assert outcome_of(shared, "next") == {"document": "next"}


def test_a_work_that_takes_twenty_seconds_is_given_up_and_its_process_is_killed(apart, clock, monkeypatch):
    """A work that waited behind it is reported at once, and does not end the process that is started next.

    On a busy machine a process at the lowest priority takes tens of milliseconds to die, with much memory more.
    """
    monkeypatch.setattr("subprocess.Popen.wait", lambda *_, **__: pytest.fail("the loop waited for a process to die"))
    first, second, process = apart.submit(("sleep", 600.0)), apart.submit("short"), apart.pid
    clock.now += 19.9
    assert (first.outcome(), apart.pid) == (None, process)
    clock.now += 0.2
    assert first.outcome() == {"problem": "it could not be tried within 20 s"}
    assert second.outcome() == {"problem": "it could not be tried: another work before it took too long"}
    assert until(lambda: ended(process))
    assert outcome_of(apart, "next") == {"document": "next"}
    assert apart.pid != process
    assert not Path(f"/proc/{process}").exists(), "it stays as a zombie"
    monkeypatch.undo()


def test_many_that_do_not_die_are_not_joined_by_more(apart: JobProcess, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("subprocess.Popen.poll", lambda _: None)
    for _ in range(4):
        apart.submit("short")
        apart.kill()
    assert "have not exited" in (apart.submit("short").outcome() or {})["problem"]
    assert apart.pid == 0
    monkeypatch.undo()


def test_waiting_for_an_outcome_ends_after_twenty_seconds(apart, clock, monkeypatch):
    ticket = apart.submit(("sleep", 600.0))
    monkeypatch.setattr(time, "sleep", lambda seconds: setattr(clock, "now", clock.now + seconds))
    assert ticket.outcome(wait=True) == {"problem": "it could not be tried within 20 s"}
    assert 120.0 <= clock.now < 120.1


def test_a_process_that_does_not_read_delays_the_loop_by_milliseconds(apart, clock, monkeypatch):
    apart.submit(("sleep", 600.0))
    monkeypatch.setattr(time, "sleep", lambda seconds: setattr(clock, "now", clock.now + seconds))
    large = apart.submit("x" * (8 << 20))
    assert 100.0 < clock.now < 100.004
    assert large.outcome() == {"problem": "it could not be tried (the worker is busy with other jobs)"}
