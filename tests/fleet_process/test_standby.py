"""A second safety filter takes over from one that is killed, hangs or is cut off, and two are never active."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import pytest
from tests.messages import stamp, state_of
from tests.waiting import until

from safedpa.bus import ACTION, STATE, ActionMessage, Bus, ZenohSettings, ZenohTransport, decode, key_of

pytestmark = [pytest.mark.long, pytest.mark.slow, pytest.mark.processes]

PERIOD = 0.05
MOST_SECONDS = 2.0
"""From the last action of one filter to the first one of the other."""


class Cable:
    """A TCP connection to an endpoint that can be cut so that neither end hears of it."""

    def __init__(self, endpoint: str) -> None:
        host, _, port = endpoint.removeprefix("tcp/").partition(":")
        self.target, self.cut = (host, int(port)), False
        self._server = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp/127.0.0.1:{self._server.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                near, _ = self._server.accept()
                far = socket.create_connection(self.target)
                for one, other in ((near, far), (far, near)):
                    threading.Thread(target=self._forward, args=(one, other), daemon=True).start()

    def _forward(self, one: socket.socket, other: socket.socket) -> None:
        with suppress(OSError), one:
            while data := one.recv(65536):
                if not self.cut:
                    other.sendall(data)
            other.shutdown(socket.SHUT_RDWR)  # wakes the thread that reads from it

    def close(self) -> None:
        self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()


class Region:
    """A router, two safety filters, and a robot that counts the actions of each tick."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.endpoint = f"tcp/127.0.0.1:{free.getsockname()[1]}"
        self.cable = Cable(self.endpoint)
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self.start("router", "router", "--plain", "--listen", self.endpoint, "--robot", "r1")
        transport = ZenohTransport(ZenohSettings("client", (), (self.endpoint,), connect_timeout=60.0))
        self.bus = Bus(transport, "fleet")
        self.actions, self.times = Counter[int](), list[float]()
        transport.subscribe(
            key_of("fleet", "r1", ACTION), self._heard
        )  # every message, where an inbox keeps the newest
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._drive)
        self._thread.start()

    def start(self, name: str, service: str, *more: str) -> None:
        command = [sys.executable, "-m", f"safedpa_services.{service}", *more]
        with (self.folder / f"{name}.log").open("ab") as log:
            self.processes[name] = subprocess.Popen(command, stderr=log, env={**os.environ, "SAFEDPA_LOG": "json"})

    def filter(self, name: str, endpoint: str = "") -> None:
        self.start(name, "safety_filter", "--mode", "client", "--connect", endpoint or self.endpoint, "--standby")

    def events(self, name: str, kind: str) -> list[float]:
        lines = (self.folder / f"{name}.log").read_text(encoding="utf-8").splitlines()
        events = [json.loads(line) for line in lines if line.startswith("{")]
        return [event["time"] for event in events if event["kind"] == kind]

    def _drive(self) -> None:
        begin = time.monotonic()
        while not self._ended.is_set():
            tick = int((time.monotonic() - begin) / PERIOD)
            self.bus.publish(STATE, "r1", state_of(**stamp(tick), period=PERIOD))
            self._ended.wait(max(0.0, begin + (tick + 1) * PERIOD - time.monotonic()))

    def _heard(self, _key: str, payload: bytes) -> None:
        self.actions[decode(ActionMessage, payload).tick] += 1
        self.times.append(time.monotonic())

    def longest_gap_after(self, when: float) -> float:
        first = bisect_right(self.times, when) - 1
        return max(after - before for before, after in pairwise(self.times[first:]))

    def acts_after(self, when: float) -> bool:
        return bool(self.times) and self.times[-1] > when

    def end(self) -> None:
        self._ended.set()
        self._thread.join()
        self.bus.close()
        for process in self.processes.values():
            process.send_signal(signal.SIGCONT)
            process.kill()
            process.wait()
        self.cable.close()


@pytest.fixture
def region(tmp_path: Path) -> Iterator[Region]:
    made = Region(tmp_path)
    try:
        made.filter("first", made.cable.endpoint)
        assert until(lambda: made.events("first", "lease.taken"))
        assert until(lambda: made.times)
        made.filter("second")
        assert until(lambda: made.events("second", "lease.waiting"))
        yield made
    finally:
        made.end()


def test_a_standby_takes_over_from_a_killed_filter_within_two_seconds_and_sends_nothing_before(region: Region) -> None:
    time.sleep(1.0)
    assert not region.events("second", "lease.taken")
    when = time.monotonic()
    region.processes["first"].kill()
    assert until(lambda: region.events("second", "lease.taken"))
    time.sleep(1.0)
    assert region.longest_gap_after(when) < MOST_SECONDS
    assert max(region.actions.values()) == 1


def test_a_filter_that_hung_ends_when_it_goes_on_and_its_actions_are_of_no_later_tick(region: Region) -> None:
    when = time.monotonic()
    region.processes["first"].send_signal(signal.SIGSTOP)
    assert until(lambda: region.events("second", "lease.taken"))
    time.sleep(1.0)
    assert region.longest_gap_after(when) < MOST_SECONDS
    region.processes["first"].send_signal(signal.SIGCONT)
    assert region.processes["first"].wait(30.0) == 75
    time.sleep(0.5)
    assert max(region.actions.values()) == 1


def test_a_filter_that_is_cut_off_ends_by_itself_and_the_standby_takes_over(region: Region) -> None:
    when = time.monotonic()
    region.cable.cut = True
    assert until(lambda: region.events("second", "lease.taken"))
    assert region.processes["first"].wait(30.0) == 75
    assert region.events("first", "lease.lost")[0] < region.events("second", "lease.taken")[0]
    time.sleep(1.0)
    assert region.longest_gap_after(when) < MOST_SECONDS
    region.cable.cut = False
    time.sleep(0.5)
    assert max(region.actions.values()) == 1


def test_a_filter_that_ends_in_order_hands_over_at_once(region: Region) -> None:
    when = time.monotonic()
    region.processes["first"].terminate()
    assert until(lambda: region.events("second", "lease.taken"))
    assert region.processes["first"].wait(30.0) == 0
    time.sleep(1.0)
    assert region.longest_gap_after(when) < MOST_SECONDS
    assert max(region.actions.values()) == 1


def test_without_the_router_no_filter_goes_on_and_one_returns_with_it(region: Region) -> None:
    region.processes["router"].send_signal(signal.SIGSTOP)
    assert region.processes["first"].wait(30.0) == 75
    assert not region.events("second", "lease.taken")
    region.processes["router"].send_signal(signal.SIGCONT)
    when = time.monotonic()
    assert until(lambda: region.events("second", "lease.taken"))
    assert until(lambda: region.acts_after(when))
    assert max(region.actions.values()) == 1
