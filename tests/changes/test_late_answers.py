"""A command that waits for a change hears of its end, also where an answer on the way was late or lost."""

from __future__ import annotations

from itertools import count
from types import SimpleNamespace
from typing import Any

import pytest

from safedpa.bus import Answer
from safedpa.errors import SafedpaError
from safedpa_services.command_line import change_requests

BEGUN = Answer(ok=True, sentence="change 1 begins", change=1)
UNDER_WAY = Answer(ok=True, sentence="", change=1, pending="offer")
OVER = Answer(ok=True, sentence="taken by everyone", change=1)


def waited(monkeypatch: pytest.MonkeyPatch, *answers: Answer | None) -> Answer:
    """What the command hears in the end; after the last answer that one comes again and again, one a second."""
    seconds, left = count(), list(answers)
    monkeypatch.setattr(change_requests, "time", SimpleNamespace(monotonic=lambda: next(seconds), sleep=lambda _: None))
    bus: Any = SimpleNamespace(fleet="f", request=lambda *_: left.pop(0) if len(left) > 1 else left[0])
    return change_requests._end_of(bus, "r1", BEGUN)


def test_an_answer_that_is_late_or_lost_does_not_end_the_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    assert waited(monkeypatch, UNDER_WAY, None, UNDER_WAY, None, None, OVER) == OVER


@pytest.mark.parametrize(("last", "said"), [(None, "no diagnosis answers"), (UNDER_WAY, "does the robot drive")])
def test_it_is_not_waited_for_ever(last: Answer | None, said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SafedpaError, match=said):
        waited(monkeypatch, UNDER_WAY, last)
