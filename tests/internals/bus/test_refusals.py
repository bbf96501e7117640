"""How the router's reader of Zenoh's log reports that lines were passed over."""

from types import SimpleNamespace
from typing import Any

import pytest

from safedpa_services.router import refusals as module


class SeenEnoughError(Exception):
    """Ends the reader's loop."""


@pytest.mark.parametrize(
    ("passed_over", "reports"),
    [
        ([0] * 200, []),
        ([*[0] * 9, *[5] * 191], [50]),  # once, and a second after it began to look at the earliest
        ([*[0] * 99, *[5] * 101], [100]),
        (list(range(1, 201)), [50, 100, 150, 200]),
    ],
    ids=["nothing", "once", "later", "always"],
)
def test_lines_that_were_passed_over_are_reported_once_a_second_and_only_where_there_were_more(
    passed_over: list[int], reports: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It looks every 0.02 s, and hands on lines in order."""
    looks, events, lines = [0], list[int](), list[str]()

    class Pause:
        def wait(self, seconds: float) -> None:
            assert seconds == 0.02
            if looks[0] == len(passed_over):
                raise SeenEnoughError

    class File:
        @property
        def skipped(self) -> int:
            return passed_over[looks[0] - 1]

        def lines(self) -> list[str]:
            looks[0] += 1
            return [f"line {looks[0]}"]

    file: Any = File()
    monkeypatch.setattr(module, "threading", SimpleNamespace(get_native_id=lambda: 0, Event=Pause))
    monkeypatch.setattr(module.os, "sched_setscheduler", lambda *_: None)
    monkeypatch.setattr(module.os, "setpriority", lambda *_: None)
    monkeypatch.setattr(module, "log_event", lambda *_, **__: events.append(looks[0]))
    with pytest.raises(SeenEnoughError):
        module._read(file, lines.append)
    assert events == reports
    assert lines == [f"line {number}" for number in range(1, 201)]
