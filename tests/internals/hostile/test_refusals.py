"""The thread that reads the router's log."""

import os
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import pytest

from safedpa_services.router import refusals


def test_lines_that_are_passed_over_are_reported_once_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four seconds of looks, in all of which something is passed over, and two in which nothing is."""
    now, reported = [0.0], list[float]()

    class Pause:
        def wait(self, seconds: float) -> None:
            now[0] += seconds
            if now[0] > 6.0:
                raise InterruptedError

    class Flooded:
        skipped = 0

        def lines(self) -> list[str]:
            self.skipped += 1000 if now[0] < 4.0 else 0
            return []

    for name in ("setpriority", "sched_setscheduler"):
        monkeypatch.setattr(os, name, lambda *_: None)
    monkeypatch.setattr(refusals, "threading", SimpleNamespace(Event=Pause, get_native_id=lambda: 0))
    monkeypatch.setattr(refusals, "log_event", lambda *_, **__: reported.append(now[0]))
    flooded: Any = Flooded()
    with pytest.raises(InterruptedError):
        refusals._read(flooded, lambda _line: None)
    assert 4 <= len(reported) <= 5
    assert all(0.99 <= later - earlier <= 1.1 for earlier, later in pairwise(reported))
