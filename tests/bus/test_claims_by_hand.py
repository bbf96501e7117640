"""Which of two instances of one service stays, how long it waits for the other, and what may be sent as what."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from safedpa.bus import STATE, WISH, MemoryBroker, MemoryTransport, StateMessage
from safedpa.bus.transport import bus as module
from safedpa.bus.transport.bus import Bus
from safedpa.errors import BusError, MessageError


class Signs:
    """Signs of life on a clock that goes on while somebody sleeps: ``others`` by name, from when to when [s]."""

    def __init__(self, others: dict[str, tuple[float, float]], monkeypatch: pytest.MonkeyPatch) -> None:
        self.now, self.others = 0.0, others
        self.own: list[str] = []
        self.looks: list[float] = []
        monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: self.now, sleep=self.sleep))

    def sleep(self, seconds: float) -> None:
        self.now += seconds
        assert self.now < 100.0, "it waits for ever"

    def declare_alive(self, key: str) -> None:
        self.own.append(key)

    def alive(self, wanted: str) -> list[str]:
        self.looks.append(self.now)
        there = [name for name, (first, last) in self.others.items() if first <= len(self.looks) and self.now < last]
        return [*self.own, *(wanted.replace("*", name) for name in there)]


@pytest.mark.parametrize(
    ("others", "stays", "waited"),
    [
        ({}, True, 0.0),
        ({"a": (1, 99.0)}, False, 0.0),  # was there first
        ({"z": (1, 99.0)}, False, 0.0),
        ({"a": (2, 99.0)}, False, 0.0),  # started at the same time, and goes before
        ({"z": (2, 0.0)}, True, 0.0),
        ({"z": (2, 1.0)}, True, 1.0),  # leaves
        ({"z": (2, 99.0)}, False, 5.0),  # does not
        ({"z": (2, 1.0), "y": (2, 2.0)}, True, 2.0),
        ({"z": (2, 1.0), "a": (2, 2.0)}, False, 0.0),
    ],
)
def test_of_two_that_start_at_once_the_lower_one_waits_for_the_other_to_leave(
    others: dict[str, tuple[float, float]], stays: bool, waited: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``m`` claims a name; the others are there from its first or second look on. It looks twenty times a second."""
    signs: Any = Signs(others, monkeypatch)
    bus = Bus(signs, "f")
    if stays:
        bus.claim("r", "robot", "m")
    else:
        with pytest.raises(BusError, match=r"robot 'r' of fleet 'f' lives already \(instance [ayz]\); choose another"):
            bus.claim("r", "robot", "m")
    assert signs.own == ([] if any(first == 1 for first, _ in others.values()) else ["safedpa/f/r/alive/robot/m"])
    assert signs.now == pytest.approx(waited, abs=0.11)
    assert len(signs.looks) >= 10.0 * waited


def test_what_is_sent_on_a_topic_is_a_message_of_that_topic(state_at: Callable[..., StateMessage]) -> None:
    """Whoever reads it would refuse it, and nobody would be told who sent it."""
    broker = MemoryBroker()
    bus = Bus(MemoryTransport(broker), "f")
    ear = bus.inbox((WISH, STATE), keep_all=True)
    with pytest.raises(MessageError, match="wish: got StateMessage, wanted WishMessage"):
        bus.publish(WISH, "r", state_at(1))
    assert ear.take(0.0) == []
    bus.publish(STATE, "r", state_at(1))
    assert len(ear.take(0.0)) == 1
