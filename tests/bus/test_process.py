"""How a process of the fleet ends: seen, at once, and never half."""

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from tests.waiting import until

from safedpa.bus import Bus, ZenohSettings, ZenohTransport
from safedpa.bus.service.process import StopSignal, log_lifetime

pytestmark = pytest.mark.processes

PROGRAM = """
import argparse, sys, threading, time
from safedpa.bus import Bus, ZenohTransport
from safedpa.bus.service.process import add_bus_options, log_lifetime, run_process, transport_settings_from_options
from safedpa.errors import InputError, JoinError

def work(options, stop):
    if options.fault == "input":
        raise InputError("scene: got none,\\nwanted one")
    if options.fault == "router":
        raise JoinError("no router")
    if options.fault in ("code", "word"):
        if options.fault == "word":
            stop.wait_for_start()
        print("the last word", stop())
        sys.stderr.write("a warning")
        return 3
    transport = ZenohTransport(transport_settings_from_options(options))
    with Bus(transport, options.fleet) as bus, log_lifetime("test", stop):
        bus.announce("r", "service", "x")
        if options.fault == "callback":
            def crash(key, payload):
                raise RuntimeError("planted in a callback")
            transport.subscribe("safedpa/" + options.fleet + "/r/state", crash)
        if options.fault == "answer":
            def mute(key, payload):
                raise RuntimeError("planted in an answer")
            transport.answer("safedpa/" + options.fleet + "/r/request", mute)
        print("ready", flush=True)
        if options.fault == "main":
            sys.stdin.readline()
            raise RuntimeError("planted in main")
        if options.fault == "thread":
            def crash_later():
                sys.stdin.readline()
                raise RuntimeError("planted in a thread")
            threading.Thread(target=crash_later).start()
        while not stop() or options.fault == "stays":
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


@pytest.mark.parametrize("fault", ["main", "thread", "callback", "answer"])
def test_an_uncaught_error_ends_the_process_and_its_sign_of_life(fault: str, free_port: int) -> None:
    options = ("--fleet", "crash-test", "--connect", f"tcp/127.0.0.1:{free_port}", "--fault", fault)
    transport = ZenohTransport(ZenohSettings(listen=(f"tcp/127.0.0.1:{free_port}",)))
    with Bus(transport, "crash-test") as bus, started(*options) as process:
        ready(process)
        assert until(lambda: bus.instances("r", "service") == ["x"], 30.0)
        if fault in ("callback", "answer"):

            def sent() -> bool:
                transport.put("safedpa/crash-test/r/state", b"x", never_drop=True)
                transport.ask("safedpa/crash-test/r/request", b"x", 0.1)
                return process.poll() is not None

            assert until(sent, 30.0)
        else:
            assert process.stdin is not None
            process.stdin.write("now\n")
            process.stdin.flush()
            assert until(lambda: process.poll() is not None, 30.0)
        assert until(lambda: bus.instances("r", "service") == [], 5.0), "still announced seconds after its end"
        assert process.returncode == 70
        assert process.stderr is not None
        assert "RuntimeError: planted in" in process.stderr.read()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_it_in_good_order(number: signal.Signals, free_port: int) -> None:
    with started("--listen", f"tcp/127.0.0.1:{free_port}") as process:
        ready(process)
        process.send_signal(number)
        output, errors = process.communicate(timeout=30)
        assert (process.returncode, output) == (0, f"{number.name}\n")
        kinds = [json.loads(line) for line in errors.splitlines()]
        assert [line["kind"] for line in kinds] == ["process.started", "process.ended"]
        assert kinds[1]["sentence"] == f"test shuts down: {number.name}"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_second_signal_ends_it_at_once(number: signal.Signals, free_port: int) -> None:
    """130, as of a shell: whatever was not finished stays undone."""
    with started("--listen", f"tcp/127.0.0.1:{free_port}", "--fault", "stays") as process:
        ready(process)
        process.send_signal(number)
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(timeout=0.5)
        process.send_signal(number)
        assert process.wait(timeout=30) == 130


@pytest.mark.parametrize("reason", ["SIGTERM", ""])
def test_the_log_says_why_a_service_ends_and_the_first_reason_counts(reason: str, capsys: pytest.CaptureFixture[str]):
    stop = StopSignal()
    with log_lifetime("policy", stop):
        for why in (reason, "a later one") if reason else ():
            stop.set(why)
    started, ended = map(json.loads, capsys.readouterr().err.splitlines())
    assert (started["kind"], ended["kind"]) == ("process.started", "process.ended")
    assert ended["sentence"] == f"policy shuts down: {reason or 'its work is done'}"


def test_it_ends_with_the_code_of_its_work_and_everything_it_wrote_is_out() -> None:
    with started("--fault", "code") as process:
        output, errors = process.communicate(timeout=60)
    assert (process.returncode, output, errors) == (3, "the last word False\n", "a warning")


@pytest.mark.parametrize(("word", "ended"), [("begin\n", False), ("", True)])
def test_a_supervised_process_waits_for_the_word_to_begin_or_for_the_end(word: str, ended: bool) -> None:
    with started("--fault", "word", "--supervised") as process:
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(timeout=0.5)
        assert process.stdin is not None
        if ended:
            output, _ = process.communicate(timeout=30)
        else:
            process.stdin.write(word)
            process.stdin.flush()
            assert process.stdout is not None
            output = process.stdout.readline()
    assert output == f"the last word {ended}\n"


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
    ("options", "sentence", "code"),
    [
        (("--listen", "garbage"), "wanted endpoints such as", 2),
        (("--listen", "tcp/127.0.0.1:99999"), "check the endpoints", 2),
        (("--fault", "input"), "scene: got none,\\x0awanted one", 2),
        (("--fault", "router"), "no router", 75),
    ],
)
def test_bad_input_is_reported_in_one_line_and_a_failed_join_may_be_tried_again(options, sentence, code):
    with started(*options) as process:
        output, errors = process.communicate(timeout=60)
        assert process.returncode == code
        assert output == ""
        assert errors.startswith("safedpa-test: ")
        assert sentence in errors
        assert errors.count("\n") == 1
