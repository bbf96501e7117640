"""How the process of a service ends: its exit code, its last words, and that they are out; the process goes on."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
from collections.abc import Callable
from typing import Any

import pytest

from safedpa.bus.loop import process as module
from safedpa.bus.loop.process import Stop, lifetime, run_process
from safedpa.errors import BusError, InputError, JoinError

Work = Callable[[argparse.Namespace, Stop], int]


class Ended(BaseException):
    """In place of the end of the process."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


class Stream:
    """Standard output or error: what was written, and how much of it when it was flushed last."""

    def __init__(self) -> None:
        self.said, self.out = "", ""

    def write(self, text: str) -> int:
        self.said += text
        return len(text)

    def flush(self) -> None:
        self.out = self.said


@pytest.fixture
def streams(monkeypatch: pytest.MonkeyPatch) -> tuple[Stream, Stream]:
    def end(code: int) -> None:
        raise Ended(code)

    found = Stream(), Stream()
    monkeypatch.setattr(module.os, "_exit", end)
    monkeypatch.setattr(module, "as_many_descriptors_as_allowed", lambda: None)
    monkeypatch.setattr(sys, "argv", ["safedpa-test"])
    monkeypatch.setattr(sys, "excepthook", sys.excepthook)
    monkeypatch.setattr(threading, "excepthook", threading.excepthook)
    return found


def ended(work: Work, streams: tuple[Stream, Stream]) -> int:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stdout", streams[0])
        patch.setattr(sys, "stderr", streams[1])
        with pytest.raises(Ended) as caught:
            run_process(work, argparse.ArgumentParser(prog="safedpa-test"))
    return caught.value.code


def raising(error: Exception) -> Work:
    def work(_: argparse.Namespace, __: Stop) -> int:
        raise error

    return work


@pytest.mark.parametrize(
    ("error", "code"), [(InputError("scene: got none"), 2), (BusError("no port"), 2), (JoinError("no router"), 75)]
)
def test_what_is_wrong_is_told_in_one_line_and_who_was_not_let_in_may_try_again(
    error: Exception, code: int, streams: tuple[Stream, Stream]
) -> None:
    assert ended(raising(error), streams) == code
    assert streams[1].out == f"safedpa-test: {error}\n"


def test_a_process_ends_with_the_code_of_its_work_and_all_that_it_said_is_out(streams: tuple[Stream, Stream]) -> None:
    def work(options: argparse.Namespace, stop: Stop) -> int:
        sys.stdout.write("the last word")
        sys.stderr.write("and a warning")
        return 3 if not stop() and not options.supervised else 4

    assert ended(work, streams) == 3
    assert (streams[0].out, streams[1].out) == ("the last word", "and a warning")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_the_first_signal_ends_in_order_and_the_second_at_once(
    number: signal.Signals, streams: tuple[Stream, Stream]
) -> None:
    """130 as of a shell: what was not finished is left."""
    seen: list[Any] = []

    def work(_: argparse.Namespace, stop: Stop) -> int:
        signal.raise_signal(number)
        seen.extend((stop(), stop.hurried, stop.reason))
        signal.raise_signal(number)
        return 0

    assert ended(work, streams) == 130
    assert seen == [True, False, number.name]


@pytest.mark.parametrize(
    ("kind", "value", "said"),
    [(RuntimeError, RuntimeError("planted"), "RuntimeError: planted"), (KeyError, None, "KeyError")],
)
def test_an_error_on_any_thread_ends_the_process_with_its_words(
    kind: type[Exception], value: Exception | None, said: str, streams: tuple[Stream, Stream]
) -> None:
    codes: list[int] = []

    def work(_: argparse.Namespace, __: Stop) -> int:
        told: Any = threading.ExceptHookArgs((kind, value, None, threading.current_thread()))
        with pytest.raises(Ended) as caught:
            threading.excepthook(told)
        codes.append(caught.value.code)
        return 0

    assert ended(work, streams) == 0
    assert codes == [70]
    assert streams[1].out.splitlines()[-1].strip() == said


@pytest.mark.parametrize("reason", ["SIGTERM", "the supervisor is gone", ""])
def test_why_a_service_ends_in_order_stands_in_its_log(reason: str, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[tuple[str, str]] = []
    monkeypatch.setattr(module, "log_event", lambda kind, sentence, **_: told.append((kind, sentence)))
    stop = Stop()
    with lifetime("policy", stop):
        if reason:
            stop.set(reason)
            stop.set("something that comes later")
    assert [kind for kind, _ in told] == ["process.started", "process.ended"]
    assert told[1][1].endswith(f": {reason or 'its work is done'}")


def test_who_is_supervised_begins_at_the_word_and_ends_when_standard_input_closes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pieces = iter([b"begin\n", b""])
    begun: list[bool] = []

    def read(_: int, __: int) -> bytes:
        piece = next(pieces)
        begun.append(stop._word.is_set())
        return piece

    stop = Stop()
    monkeypatch.setattr(sys, "stdin", open(os.devnull, "rb"))  # noqa: SIM115  closed below
    monkeypatch.setattr(module.os, "read", read)
    module._watch_supervisor(stop)
    sys.stdin.close()
    assert begun == [False, True]
    assert (stop(), stop.reason) == (True, "the supervisor is gone")
