"""A command that waits for a change reports its end, also where an answer was late or lost, and not for ever."""

import time
from contextlib import nullcontext
from itertools import count
from types import SimpleNamespace
from typing import Any

import pytest

from safedpa.bus import Answer
from safedpa.errors import SafedpaError
from safedpa_services.command_line import change_requests

SEEN = Answer(ok=True, sentence="", fingerprint="old", finding=1)
BEGUN = Answer(ok=True, sentence="change 1 begins", change=1)
UNDER_WAY = Answer(ok=True, sentence="", change=1, pending="offer")
OVER = Answer(ok=True, sentence="taken by all services", change=1, fingerprint="new")


def accept(monkeypatch: pytest.MonkeyPatch, *answers: Answer | None) -> list[int]:
    """Runs the command, on a clock that goes on by a second at each look; the last answer comes again and again.

    Returns the elapsed seconds in a list, which is also filled if the command fails.
    """
    seconds, left, passed = count(), [SEEN, BEGUN, *answers], [0]

    def now() -> int:
        passed[0] = next(seconds)
        return passed[0]

    bus: Any = SimpleNamespace(fleet="f", request=lambda *_: left.pop(0) if len(left) > 1 else left[0])
    monkeypatch.setattr(change_requests, "bus_of", lambda _options: nullcontext(bus))
    with monkeypatch.context() as patched:
        patched.setattr(time, "monotonic", now)
        patched.setattr(time, "sleep", lambda _seconds: None)
        try:
            change_requests.ask_for_change("accept", "r1", "drag", {"who": "a test", "as_json": False})
        except SafedpaError as error:
            raise SafedpaError(f"after {passed[0]} s: {error}") from error
    return passed


def test_an_answer_that_is_late_or_lost_does_not_end_the_waiting(monkeypatch, capsys):
    accept(monkeypatch, UNDER_WAY, None, UNDER_WAY, None, None, OVER)
    assert "r1: taken by all services; model new in force" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("last", "notice", "least", "most"),
    [(None, "no diagnosis answers", 8, 30), (UNDER_WAY, "check that the robot drives", 60, 300)],
)
def test_it_gives_up_after_ten_silent_seconds_or_two_minutes(last, notice, least, most, monkeypatch):
    with pytest.raises(SafedpaError, match=notice) as failed:
        accept(monkeypatch, UNDER_WAY, last)
    assert least <= int(str(failed.value).split()[1]) <= most


def test_a_change_that_was_dropped_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    dropped = Answer(ok=True, sentence="dropped, policy refused it", change=1, fingerprint="old")
    with pytest.raises(SafedpaError, match="policy refused it"):
        accept(monkeypatch, UNDER_WAY, dropped)
