"""Of two instances of one service that start at once, one stays."""

import time
from typing import Any

import pytest

from safedpa.bus.transport.bus import Bus
from safedpa.errors import BusError


class Signs:
    """Signs of life on a clock that a sleep moves; ``others``: the look that sees each first, and its end [s].

    It stands in place of a transport.
    """

    def __init__(self, others: dict[str, tuple[int, float]], monkeypatch: pytest.MonkeyPatch) -> None:
        self.now, self.others, self.own, self.looks = 0.0, others, list[str](), 0
        monkeypatch.setattr(time, "monotonic", lambda: self.now)
        monkeypatch.setattr(time, "sleep", self.sleep)

    def sleep(self, seconds: float) -> None:
        self.now += seconds
        assert self.now < 100.0, "it waits for ever"

    def declare_alive(self, key: str) -> None:
        self.own.append(key)

    def alive(self, wanted: str) -> list[str]:
        self.looks += 1
        there = [name for name, (first, last) in self.others.items() if first <= self.looks and self.now < last]
        return [*self.own, *(wanted.replace("*", name) for name in there)]


@pytest.mark.parametrize(
    ("others", "stays", "waited"),
    [
        ({}, True, 0.0),
        ({"a": (1, 99.0)}, False, 0.0),  # was there first
        ({"z": (1, 99.0)}, False, 0.0),
        ({"a": (2, 99.0)}, False, 0.0),  # started at the same time, and comes before
        ({"z": (2, 0.0)}, True, 0.0),
        ({"z": (2, 1.0)}, True, 1.0),  # leaves
        ({"z": (2, 99.0)}, False, 5.0),  # does not leave
        ({"z": (2, 1.0), "y": (2, 2.0)}, True, 2.0),
        ({"z": (2, 1.0), "a": (2, 2.0)}, False, 0.0),
    ],
)
def test_the_lower_of_two_instances_that_start_at_once_waits_up_to_five_seconds_for_the_other_to_leave(
    others: dict[str, tuple[int, float]], stays: bool, waited: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``m`` claims a name, and looks at least ten times a second whether it is alone."""
    signs: Any = Signs(others, monkeypatch)
    if stays:
        Bus(signs, "f").claim("r", "robot", "m")
    else:
        with pytest.raises(BusError, match=r"'r' of fleet 'f' is already running \(instance [ayz]\); choose another"):
            Bus(signs, "f").claim("r", "robot", "m")
    assert signs.own == ([] if any(first == 1 for first, _ in others.values()) else ["safedpa/f/r/alive/robot/m"])
    assert signs.now == pytest.approx(waited, abs=0.11)
    assert signs.looks >= 10.0 * waited
