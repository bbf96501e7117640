"""A router whose own work is stationary ends, and says so; one that was merely stopped for a while does not."""

import json
import signal
import subprocess
import sys
import threading
import time

import pytest

from safedpa.bus import Bus
from safedpa.bus.transport.memory import MemoryBroker, MemoryTransport
from safedpa_services.router.refusals import Refusals
from safedpa_services.router.router import LoopWatchdog, Router


def test_a_router_that_waits_for_the_network_for_ever_ends_and_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    never, stalled = threading.Event(), threading.Event()

    def members() -> list[tuple[str, str]]:
        never.wait()
        return []

    with Bus(MemoryTransport(MemoryBroker()), "f") as bus:
        router = Router(bus, Refusals(), members)
        watchdog = LoopWatchdog(stalled.set, look_seconds=0.01)
        thread = threading.Thread(target=router.run, args=(never.is_set, watchdog), daemon=True)
        thread.start()
        assert stalled.wait(20.0)
        assert "main loop has hung" in json.loads(capsys.readouterr().err)["sentence"]
        never.set()
        thread.join(20.0)


def test_one_that_beats_goes_on(capsys: pytest.CaptureFixture[str]) -> None:
    stalled = threading.Event()
    watchdog = LoopWatchdog(stalled.set, look_seconds=0.02, looks=50)
    for _ in range(60):
        watchdog.beat()
        time.sleep(0.02)
    watchdog.end()
    assert not stalled.is_set()
    assert not capsys.readouterr().err


@pytest.mark.long
@pytest.mark.processes
def test_a_process_that_is_stopped_for_longer_goes_on_and_one_that_hangs_ends() -> None:
    program = (
        "import sys, threading, time\n"
        "from safedpa_services.router.router import LoopWatchdog\n"
        "pulse, hang = LoopWatchdog(look_seconds=0.05, looks=20), threading.Event()\n"
        "threading.Thread(target=lambda: (sys.stdin.readline(), hang.set()), daemon=True).start()\n"
        "while not hang.is_set():\n"
        "    pulse.beat()\n"
        "    print(1, flush=True)\n"
        "    time.sleep(0.05)\n"
        "time.sleep(600.0)\n"
    )
    command = [sys.executable, "-c", program]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "1\n"
        process.send_signal(signal.SIGSTOP)
        time.sleep(2.0)
        process.send_signal(signal.SIGCONT)
        for _ in range(20):
            assert process.stdout.readline() == "1\n", "it goes on"
        _, reported = process.communicate("hang\n", timeout=120.0)
    assert process.returncode == 1
    assert json.loads(reported)["kind"] == "router.stalled"
