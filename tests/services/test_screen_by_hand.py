"""How often the view on a terminal is drawn, and what a pipe is told instead."""

from __future__ import annotations

import io
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace, TracebackType
from typing import Any

import pytest
import rich.live
from rich.console import Console
from tests.services.test_children_by_hand import Process, child_of, watched

from safedpa_services import terminal
from safedpa_services.supervisor import screen as module
from safedpa_services.supervisor.screen import screen


class Drawn:
    """In place of rich's live view: when it was drawn."""

    moments: list[float]
    now: list[float]

    def __init__(self, **_: Any) -> None:
        pass

    def __enter__(self) -> Drawn:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass

    def update(self, _: object, *, refresh: bool) -> None:
        assert refresh
        self.moments.append(self.now[0])


def test_a_terminal_is_drawn_four_times_a_second_however_often_the_loop_turns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [50.0]
    monkeypatch.setattr(Drawn, "moments", [], raising=False)
    monkeypatch.setattr(Drawn, "now", now, raising=False)
    monkeypatch.setattr(rich.live, "Live", Drawn)
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: now[0]))
    monkeypatch.setattr(terminal, "terminal", lambda **_: Console(file=io.StringIO(), force_terminal=True, width=100))
    child = child_of(tmp_path, Process())
    with screen(watched(), [], child, ["a hint"], tmp_path, quiet=False) as redraw:
        while now[0] < 52.0:
            redraw()
            now[0] += 0.05
    assert 7 <= len(Drawn.moments) <= 8
    assert all(0.24 <= later - earlier <= 0.31 for earlier, later in pairwise(Drawn.moments))


def test_a_pipe_is_told_each_hint_once_and_who_is_quiet_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = io.StringIO()
    monkeypatch.setattr(terminal, "terminal", lambda **_: Console(file=out, width=100))
    child = child_of(tmp_path, Process())
    for quiet, said in ((True, ""), (False, "a hint\n")):
        with screen(watched(), [], child, ["a hint"], tmp_path, quiet=quiet) as redraw:
            for _ in range(3):
                redraw()
        assert out.getvalue() == said
