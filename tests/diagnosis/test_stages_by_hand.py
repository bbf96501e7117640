"""Which stages are told, in which order, how many runs each improves and what it makes worse, by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.diagnosis.fit.heldout import HeldoutError
from safedpa.diagnosis.search import stages
from safedpa.diagnosis.search.stages import _by_fall, _improved, _that_help, _worse


def errors(*by_run: float) -> HeldoutError:
    """Of two states each, that are equally wrong."""
    own = np.array(by_run)
    return HeldoutError(float(np.nanmean(own)), np.full(2, own.mean()), own, np.column_stack([own, own]), own, own)


def test_what_helps_only_beside_a_later_effect_is_one_stage_with_it() -> None:
    assert _that_help([errors(0.5, 0.5), errors(0.4, 0.5), errors(0.3, 0.4)]) == [0, 1, 2]
    assert _that_help([errors(0.5, 0.5), errors(0.6, 0.5), errors(0.3, 0.4)]) == [0, 2]
    assert _that_help([errors(0.5, 0.5), errors(0.4, 0.6), errors(0.4, 0.6), errors(0.3, 0.6)]) == [0, 1, 3]
    assert _that_help([errors(0.5)]) == [0]


def test_the_last_stage_is_told_even_where_it_helps_no_run() -> None:
    """It is the model that is proposed; on the horizon that is shown it may be no better."""
    assert _that_help([errors(0.5, 0.5), errors(0.5, 0.6)]) == [0, 1]
    assert _that_help([errors(0.5, 0.5), errors(0.4, 0.4), errors(0.4, 0.6)]) == [0, 1, 2]
    assert _that_help([errors(0.5, 0.5), errors(0.6, 0.6), errors(0.7, 0.7)]) == [0, 2]


def test_runs_are_improved_out_of_those_with_windows_in_both() -> None:
    none = float("nan")
    assert _improved(None, errors(0.1)) == ""
    assert _improved(errors(0.5, 0.5, 0.5, 0.5), errors(0.4, 0.5, 0.6, 0.3)) == "2/4"
    assert _improved(errors(0.5, none, 0.5, 0.5), errors(0.4, 0.5, none, 0.6)) == "1/2"


def test_worse_is_what_grew_by_a_twentieth_and_a_hundredth_at_least_the_most_first() -> None:
    windows = SimpleNamespace(system=SimpleNamespace(state_names=("x", "speed")), names=("a", "b", "c"))
    before, middle, after = (errors(0.0, 0.0, 0.0) for _ in range(3))
    before.by_run_and_state[:] = [[0.10, 1.00], [1.00, 0.50], [np.nan, 0.10]]
    middle.by_run_and_state[:] = 9.0
    after.by_run_and_state[:] = [[0.109, 1.04], [1.20, 0.80], [0.70, 0.05]]
    shown: Any = SimpleNamespace(windows=windows)
    found = _worse([before, middle, after], shown)
    assert [(item.run, item.state, item.before, item.after) for item in found] == [
        ("b", "speed", 0.50, 0.80), ("b", "x", 1.00, 1.20),
    ]  # fmt: skip
    assert _worse([before], shown) == ()


def test_the_order_by_fall_takes_the_lowest_error_at_each_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """b helps most alone, and c beside it more than a does, although a alone is better than c alone."""
    told = {"a": 0.7, "b": 0.5, "c": 0.9, "ba": 0.45, "bc": 0.2, "bca": 0.1}
    monkeypatch.setattr(
        stages, "_step", lambda _search, names, _heldout: ("".join(names), SimpleNamespace(value=told["".join(names)]))
    )
    first: Any = ("first", SimpleNamespace(value=1.0))
    search: Any = SimpleNamespace(added=["a", "b", "c"])
    heldout: Any = None
    order, steps = _by_fall(search, first, heldout)
    assert order == ["b", "c", "a"]
    names: list[Any] = [step[0] for step in steps]
    assert names == ["first", "b", "bc", "bca"]
