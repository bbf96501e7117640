"""Who was cut off at the door is told: in one line, no later than a second after it happened, and all are counted."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from typing import Any

import pytest

from safedpa.bus.security import doorkeeper
from safedpa.bus.security.doorkeeper import Doorkeeper


class Door:
    """A listening socket with its keeper, on a clock that the test turns."""

    def __init__(self) -> None:
        self.now = 100.0
        self.listening = socket.create_server(("127.0.0.1", 0))
        self.port = self.listening.getsockname()[1]
        self.keeper = Doorkeeper({self.port}, lambda: (), lambda: self.now)

    def cut_off(self) -> None:
        """A stranger connects, says nothing that lets it in, and is cut off when 3.5 s have passed."""
        link = socket.create_connection(("127.0.0.1", self.port))
        accepted = self.listening.accept()[0]
        me = link.getsockname()
        assert seen_within(lambda: any(one.peer == me for one in self.keeper._strangers.values()), 60.0)
        self.now += 3.5
        link.settimeout(60.0)
        assert link.recv(1) == b""
        link.close()
        accepted.close()  # as its owner does who sees an end

    def close(self) -> None:
        self.keeper.close()
        self.listening.close()


def seen_within(condition: Callable[[], bool], seconds: float) -> bool:
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.02)
    return condition()


def test_a_stranger_cut_off_is_told_within_a_second_of_the_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[int] = []

    def log(kind: str, sentence: str, **more: Any) -> None:
        assert kind == "bus.strangers_cut_off"
        assert sentence.startswith(f"{more['count']} connections were cut off")
        told.append(more["count"])

    monkeypatch.setattr(doorkeeper, "log_event", log)
    door = Door()
    try:
        door.cut_off()
        door.now += 1.01
        assert seen_within(lambda: told == [1], 60.0), "3.5 s and 1 s after the door was opened"
        door.cut_off()
        door.now += 1.01
        assert seen_within(lambda: told == [1, 1], 60.0), "each is counted once"
    finally:
        door.close()
