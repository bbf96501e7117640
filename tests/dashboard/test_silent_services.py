"""A service that says nothing for a second is shown as silent: the lane goes on with what it said last until then."""

from __future__ import annotations

import pytest

from safedpa.bus import HealthMessage
from safedpa_services.dashboard.books import HealthBook


def beat(service: str, state: str = "running") -> HealthMessage:
    return HealthMessage(epoch=1, tick=0, robot_time=0.0, publish_time=0.0, service=service, pid=7, state=state)


@pytest.mark.parametrize(("silent_for", "shown"), [(0.25, "running"), (0.99, "running"), (1.01, "silent")])
def test_four_heartbeats_missed_are_silence(silent_for: float, shown: str) -> None:
    book = HealthBook()
    book.add(beat("policy"), 100.0)
    told = book.silences(100.0 + silent_for)
    assert book.states == {"policy": shown}
    assert [entry.path for entry in told] == ([("services", "policy")] if shown == "silent" else [])
    assert book.silences(100.0 + silent_for) == [], "once each time"


def test_only_who_is_silent_is_and_its_next_word_ends_it() -> None:
    book = HealthBook()
    for service in ("policy", "adaptation"):
        book.add(beat(service), 100.0)
    book.add(beat("adaptation"), 101.0)
    book.silences(101.5)
    assert book.states == {"policy": "silent", "adaptation": "running"}
    book.add(beat("policy"), 101.6)
    assert book.states == {"policy": "running", "adaptation": "running"}
