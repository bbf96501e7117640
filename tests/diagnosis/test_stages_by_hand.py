"""Which stages are told, in which order, how many runs each improves and what it makes worse, by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.diagnosis.fit.heldout import HeldoutError
from safedpa.diagnosis.search import stages
from safedpa.diagnosis.search.stages import _by_fall, _improved, _step, _that_help, _worse, stages_of


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


def test_the_most_is_what_grew_most_and_at_equal_limits_nothing_is_told() -> None:
    """A twentieth of 1.00 is reached and not passed; nor is a hundredth beside nothing."""
    windows = SimpleNamespace(system=SimpleNamespace(state_names=("x", "y")), names=("a", "b", "c"))
    before, after = (errors(0.0, 0.0, 0.0) for _ in range(2))
    before.by_run_and_state[:] = [[1.00, 1.0], [0.00, 1.0], [0.5, 2.0]]
    after.by_run_and_state[:] = [[1.05, 1.0], [0.01, 1.0], [0.6, 2.3]]
    shown: Any = SimpleNamespace(windows=windows)
    found = _worse([before, after], shown)
    assert [(item.stage, item.run, item.state) for item in found] == [(1, "c", "y"), (1, "c", "x")]
    assert [item.stage for item in _worse([before, before, after], shown)] == [2, 2]


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> Any:
    """told(table, added, shown=None) -> (what is told, effects in their order) where a model has the error of the
    table by the letters of its effects; on the windows that are shown, those of ``shown``."""

    def asked(table: dict[str, float], added: str, shown: dict[str, float] | None = None) -> Any:
        windows = SimpleNamespace(system=SimpleNamespace(state_names=("x", "y")), names=("r1", "r2"))
        heldout, other = SimpleNamespace(windows=windows), SimpleNamespace(windows=windows)
        tables = {id(heldout): table, id(other): shown or {}}

        def error_with(fitted: Any, _: Any, where: Any) -> HeldoutError:
            value = tables[id(where)][fitted.model]
            return errors(value, value)

        def step(_: Any, names: Any, where: Any) -> Any:
            fitted = SimpleNamespace(model="".join(names))
            return fitted, error_with(fitted, None, where)

        monkeypatch.setattr(stages, "error_with", error_with)
        monkeypatch.setattr(stages, "_step", step)
        first = SimpleNamespace(fit=SimpleNamespace(model=""))
        search: Any = SimpleNamespace(first=first, shooting=None, added=list(added))
        return stages_of(search, heldout, heldout if shown is None else other), search.added  # type: ignore[arg-type]

    return asked


def test_each_stage_adds_one_effect_and_tells_its_error_and_the_runs_that_it_improves(told: Any) -> None:
    found, added = told({"": 1.0, "a": 0.8, "ab": 0.5}, "ab")
    assert [(stage.effects, stage.heldout_error) for stage in found.stages] == [
        ((), 1.0), (("a",), 0.8), (("a", "b"), 0.5),
    ]  # fmt: skip
    assert [stage.per_state for stage in found.stages] == [{"x": e, "y": e} for e in (1.0, 0.8, 0.5)]
    assert [stage.runs_improved for stage in found.stages] == ["", "2/2", "2/2"]
    assert found.models == ["", "a", "ab"]
    assert (found.worse, added) == ((), ["a", "b"])
    alone, _ = told({"": 1.0}, "")
    assert (len(alone.stages), alone.models) == (1, [""])


def test_the_order_is_kept_unless_one_of_three_helps_only_beside_a_later_one(told: Any) -> None:
    table = {"": 1.0, "a": 1.2, "ab": 0.5, "abc": 0.3, "b": 0.6, "c": 0.9, "ba": 0.5, "bc": 0.35, "bca": 0.3}
    assert told(table, "abc")[1] == ["b", "c", "a"]
    assert told({**table, "a": 1.0}, "abc")[1] == ["a", "b", "c"], "as large is not larger"
    assert told({**table, "a": 0.9}, "abc")[1] == ["a", "b", "c"], "each of them helps, whatever helps more"
    found, added = told(table, "ab")
    assert added == ["a", "b"], "of two one stage is made"
    assert found.models == ["", "ab"]
    worse_again = {**table, "a": 0.4, "ac": 0.45, "acb": 0.3}
    assert told(worse_again, "abc")[1] == ["a", "c", "b"], "it was the second one that helped none"


def test_what_is_shown_is_told_of_its_own_windows_in_the_order_of_the_search(told: Any) -> None:
    found, added = told({"": 1.0, "a": 0.8, "ab": 0.5}, "ab", {"": 2.0, "a": 1.5, "ab": 2.4})
    assert [stage.heldout_error for stage in found.stages] == [2.0, 1.5, 2.4]
    assert [stage.runs_improved for stage in found.stages] == ["", "2/2", "0/2"]
    assert {(item.stage, item.before, item.after) for item in found.worse} == {(2, 2.0, 2.4)}
    assert added == ["a", "b"]


def test_a_step_has_the_effects_that_are_named_with_the_last_models_numbers(
    monkeypatch: pytest.MonkeyPatch, plain: Any, with_effect: Any
) -> None:
    last = with_effect(with_effect(plain, "understeer", gradient=0.03), "viscous_drag", coefficient=0.7)
    given: list[Any] = []

    def fitted(*arguments: Any) -> Any:
        given.append(arguments)
        return SimpleNamespace(model=arguments[0])

    monkeypatch.setattr(stages, "fit", fitted)
    monkeypatch.setattr(stages, "error_with", lambda own, shooting, heldout: (own, shooting, heldout))
    current = SimpleNamespace(fit=SimpleNamespace(model=last, scale="scale"))
    first = SimpleNamespace(fit=SimpleNamespace(model=plain, paths=("base.drive_gain",)))
    search: Any = SimpleNamespace(
        first=first, current=current, shooting="windows", added=["understeer", "viscous_drag"]
    )
    heldout: Any = "heldout"
    whole, told_of = _step(search, ["viscous_drag", "understeer"], heldout)
    assert whole is current.fit
    assert told_of == (whole, "windows", "heldout")
    assert given == []
    part, told_of = _step(search, ["viscous_drag"], heldout)
    assert told_of == (part, "windows", "heldout")
    (model, paths, shooting, scale) = given[0]
    assert [item.name for item in model.effects] == ["viscous_drag"]
    assert model.settings["viscous_drag.coefficient"].value == 0.7
    assert (paths, shooting, scale) == (["base.drive_gain", "viscous_drag.coefficient"], "windows", "scale")
