"""Which effects give way to others, and what is told of them; and from which numbers a fit begins."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.diagnosis.fit.trial import Trial, starts_of
from safedpa.diagnosis.search import revision
from safedpa.diagnosis.search.judgement import Judged
from safedpa.effects import Parameter


def trial(*names: str, held: tuple[str, ...] = (), loss: float = 0.9) -> Any:
    nobody: Any = None
    fit = SimpleNamespace(
        value=-3.0, free=np.array([name not in held for name in names]), paths=tuple(f"{name}.a" for name in names),
        model=SimpleNamespace(effects=[SimpleNamespace(name=name) for name in names]),
    )  # fmt: skip
    return replace(Trial(names, nobody, nobody, nobody, loss), fit=fit)


@pytest.fixture
def searching(monkeypatch: pytest.MonkeyPatch) -> Any:
    """searching(added, rivals, held) -> search, in which what is named in ``held`` stands at a bound in every fit."""

    def make(added: str, rivals: dict[str, list[str]], held: tuple[str, ...] = ()) -> Any:
        library = {name: SimpleNamespace(name=name) for name in "abcdef"}
        monkeypatch.setattr(revision, "known_effects", lambda *_: library)
        monkeypatch.setattr(revision, "refit", lambda _, items, *__: trial(*[item.name for item in items], held=held))
        monkeypatch.setattr(revision, "error_with", lambda *_: SimpleNamespace(value=0.1))
        monkeypatch.setattr(revision, "block_gain", lambda *_: 9.0)
        monkeypatch.setattr(revision, "passes", lambda gain, *_: gain > 3.0)
        return SimpleNamespace(
            added=list(added), candidates=[], error=SimpleNamespace(value=0.2), shooting=None, rivals=rivals,
            current=SimpleNamespace(loss=1.0, fit=SimpleNamespace(value=-2.0)),
        )  # fmt: skip

    return make


def split(search: Any) -> list[str]:
    nobody: Any = None
    revision.split(search, [], nobody)
    return list(search.added)


def test_what_went_with_another_is_not_asked_again(searching: Any) -> None:
    assert split(searching("abc", {"a": ["d", "e"], "c": ["b", "f"]}, held=("c",))) == ["d", "e", "b"]


def test_an_effect_does_not_give_way_to_what_is_there_already(searching: Any) -> None:
    assert split(searching("ab", {"a": ["b", "d"]})) == ["a", "b"], "b and d would have b twice"
    assert split(searching("ab", {"a": ["b", "d", "e"]})) == ["d", "e", "b"]


def test_two_of_which_one_stands_at_a_bound_take_nobodys_place(searching: Any) -> None:
    assert split(searching("ab", {"a": ["d", "e"]}, held=("e",))) == ["a", "b"]


@pytest.mark.parametrize(("gain", "late", "left"), [(9.0, False, "bd"), (9.0, True, "ba"), (-9.0, False, "ba")])
def test_a_rival_takes_a_place_by_its_gain_unless_its_lateness_is_feigned(
    searching: Any, gain: float, late: bool, left: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    search = searching("ba", {"a": ["d"]})
    monkeypatch.setattr(revision, "_uses_its_numbers", lambda *_: True)
    monkeypatch.setattr(revision, "given_names", lambda _: [])
    monkeypatch.setattr(revision, "feigned_lateness", lambda *_: late)
    monkeypatch.setattr(revision, "block_gain", lambda *_: gain)
    nobody: Any = None
    revision.exchange(search, [], nobody)
    assert search.added == list(left)


def test_what_was_accepted_is_said_to_have_given_way_and_what_was_rejected_keeps_its_reason(searching: Any) -> None:
    """A candidate that lost to the same effect earlier was never in the model."""
    search = searching("ab", {})
    error: Any = None
    for stage, decision in enumerate(("rejected", "accepted")):
        for names in (("a",), ("b",)):
            search.candidates.append(Judged(stage, trial(*names), 4.0, error, decision, f"stage {stage}", ()))
    nobody: Any = None
    revision._replaced(search, ("a",), ("d",), trial("d", "b"), nobody)
    assert search.added == ["d", "b"]
    told = [(item.stage, item.trial.effects, item.decision) for item in search.candidates]
    assert told == [
        (0, ("a",), "rejected"), (0, ("b",), "rejected"),
        (1, ("d",), "accepted"), (1, ("a",), "rejected"), (1, ("b",), "accepted"),
    ]  # fmt: skip
    assert search.candidates[0].reason == "stage 0"
    assert "gave way to d" in search.candidates[3].reason
    assert "took the place of a" in search.candidates[2].reason


@pytest.mark.parametrize(
    "parameter",
    [
        Parameter("a", "m", 0.0, 1.0, 0.9),
        Parameter("a", "m", -1.0, 1.0, 0.9),
        Parameter("a", "m", 0.1, 1.0, 0.9, neutral=None),
        Parameter("a", "1", 0.5, 1.5, 1.4, neutral=1.0),
        Parameter("a", "1", 0.9, 5.0, 5.0, neutral=1.0),
    ],
    ids=["one side", "both sides", "a shape", "a gain near 1", "a gain far from 1"],
)
def test_a_fit_begins_within_the_bounds_at_several_numbers_none_of_which_does_nothing(parameter: Parameter) -> None:
    item: Any = SimpleNamespace(parameters=(parameter,))
    found = [start["a"] for start in starts_of(item)]
    assert len(set(found)) >= 2
    assert all(parameter.low <= value <= parameter.high for value in found)
    assert parameter.neutral not in found


@pytest.mark.parametrize(("typical", "neutral"), [(5.0, None), (5.0, 4.99), (4.99, 5.0)])
def test_between_narrow_bounds_a_fit_begins_somewhere(typical: float, neutral: float | None) -> None:
    item: Any = SimpleNamespace(parameters=(Parameter("a", "1", 4.99, 5.01, typical, neutral=neutral),))
    found = [start["a"] for start in starts_of(item)]
    assert found
    assert all(4.99 <= value <= 5.01 for value in found)
