"""How a process of the fleet ends: seen, at once, and never half."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from safedpa.bus import Bus, ZenohSettings, ZenohTransport

pytestmark = pytest.mark.processes

PROGRAM = """
import argparse, sys, threading, time
from safedpa.bus import STATE
from safedpa.bus.loop.process import add_bus_options, bus_from, run_process
from safedpa.errors import InputError

def work(options, stop):
    if options.fault == "input":
        raise InputError("scene: got none,\\nwanted one")
    with bus_from(options) as bus:
        bus.announce("r", "service", "x")
        if options.fault == "callback":
            def crash(key, payload):
                raise RuntimeError("planted in a callback")
            bus._transport.subscribe("safedpa/" + options.fleet + "/r/state", crash)
        print("ready", flush=True)
        if options.fault == "main":
            sys.stdin.readline()
            raise RuntimeError("planted in main")
        if options.fault == "thread":
            def crash_later():
                sys.stdin.readline()
                raise RuntimeError("planted in a thread")
            threading.Thread(target=crash_later).start()
        while not stop():
            time.sleep(0.02)
    print(stop.reason, flush=True)
    return 0

parser = argparse.ArgumentParser(prog="safedpa-test")
add_bus_options(parser)
parser.add_argument("--fault", default="")
run_process(work, parser)
"""


@contextmanager
def started(*options: str) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, *options],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()
        for pipe in (process.stdin, process.stdout, process.stderr):
            if pipe is not None:
                pipe.close()


def ready(process: subprocess.Popen[str]) -> None:
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"


def within(seconds: float, condition: Callable[[], bool]) -> bool:
    end = time.monotonic() + seconds
    pause = threading.Event()
    while not condition():
        if time.monotonic() > end:
            return False
        pause.wait(0.01)
    return True


@contextmanager
def watcher(port: int) -> Iterator[Bus]:
    with Bus(ZenohTransport(ZenohSettings(listen=(f"tcp/127.0.0.1:{port}",))), "crash-test") as bus:
        yield bus


@pytest.mark.parametrize("fault", ["main", "thread", "callback"])
def test_an_uncaught_error_ends_the_process_and_its_sign_of_life(fault: str, free_port: int) -> None:
    options = ("--fleet", "crash-test", "--connect", f"tcp/127.0.0.1:{free_port}", "--fault", fault)
    with watcher(free_port) as bus, started(*options) as process:
        ready(process)
        assert within(30.0, lambda: bus.instances("r", "service") == ["x"])
        if fault == "callback":

            def sent() -> bool:
                bus._transport.put("safedpa/crash-test/r/state", b"x", never_drop=True)
                return process.poll() is not None

            assert within(30.0, sent)
        else:
            assert process.stdin is not None
            process.stdin.write("now\n")
            process.stdin.flush()
            assert within(30.0, lambda: process.poll() is not None)
        assert within(5.0, lambda: bus.instances("r", "service") == []), "still announced seconds after its end"
        assert process.returncode == 70
        assert process.stderr is not None
        assert "RuntimeError: planted in" in process.stderr.read()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_it_in_good_order(number: signal.Signals, free_port: int) -> None:
    with started("--listen", f"tcp/127.0.0.1:{free_port}") as process:
        ready(process)
        process.send_signal(number)
        output, errors = process.communicate(timeout=30)
        assert (process.returncode, output, errors) == (0, f"{number.name}\n", "")


def test_a_supervised_process_ends_with_its_supervisor(free_port: int) -> None:
    with started("--listen", f"tcp/127.0.0.1:{free_port}", "--supervised") as process:
        ready(process)
        output, _ = process.communicate(timeout=30)  # closes its standard input
        assert (process.returncode, output) == (0, "the supervisor is gone\n")


def test_a_supervised_process_ends_when_all_its_pipes_break_at_once(free_port: int) -> None:
    with started("--listen", f"tcp/127.0.0.1:{free_port}", "--supervised") as process:
        ready(process)
        for pipe in (process.stdin, process.stdout, process.stderr):
            assert pipe is not None
            pipe.close()
        assert process.wait(timeout=30) in (0, 70), "it cannot say good-bye, but it goes"


def test_without_a_supervisor_it_outlives_its_standard_input(free_port: int) -> None:
    with started("--listen", f"tcp/127.0.0.1:{free_port}") as process:
        ready(process)
        assert process.stdin is not None
        process.stdin.close()
        process.stdin = None
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(timeout=0.5)
        process.terminate()
        assert process.wait(timeout=30) == 0


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("--listen", "garbage"), "wanted endpoints such as"),
        (("--listen", "tcp/127.0.0.1:99999"), "check the endpoints"),
        (("--fault", "input"), "scene: got none, wanted one"),
    ],
)
def test_bad_input_is_told_in_one_line(options: tuple[str, ...], sentence: str) -> None:
    with started(*options) as process:
        output, errors = process.communicate(timeout=60)
        assert process.returncode == 2
        assert output == ""
        assert errors.startswith("safedpa-test: ")
        assert sentence in errors
        assert errors.count("\n") == 1
