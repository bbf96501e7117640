"""How much a pendulum experiment has to do, by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from safedpa_lab.experiments import pendulum


def test_how_much_the_pendulum_has_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two questions of three and four methods, four of the seven with a filter; a table more for these."""

    def methods(*filters: str) -> list[Any]:
        return [SimpleNamespace(filter=one) for one in filters]

    monkeypatch.setattr(pendulum, "_METHODS", {"a": methods("x", "", "y"), "b": methods("x", "", "", "z")})
    monkeypatch.setattr(pendulum, "TABLES", ("own", "same"))
    monkeypatch.setattr(pendulum, "Sweeps", lambda *_: SimpleNamespace(size=100))
    told: list[tuple[int, int]] = []
    for episodes, whole in ((0, 7 + 4), (2, 7 + 4 + 100)):
        asked: Any = SimpleNamespace(models=None, axes=None, sweep_episodes=episodes)
        count = pendulum._Count(asked, lambda *given: told.append(given))
        count.more()
        count.more()
        assert told[-2:] == [(1, whole), (2, whole)]
