"""An effect that stood for two others gives way to them, and takes along what only made up for the mistake."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from safedpa.diagnosis.fit.trial import Trial
from safedpa.diagnosis.search import revision


@pytest.mark.parametrize(
    ("held", "gain", "left"),
    [
        ((), 3.4, ["understeer", "drive_lag", "steer_lag", "tow"]),
        (("understeer", "tow"), 3.4, ["drive_lag", "steer_lag"]),
        (("tow",), 3.4, ["understeer", "drive_lag", "steer_lag"]),
        (("tow",), 0.0, ["understeer", "delay", "tow"]),
    ],
)
def test_an_effect_gives_way_to_two_and_what_then_stands_at_a_bound_goes_with_it(held, gain, left, monkeypatch):
    """Beside two lags, some of what made up for the delay has nothing to do any more: without it all is fitted anew."""

    def fitted(_search, items, *_enough):
        names = [item.name for item in items]
        free = np.array([name not in held for name in names])
        fit = SimpleNamespace(value=-3.0, free=free, paths=tuple(f"{name}.a" for name in names))
        return replace(Trial(tuple(names), None, None, None, 0.9), fit=fit)

    library = {name: SimpleNamespace(name=name) for name in ("understeer", "delay", "tow", "drive_lag", "steer_lag")}
    search = SimpleNamespace(
        added=["understeer", "delay", "tow"], candidates=[], error=SimpleNamespace(value=0.2), shooting=None
    )
    search.rivals = {"delay": ["drive_lag", "steer_lag"]}
    search.current = SimpleNamespace(fit=SimpleNamespace(value=-2.0))
    monkeypatch.setattr(revision, "known_effects", lambda *_: library)
    monkeypatch.setattr(revision, "refit", fitted)
    monkeypatch.setattr(revision, "block_gain", lambda *_: gain)
    monkeypatch.setattr(revision, "passes", lambda gain, *_: gain > 3.0)
    monkeypatch.setattr(revision, "error_with", lambda *_: SimpleNamespace(value=0.1))
    revision.split(search, list(library.values()), None)
    assert search.added == left
    if gain:
        assert search.error.value == 0.1
        assert set(search.current.effects) == set(left), "the model is that of the effects that are named"
