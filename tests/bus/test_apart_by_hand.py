"""What a work of strangers may take, what is told of its end, and which process is ended; with no process at all."""

from __future__ import annotations

import io
import json
import os
import pickle
import resource
import signal
import struct
import sys
from types import SimpleNamespace
from typing import Any

import pytest

from safedpa.bus.loop import apart as module
from safedpa.bus.loop.apart import Apart, serve

HEAD = struct.Struct("<IQ")


class Pipe:
    """One end of a pipe that only notes that it was closed."""

    def __init__(self, descriptor: int = -1) -> None:
        self.descriptor, self.closed = descriptor, 0

    def fileno(self) -> int:
        return self.descriptor

    def close(self) -> None:
        self.closed += 1


class Started:
    """In place of a process: lives until it is killed."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self.code: int | None = None
        self.stdin, self.stdout = Pipe(), Pipe()

    def poll(self) -> int | None:
        return self.code


class Bench:
    """An ``Apart`` whose processes are numbered from 1 on, with its clock; ``written`` of works, ``killed`` groups."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now, self.pids = 100.0, list[int]()
        self.killed: list[tuple[int, int]] = []
        self.takes = True
        self.slept = 0

        def start(apart: Any) -> None:
            self.pids.append(1 + len(self.pids))
            apart._process = Started(self.pids[-1])

        def write(_: int, content: bytes) -> int:
            if not self.takes:
                raise BlockingIOError
            return len(content)

        def sleep(seconds: float) -> None:
            self.slept += 1
            assert self.slept < 5000, "it waits for ever"
            self.now += seconds

        monkeypatch.setattr(Apart, "_start", start)
        monkeypatch.setattr(Apart, "_read", lambda _: None)
        monkeypatch.setattr(module.os, "write", write)
        monkeypatch.setattr(module.os, "killpg", lambda group, what: self.killed.append((group, what)))
        monkeypatch.setattr(module.time, "sleep", sleep)
        self.apart = Apart("module:name", lambda: self.now)


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    return Bench(monkeypatch)


def test_a_work_that_takes_twenty_seconds_is_given_up_and_its_process_killed_with_its_group(bench: Bench) -> None:
    """Whose work waited behind it is told at once, and the process that comes next is none of theirs to end."""
    first, second = bench.apart.hand_in("long"), bench.apart.hand_in("short")
    process: Any = bench.apart._process
    bench.now = 119.9
    assert first.outcome() is None
    assert bench.killed == []
    bench.now = 120.1
    assert first.outcome() == {"problem": "it could not be tried within 20 s"}
    assert bench.killed == [(1, signal.SIGKILL)]
    assert (process.stdin.closed, process.stdout.closed) == (1, 1)
    assert second.outcome() == {"problem": "it could not be tried: another work before it took too long"}
    assert bench.killed == [(1, signal.SIGKILL)]
    bench.apart.hand_in("next")
    assert bench.pids == [1, 2]


def test_who_waits_for_a_work_has_its_outcome_and_waits_until_its_time_is_over(bench: Bench) -> None:
    ticket = bench.apart.hand_in("long")
    bench.apart._found[1] = {"document": "d"}
    assert ticket.outcome(wait=True) == {"document": "d"}
    assert bench.now == 100.0
    late = bench.apart.hand_in("longer")
    assert late.outcome(wait=True) == {"problem": "it could not be tried within 20 s"}
    assert 120.0 < bench.now < 120.1


def test_a_process_that_does_not_read_keeps_the_loop_for_two_milliseconds(bench: Bench) -> None:
    bench.takes = False
    ticket = bench.apart.hand_in("work")
    assert 0.0 < bench.now - 100.0 < 0.004
    assert ticket.outcome() == {"problem": "it could not be tried (its process is busy with others)"}
    assert bench.killed == [(1, signal.SIGKILL)]


def test_no_process_is_started_while_four_that_were_killed_have_not_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[Started] = []

    def popen(*_: Any, **__: Any) -> Started:
        started.append(Started(1 + len(started)))
        return started[-1]

    monkeypatch.setattr("subprocess.Popen", popen)
    monkeypatch.setattr(module.os, "set_blocking", lambda *_: None)
    monkeypatch.setattr(module.fcntl, "fcntl", lambda *_: None)
    monkeypatch.setattr(module.os, "killpg", lambda *_: None)
    monkeypatch.setattr(module.os, "write", lambda _, content: len(content))
    monkeypatch.setattr(Apart, "_read", lambda _: None)
    apart = Apart("module:name")
    for count in (1, 2, 3):
        apart.give_up()
        apart.hand_in("work")
        assert len(started) == 1 + count
    apart.give_up()
    problem = {"problem": "it could not be tried (4 processes that were ended have not ended yet)"}
    assert apart.hand_in("work").outcome() == problem
    assert len(started) == 4
    started[0].code = -9
    assert apart.hand_in("work").outcome() is None
    assert len(started) == 5


class Sink(io.BytesIO):
    """Notes what was written when it was flushed."""

    def __init__(self) -> None:
        super().__init__()
        self.out = b""

    def flush(self) -> None:
        self.out = self.getvalue()


def test_each_outcome_is_out_before_the_next_work_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """Who waits for it hears nothing of what stays behind in this process."""
    sink, out_at = Sink(), list[int]()
    works = [b"one", b"three"]
    came = b"".join(HEAD.pack(7 + place, len(work)) + work for place, work in enumerate(works))

    def forked(_: Any, content: bytes) -> dict[str, Any]:
        out_at.append(sink.out.count(b"\n"))
        return {"length": len(content)}

    monkeypatch.setattr(module, "_forked", forked)
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=io.BytesIO(came[1:])))
    monkeypatch.setattr(sys, "stdout", SimpleNamespace(buffer=sink))
    serve(came[:1], "os.path:basename")
    assert [json.loads(line) for line in sink.out.splitlines()] == [
        {"length": 3, "number": 7},
        {"length": 5, "number": 8},
    ]
    assert out_at == [0, 1]


def refusing(what: Any) -> dict[str, Any]:
    raise what


def echoing(what: Any) -> dict[str, Any]:
    return {"document": what}


@pytest.mark.parametrize(
    ("work", "content", "found"),
    [
        (echoing, "d", {"document": "d"}),
        (refusing, ValueError("two\n  lines"), {"problem": "two lines"}),
        (refusing, ValueError("x" * 400), {"problem": "x" * 300}),
        (refusing, KeyError(), {"problem": "KeyError"}),
        (refusing, ValueError("  \n"), {"problem": "ValueError"}),
    ],
    ids=["done", "lines", "long", "wordless", "blank"],
)
def test_a_work_is_done_within_its_limits_and_its_error_told_in_one_line(
    work: Any, content: Any, found: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """5 s of processor, 1 GiB of memory, nothing written to any file, no core dump."""
    limits: dict[int, tuple[int, int]] = {}
    monkeypatch.setattr(module.resource, "setrlimit", limits.__setitem__)
    pipe = io.BytesIO()
    module._carry_out(work, pickle.dumps(content), pipe)
    assert json.loads(pipe.getvalue()) == found
    assert limits == {
        resource.RLIMIT_CPU: (5, 5),
        resource.RLIMIT_AS: (1_073_741_824, 1_073_741_824),
        resource.RLIMIT_CORE: (0, 0),
        resource.RLIMIT_FSIZE: (0, 0),
    }


@pytest.mark.parametrize(
    ("said", "status", "found"),
    [
        (b'{"document": "d"}', 0, {"document": "d"}),
        (b"[1]", 0, {"problem": "it answered nothing that can be read"}),
        (b"", signal.SIGKILL, {"problem": "trying it took more than 5 s of processor time"}),
    ],
)
def test_a_work_that_has_said_everything_is_ended_before_it_is_waited_for(
    said: bytes, status: int, found: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It may have closed its end and go on for as long as it likes."""
    ends, done = list[int](), list[Any]()
    pipe = os.pipe

    def piped() -> tuple[int, int]:
        ends.extend(pipe())
        return ends[0], ends[1]

    def fork() -> int:
        os.write(ends[1], said)
        return 4711

    def waitpid(child: int, _: int) -> tuple[int, int]:
        done.append(("awaited", child))
        return child, int(status)

    monkeypatch.setattr(module.os, "pipe", piped)
    monkeypatch.setattr(module.os, "fork", fork)
    monkeypatch.setattr(module.os, "kill", lambda child, what: done.append((what, child)))
    monkeypatch.setattr(module.os, "waitpid", waitpid)
    assert module._forked(echoing, b"") == found
    assert done == [(signal.SIGKILL, 4711), ("awaited", 4711)]
