"""Who serves a robot is told when it begins to drive and when it brakes by itself: once each time, and in words."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from safedpa_services.command_line import serve


class Watch:
    """What was heard of one robot."""

    robot = "r1"

    def __init__(self) -> None:
        self.health: dict[str, Any] = {}
        self.state: Any = None

    def beats(self, detail: str) -> None:
        self.health["robot"] = (SimpleNamespace(detail=detail), 0.0)


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    lines: list[str] = []
    monkeypatch.setattr(serve, "tell", lambda line, **_: lines.append(line))
    return lines


def test_nothing_is_told_before_anything_was_heard_and_driving_is_told_once(told: list[str]) -> None:
    watch = Watch()
    say = serve._Sayings(watch)
    say()
    assert told == []
    watch.state = SimpleNamespace(tick=1)
    for _ in range(5):
        say()
    assert told == ["robot r1: the filter drives"]


def test_braking_by_itself_is_told_and_so_is_driving_on(told: list[str]) -> None:
    watch = Watch()
    say = serve._Sayings(watch)
    for detail in ("", "", "brakes: no action for 12 ticks", "brakes: no action for 12 ticks", "", ""):
        watch.beats(detail)
        say()
    assert told == [
        "robot r1: the filter drives",
        "robot r1: brakes: no action for 12 ticks",
        "robot r1: the filter drives",
    ]
