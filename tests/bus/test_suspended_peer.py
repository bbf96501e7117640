"""A peer that was suspended for longer than its lease, as a stopped process or a paused container is."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from tests.bus.fleet import Heard
from tests.waiting import until

from safedpa.bus import ZenohSettings, ZenohTransport

pytestmark = [pytest.mark.long, pytest.mark.processes]

ECHO = """
import sys, time
from safedpa.bus import ZenohSettings, ZenohTransport
transport = ZenohTransport(ZenohSettings(connect=(sys.argv[1],)))
transport.subscribe("safedpa/f/r/state", lambda key, payload: heard.append(payload))
transport.declare_alive("safedpa/f/echo/alive")
heard = []
while True:
    time.sleep(0.02)
    while heard:
        transport.put("safedpa/f/r/verdict", heard.pop(0), never_drop=False)
"""


def test_it_links_to_every_other_peer_again(tmp_path: Path) -> None:
    endpoint = f"unixsock-stream/{tmp_path}/bus"
    router = ZenohTransport(ZenohSettings(listen=(endpoint,)))
    other = ZenohTransport(ZenohSettings(connect=(endpoint,)))
    echo = subprocess.Popen([sys.executable, "-c", ECHO, endpoint])
    heard = Heard()
    other.subscribe("safedpa/f/r/verdict", heard)
    count = 0

    def answers() -> bool:
        nonlocal count
        count += 1
        other.put("safedpa/f/r/state", b"%d" % count, never_drop=False)
        time.sleep(0.05)
        return heard.payloads[-1:] == [b"%d" % count] or heard.payloads[-1:] == [b"%d" % (count - 1)]

    try:
        assert until(answers, 30.0)
        for suspended in (1.7, 2.1, 2.6, 5.0, 6.0):
            os.kill(echo.pid, signal.SIGSTOP)
            began = time.monotonic()
            while time.monotonic() - began < suspended:
                answers()
            heard.samples.clear()
            os.kill(echo.pid, signal.SIGCONT)
            assert until(answers, 10.0), f"no answer after {suspended} s"
            assert until(lambda: "safedpa/f/echo/alive" in other.alive("safedpa/f/*/alive"), 10.0)
        # A starved process runs now and then, never long enough to keep its links.
        end = time.monotonic() + 5.0
        while time.monotonic() < end:
            os.kill(echo.pid, signal.SIGSTOP)
            time.sleep(0.4)
            os.kill(echo.pid, signal.SIGCONT)
            time.sleep(0.002)
            answers()
        heard.samples.clear()
        assert until(answers, 10.0), "no answer after it was starved"
    finally:
        echo.kill()
        echo.wait()
        other.close()
        router.close()
