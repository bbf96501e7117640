"""Which stages a report lists, in which order, how many runs each improves and what the last one makes worse."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.diagnosis.fit.heldout import HeldoutError
from safedpa.diagnosis.search import stages
from safedpa.diagnosis.search.stages import stages_of

NAN = float("nan")


class Model:
    """A model that is known by the names of its effects, and fitted to numbers that say which model they are of."""

    def __init__(self, names: str, last: str = "") -> None:
        self.names = names
        self.effects = [SimpleNamespace(name=name, parameters=(SimpleNamespace(name="n"),)) for name in names]
        self.settings = {f"{name}.n": f"{name} of {last or names}" for name in names}

    def with_effect(self, item: Any, own: dict[str, str]) -> Model:
        assert own == {"n": f"{item.name} of the last model"}
        return Model(self.names + item.name)


def heldout_error(errors: Any) -> HeldoutError:
    """``errors``: one for all, one for each run, or of each run and state."""
    table = np.array(errors, dtype=float)
    table = np.full((2, 2), table) if table.ndim == 0 else np.stack([table] * 2, axis=1) if table.ndim == 1 else table
    by_run = table.mean(axis=1)
    return HeldoutError(float(np.nanmean(table)), np.nanmean(table, axis=0), by_run, table, by_run, table)


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> Any:
    """told(table, added, shown=None) -> (what is reported, effects in their order).

    A model has the errors of the table by the letters of its effects; on the windows that are shown, those of
    ``shown``.
    """

    def report(table: dict[str, Any], added: str, shown: dict[str, Any] | None = None) -> Any:
        runs = tuple(f"r{number}" for number in range(3))
        windows = SimpleNamespace(system=SimpleNamespace(state_names=("x", "y")), names=runs)
        heldout: Any = SimpleNamespace(windows=windows)
        other: Any = SimpleNamespace(windows=windows)
        tables = {id(heldout): table, id(other): shown or {}}

        def fit(model: Model, paths: list[str], shooting: str, scale: str) -> Any:
            assert paths == ["base.gain", *(f"{name}.n" for name in model.names)]
            assert (shooting, scale) == ("windows", "scale")
            return SimpleNamespace(model=model)

        monkeypatch.setattr(stages, "fit", fit)
        monkeypatch.setattr(stages, "error_with", lambda own, _, at: heldout_error(tables[id(at)][own.model.names]))
        first = SimpleNamespace(fit=SimpleNamespace(model=Model(""), paths=("base.gain",)))
        current = SimpleNamespace(fit=SimpleNamespace(model=Model(added, "the last model"), scale="scale"))
        search: Any = SimpleNamespace(first=first, current=current, shooting="windows", added=list(added))
        return stages_of(search, heldout, heldout if shown is None else other), "".join(search.added)

    return report


def listed(found: Any) -> list[str]:
    return ["".join(stage.effects) for stage in found.stages]


def test_each_stage_adds_one_effect_with_its_error_and_the_runs_that_it_improves(told: Any) -> None:
    found, added = told({"": 1.0, "a": 0.8, "ab": 0.5}, "ab")
    assert [(stage.effects, stage.heldout_error) for stage in found.stages] == [
        ((), 1.0), (("a",), 0.8), (("a", "b"), 0.5),
    ]  # fmt: skip
    assert [stage.per_state for stage in found.stages] == [{"x": e, "y": e} for e in (1.0, 0.8, 0.5)]
    assert [stage.runs_improved for stage in found.stages] == ["", "2/2", "2/2"]
    assert [model.names for model in found.models] == ["", "a", "ab"]
    assert (found.worse, added) == ((), "ab")
    assert listed(told({"": 1.0}, "")[0]) == [""]


@pytest.mark.parametrize(
    ("errors", "stages_listed"),
    [
        (([0.5, 0.5], [0.4, 0.5], [0.3, 0.4]), ["", "a", "ab"]),
        (([0.5, 0.5], [0.6, 0.5], [0.3, 0.4]), ["", "ab"]),  # what helps only with the next one is one stage with it
        (([0.5, 0.5], [0.5, 0.6]), ["", "a"]),  # the last one is the model that is proposed
        (([0.5, 0.5], [0.4, 0.4], [0.4, 0.6]), ["", "a", "ab"]), (([0.5, 0.5], [0.6, 0.6], [0.7, 0.7]), ["", "ab"]),
    ],
)  # fmt: skip
def test_a_stage_improves_some_run_or_is_the_last(told: Any, errors: Any, stages_listed: list[str]) -> None:
    names = ["", "a", "ab"][: len(errors)]
    assert listed(told(dict(zip(names, errors, strict=True)), names[-1])[0]) == stages_listed


@pytest.mark.parametrize(
    ("before", "after", "improved"),
    [([0.5, 0.5, 0.5], [0.4, 0.5, 0.3], "2/3"), ([0.5, NAN, 0.5], [0.4, 0.5, 0.6], "1/2"),
     ([0.5, 0.5, 0.5], [0.6, 0.4, NAN], "1/2")],
)  # fmt: skip
def test_runs_with_windows_in_both_stages_are_counted(told: Any, before: Any, after: Any, improved: str) -> None:
    assert told({"": before, "a": after}, "a")[0].stages[1].runs_improved == improved


@pytest.mark.parametrize(
    ("before", "after", "worse"),
    [
        ([[0.10, 1.00], [1.00, 0.50], [NAN, 0.10]], [[0.109, 1.04], [1.20, 0.80], [0.70, 0.05]],
         [("r1", "y", 0.50, 0.80), ("r1", "x", 1.00, 1.20)]),
        ([[1.00, 1.0], [0.00, 1.0], [0.5, 2.0]], [[1.05, 1.0], [0.01, 1.0], [0.6, 2.3]],
         [("r2", "y", 2.0, 2.3), ("r2", "x", 0.5, 0.6)]),  # a twentieth and a hundredth are reached and not passed
    ],
)  # fmt: skip
def test_states_that_got_worse_by_a_twentieth_and_a_hundredth_are_reported_most_first(
    told: Any, before: Any, after: Any, worse: list[Any]
) -> None:
    found, _ = told({"": before, "a": [[0.0, 0.0]] * 3, "ab": after}, "ab")
    assert [(item.run, item.state, item.before, item.after) for item in found.worse] == worse
    assert {item.stage for item in found.worse} == {2}


TABLE = {"": 1.0, "a": 1.2, "ab": 0.5, "abc": 0.3, "b": 0.6, "c": 0.9, "ba": 0.5, "bc": 0.35, "bca": 0.3}


@pytest.mark.parametrize(
    ("table", "added", "order"),
    [
        (TABLE, "abc", "bca"),
        ({**TABLE, "a": 1.0}, "abc", "abc"),  # as large is not larger
        ({**TABLE, "a": 0.9}, "abc", "abc"),  # each of them helps, whatever helps more
        ({**TABLE, "a": 0.4, "ac": 0.45, "acb": 0.3}, "abc", "acb"),  # it was the second one that helped nothing
        (TABLE, "ab", "ab"),  # of two, one stage is made
    ],
)
def test_the_order_is_kept_unless_one_of_three_helps_only_together_with_a_later_one(
    told: Any, table: Any, added: str, order: str
) -> None:
    found, now = told(table, added)
    assert now == order
    if added == "ab":
        assert listed(found) == ["", "ab"]


def test_errors_are_those_of_the_windows_that_are_shown_in_the_order_of_the_search(told: Any) -> None:
    found, added = told({"": 1.0, "a": 0.8, "ab": 0.5}, "ab", {"": 2.0, "a": 1.5, "ab": 2.4})
    assert [stage.heldout_error for stage in found.stages] == [2.0, 1.5, 2.4]
    assert [stage.runs_improved for stage in found.stages] == ["", "2/2", "0/2"]
    assert {(item.stage, item.before, item.after) for item in found.worse} == {(2, 2.0, 2.4)}
    assert added == "ab"
