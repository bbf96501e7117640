"""Which effects are told where the data decide nothing, in which order and with which numbers: at every limit."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.diagnosis.document import Close, Detectable, Value
from safedpa.diagnosis.fit.trial import Trial
from safedpa.diagnosis.search import closest
from safedpa.diagnosis.search.closest import closest_effects, doubtful_effects, likely_effects, nearest_effects
from safedpa.diagnosis.search.progress import Judged


def error(value: float) -> Any:
    return SimpleNamespace(value=value)


def trial(*effects: str, free: Any = (True,), model: Any = None) -> Trial:
    fit: Any = SimpleNamespace(free=np.array(free), model=model)
    return Trial(effects, fit, np.zeros(1), np.zeros(1), 0.0)


def judged(
    *effects: str,
    stage: int = 2,
    gain: float = 2.0,
    after: float | None = 0.5,
    decision: str = "suspected",
    free: Any = (True,),
) -> Judged:
    """Beside a model of error 1."""
    own = None if after is None else error(after)
    return Judged(stage, trial(*effects, free=free), gain, own, decision, "why", (), 1.0)


def searching(*candidates: Judged, value: float = 0.4, added: Any = ()) -> Any:
    return SimpleNamespace(candidates=list(candidates), error=error(value), added=list(added))


def names(items: list[Judged]) -> list[str]:
    return [item.trial.name for item in items]


@pytest.mark.parametrize(
    ("item", "told"),
    [
        (judged("a"), True),
        (judged("a", decision="rejected"), True),
        (judged("a", decision="accepted"), False),
        (judged("a", stage=1), False),
        (judged("a", stage=3), True),
        (judged("a", gain=1.0), False),
        (judged("a", gain=1.001), True),
        (judged("a", gain=-5.0), False),
        (judged("a", after=0.899), True),
        (judged("a", after=0.901), False),
        (judged("a", after=1.4), False),
        (judged("a", after=0.0), True),
        (judged("a", after=None), False),
        (judged("a", "b"), True),
        (judged("a", "drag"), False),
        (judged("drag"), False),
        (judged("a", free=(True, False)), False),
        (judged("a", free=(False, False)), False),
        (judged("a", free=(True, True)), True),
    ],
)
def test_who_may_be_missing_though_blocks_are_not_sure(item: Judged, told: bool) -> None:
    """Of the last stage, not taken, more than one standard error, more than a tenth off, no number at its bound."""
    other = judged("other", decision="accepted", after=0.1)
    found = likely_effects(searching(other, item, added=["drag"]))
    assert names(found) == ([item.trial.name] if told else [])


@pytest.mark.parametrize(("value", "told"), [(0.499, False), (0.5, False), (0.501, True)])
def test_a_number_at_its_bound_is_no_hindrance_while_half_is_missing(value: float, told: bool) -> None:
    found = likely_effects(searching(judged("a", free=(True, False)), judged("b"), value=value))
    assert names(found) == (["a", "b"] if told else ["b"])


def test_of_the_last_stage_who_takes_most_off_comes_first() -> None:
    items = [judged(name, after=after) for name, after in (("a", 0.6), ("b", 0.2), ("c", 0.8), ("d", 0.4))]
    assert names(likely_effects(searching(judged("early", stage=1, after=0.0), *items))) == ["b", "d", "a", "c"]
    assert likely_effects(searching()) == []
    first = [judged("a", stage=0), judged("b", stage=0, gain=0.5)]
    assert names(likely_effects(searching(*first))) == ["a"]


def doubting(numbers: dict[str, tuple[float, float, float | None]], *candidates: Judged, added: Any) -> Any:
    """``numbers``: value, deviation and the value at which it does nothing, by path."""
    parameters = {path: SimpleNamespace(neutral=neutral) for path, (_, _, neutral) in numbers.items()}
    fit: Any = SimpleNamespace(
        paths=tuple(numbers),
        values=np.array([value for value, _, _ in numbers.values()]),
        model=SimpleNamespace(parameters=parameters),
        deviations=lambda shooting: np.array([own for _, own, _ in numbers.values()]) * (shooting == "windows"),
    )
    current = Trial((), fit, np.ones(1), np.ones(1), 7.0)
    return SimpleNamespace(current=current, candidates=list(candidates), added=list(added), shooting="windows")


@pytest.mark.parametrize(
    ("value", "deviation", "neutral", "doubted"),
    [
        (0.8, 0.79, 0.0, False), (0.8, 0.8, 0.0, False), (0.8, 0.81, 0.0, True), (-0.8, 0.81, 0.0, True),
        (-0.8, 0.5, 0.0, False), (1.5, 0.4, 1.0, False), (1.5, 0.6, 1.0, True), (0.5, 0.6, 1.0, True),
        (0.5, 0.4, 1.0, False), (3.0, 0.0, 0.0, True), (3.0, float("nan"), 0.0, True), (3.0, 2.9, 0.0, False),
        (3.0, 3.1, 0.0, True), (0.3, 9.0, None, False), (2.0, 1.2, 0.0, False),
    ],
)  # fmt: skip
def test_an_effect_is_doubtful_within_one_deviation_of_doing_nothing(
    value: float, deviation: float, neutral: float | None, doubted: bool
) -> None:
    item = judged("drag", decision="accepted")
    found = doubtful_effects(doubting({"drag.c": (value, deviation, neutral)}, item, added=["drag"]))
    assert names(found) == (["drag"] if doubted else [])


def test_one_number_that_is_told_is_enough() -> None:
    item = judged("drag", decision="accepted")
    sure, unsure, other = (2.0, 1.0, 0.0), (0.5, 1.0, 0.0), (0.5, 1.0, None)
    for numbers, doubted in (
        ({"drag.c": sure, "drag.d": unsure}, False),
        ({"drag.c": unsure, "drag.d": sure}, False),
        ({"drag.c": unsure, "drag.d": unsure, "lag.t": sure}, True),
        ({"drag.c": unsure, "drag.d": other}, True),
        ({"lag.t": unsure}, False),
        ({"base.mass": unsure, "drag.c": sure}, False),
    ):
        assert names(doubtful_effects(doubting(numbers, item, added=["drag"]))) == (["drag"] if doubted else [])


def test_what_is_doubtful_is_told_by_itself_as_it_was_last_accepted_and_with_the_numbers_of_now() -> None:
    unsure = (0.5, 1.0, 0.0)
    items = [
        judged("drag", stage=0, decision="accepted", gain=3.0),
        judged("lag", "drag", stage=1, decision="accepted", gain=5.0),
        judged("drag", stage=2, decision="rejected", gain=0.5),
        judged("grip", stage=2, decision="accepted", gain=9.0),
    ]
    search = doubting({"drag.c": unsure, "lag.t": unsure, "grip.g": (2.0, 1.0, 0.0)}, *items, added=["drag", "lag"])
    found = doubtful_effects(search)
    assert names(found) == ["drag", "lag"]
    assert [(item.stage, item.gain, item.decision) for item in found] == [(1, 5.0, "suspected")] * 2
    assert all(item.trial.fit is search.current.fit and item.trial.loss == 7.0 for item in found)
    assert {item.reason for item in found} == {
        "its size is within one deviation of nothing: beside the others these data do not tell it"
    }
    assert doubtful_effects(doubting({"drag.c": unsure}, items[2], items[3], added=["drag"])) == []


def nearest(monkeypatch: pytest.MonkeyPatch, errors: list[float], value: float = 0.5, count: int = 3) -> list[Judged]:
    """Effects 0, 1, ... as their trials come, and the held-out error of each."""
    trials = [trial(str(number), model=after) for number, after in enumerate(errors)]
    windows: Any = SimpleNamespace(windows=range(count))
    search: Any = SimpleNamespace(shooting=windows, error=error(value), current="now")
    library: Any = "library"
    heldout: Any = "held out"

    def tried_in_turn(*arguments: Any) -> list[Trial]:
        assert arguments == ("now", "library", windows, {})
        return trials

    def error_with(fit: Any, *rest: Any) -> Any:
        assert rest == (windows, "held out")
        return error(fit.model)

    def block_gain(one: Any, other: Trial, shooting: Any) -> float:
        assert (one, shooting) == ("now", windows)
        return 100.0 + float(other.name)

    monkeypatch.setattr(closest, "tried_in_turn", tried_in_turn)
    monkeypatch.setattr(closest, "error_with", error_with)
    monkeypatch.setattr(closest, "block_gain", block_gain)
    return nearest_effects(search, library, heldout)


def test_of_too_little_data_those_that_take_a_tenth_off_are_told_the_best_first(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = nearest(monkeypatch, [0.44, 0.46, 0.1, 0.3, float("inf")])
    assert names(found) == ["2", "3", "0"]
    assert [item.gain for item in found] == [102.0, 103.0, 100.0]
    assert [item.error.value for item in found if item.error] == [0.1, 0.3, 0.44]
    told = {(item.stage, item.decision, item.reason, item.equals, item.before) for item in found}
    assert told == {(0, "suspected", "too little data", (), 0.5)}
    assert found[0].fall == pytest.approx(0.8)


def test_six_that_promise_most_are_held_out(monkeypatch: pytest.MonkeyPatch) -> None:
    assert names(nearest(monkeypatch, [0.06, 0.05, 0.04, 0.03, 0.02, 0.01, 0.0])) == ["5", "4", "3", "2", "1", "0"]


@pytest.mark.parametrize(("after", "told"), [(0.9, False), (0.899, True), (0.95, False), (1.0, False), (1.05, False)])
def test_a_tenth_off_is_the_limit(monkeypatch: pytest.MonkeyPatch, after: float, told: bool) -> None:
    assert len(nearest(monkeypatch, [after], 1.0)) == told
    assert len(nearest(monkeypatch, [100.0 * after], 100.0)) == told


@pytest.mark.parametrize(
    ("value", "count", "told"),
    [(0.5, 3, 1), (0.5, 2, 0), (0.5, 4, 1), (0.5, 0, 0), (0.0, 3, 0), (float("nan"), 3, 0), (1.0, 9, 1), (7.0, 3, 1)],
)
def test_three_windows_and_an_error_are_wanted(
    monkeypatch: pytest.MonkeyPatch, value: float, count: int, told: int
) -> None:
    after = -1.0 if value == 0.0 else 0.01
    assert len(nearest(monkeypatch, [after], value, count)) == told


def size(effect: str, parameter: str, smallest: float | None) -> Detectable:
    return Detectable(effect, parameter, "1/s", smallest, 1.0, ())


def test_the_best_three_are_told_with_their_own_numbers_sizes_and_drives(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []

    def telling_manoeuvres(model: Any, others: Any, noise: Any) -> list[str]:
        asked.append((model, others, noise))
        return [f"drive {number}" for number in range(len(others))]

    monkeypatch.setattr(closest, "telling_manoeuvres", telling_manoeuvres)
    made = [("drag",), ("lag", "grip"), ("drift",), ("more",)]
    items = [
        Judged(1, trial(*own, model=f"with {own[0]}"), 2.0 + number, error(0.25), "suspected", f"why {number}", (), 1.0)
        for number, own in enumerate(made)
    ]
    items[2] = Judged(1, items[2].trial, 4.0, None, "suspected", "why 2", ())
    numbers = {path: Value(float(number), 0.1, "s") for number, path in enumerate(
        ("base.mass", "drag.c", "lag.drag", "grip.g", "grip.h", "drift.d", "dragging.c"))}  # fmt: skip
    sizes = [size("drag", "c", 0.3), size("drag", "d", None), size("lag", "drag", 0.0), size("drift", "d", 0.5),
             size("dragging", "c", 0.6)]  # fmt: skip
    search: Any = SimpleNamespace(current=trial(model="now"))
    noise = np.array([0.1, 0.2])
    found = closest_effects(items, search, [numbers] * 4, sizes, noise)
    assert found == (
        Close("drag", {"drag.c": numbers["drag.c"]}, 0.75, 2.0, {"drag.c": Value(0.3, None, "1/s")}, "drive 0",
              "why 0"),
        Close("lag + grip", {path: numbers[path] for path in ("lag.drag", "grip.g", "grip.h")}, 0.75, 3.0,
              {"lag.drag": Value(0.0, None, "1/s")}, "drive 1", "why 1"),
        Close("drift", {"drift.d": numbers["drift.d"]}, None, 4.0, {"drift.d": Value(0.5, None, "1/s")}, "drive 2",
              "why 2"),
    )  # fmt: skip
    assert asked == [("now", ["with drag", "with lag", "with drift"], noise)]


def test_of_nothing_nothing_is_told() -> None:
    search: Any = SimpleNamespace(current=trial(model="now"))
    assert closest_effects([], search, [], [size("drag", "c", 0.3)], np.ones(2)) == ()
