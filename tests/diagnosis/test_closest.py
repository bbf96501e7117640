"""Where the data decide nothing: which effects are reported as close, in which order and with which numbers."""

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
from safedpa.report.undecided_story import unsure_sentence

NAN = float("nan")


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
    """A verdict next to a model of error 1."""
    own = None if after is None else error(after)
    return Judged(stage, trial(*effects, free=free), gain, own, decision, "why", (), 1.0)


def searching(*candidates: Judged, value: float = 0.4, added: Any = ()) -> Any:
    return SimpleNamespace(candidates=list(candidates), error=error(value), added=list(added))


def names(items: list[Judged]) -> list[str]:
    return [item.trial.name for item in items]


@pytest.mark.parametrize(
    ("item", "value", "reported"),
    [
        (judged("a"), 0.4, True), (judged("a", decision="rejected"), 0.4, True),
        (judged("a", decision="accepted"), 0.4, False), (judged("a", stage=1), 0.4, False),
        (judged("a", stage=3), 0.4, True), (judged("a", gain=1.0), 0.4, False), (judged("a", gain=1.001), 0.4, True),
        (judged("a", gain=-5.0), 0.4, False), (judged("a", after=0.899), 0.4, True),
        (judged("a", after=0.901), 0.4, False), (judged("a", after=1.4), 0.4, False),
        (judged("a", after=0.0), 0.4, True), (judged("a", after=None), 0.4, False), (judged("a", "b"), 0.4, True),
        (judged("a", "drag"), 0.4, False), (judged("drag"), 0.4, False), (judged("a", free=(True, True)), 0.4, True),
        (judged("a", free=(False, False)), 0.4, False), (judged("a", free=(True, False)), 0.5, False),
        (judged("a", free=(True, False)), 0.501, True),  # while half is missing, a bound does not matter
    ],
)  # fmt: skip
def test_a_likely_effect_is_of_the_last_stage_favoured_and_takes_a_tenth_off(
    item: Judged, value: float, reported: bool
) -> None:
    other = judged("other", decision="accepted", after=0.1)
    found = likely_effects(searching(other, item, value=value, added=["drag"]))
    assert names(found) == ([item.trial.name] if reported else [])


def test_the_likely_effect_that_takes_most_off_comes_first() -> None:
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


SURE, UNSURE = (2.0, 1.0, 0.0), (0.5, 1.0, 0.0)


@pytest.mark.parametrize(
    ("numbers", "doubted"),
    [
        *(({"drag.c": number}, doubted) for number, doubted in (
            ((0.8, 0.8, 0.0), False), ((0.8, 0.81, 0.0), True), ((-0.8, 0.81, 0.0), True), ((-0.8, 0.5, 0.0), False),
            ((1.5, 0.4, 1.0), False), ((1.5, 0.6, 1.0), True), ((0.5, 0.6, 1.0), True), ((0.5, 0.4, 1.0), False),
            ((3.0, 0.0, 0.0), True), ((3.0, NAN, 0.0), True), ((0.3, 9.0, None), False),
        )),
        ({"drag.c": SURE, "drag.d": UNSURE}, False), ({"drag.c": UNSURE, "drag.d": SURE}, False),
        ({"drag.c": UNSURE, "drag.d": UNSURE, "lag.t": SURE}, True),
        ({"drag.c": UNSURE, "drag.d": (0.5, 1.0, None)}, True), ({"lag.t": UNSURE}, False),
        ({"base.mass": UNSURE, "drag.c": SURE}, False),
    ],
)  # fmt: skip
def test_an_accepted_effect_is_doubtful_if_all_its_numbers_are_within_one_deviation_of_nothing(
    numbers: dict[str, Any], doubted: bool
) -> None:
    found = doubtful_effects(doubting(numbers, judged("drag", decision="accepted"), added=["drag"]))
    assert names(found) == (["drag"] if doubted else [])


def test_a_doubtful_effect_is_reported_alone_as_it_was_last_accepted_with_the_present_numbers() -> None:
    items = [
        judged("drag", stage=0, decision="accepted", gain=3.0),
        judged("lag", "drag", stage=1, decision="accepted", gain=5.0),
        judged("drag", stage=2, decision="rejected", gain=0.5),
        judged("grip", stage=2, decision="accepted", gain=9.0),
    ]
    search = doubting({"drag.c": UNSURE, "lag.t": UNSURE, "grip.g": SURE}, *items, added=["drag", "lag"])
    found = doubtful_effects(search)
    assert names(found) == ["drag", "lag"]
    assert [(item.stage, item.gain, item.decision) for item in found] == [(1, 5.0, "suspected")] * 2
    assert all(item.trial.fit is search.current.fit and item.trial.loss == 7.0 for item in found)
    assert all("within one deviation of nothing" in item.reason for item in found)
    assert doubtful_effects(doubting({"drag.c": UNSURE}, items[2], items[3], added=["drag"])) == []


def nearest(monkeypatch: pytest.MonkeyPatch, errors: list[float], value: float = 0.5, count: int = 3) -> list[Judged]:
    """Effects 0, 1, ... as their trials come, and the held-out error of each."""
    trials = [trial(str(number), model=after) for number, after in enumerate(errors)]
    windows: Any = SimpleNamespace(windows=range(count))
    search: Any = SimpleNamespace(shooting=windows, error=error(value), current="now")
    monkeypatch.setattr(closest, "tried_in_turn", lambda *_: trials)
    monkeypatch.setattr(closest, "error_with", lambda fit, *_: error(fit.model))
    monkeypatch.setattr(
        closest, "block_gain", lambda one, other, _: (100.0 if one == "now" else -1.0) + float(other.name)
    )
    return nearest_effects(search, [], None)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("errors", "value", "count", "told"),
    [
        ([0.44, 0.46, 0.1, 0.3, float("inf")], 0.5, 3, ["2", "3", "0"]),
        ([0.06, 0.05, 0.04, 0.03, 0.02, 0.01, 0.0], 0.5, 3, ["5", "4", "3", "2", "1", "0"]),  # the first six are tried
        ([0.9], 1.0, 3, []), ([0.899], 1.0, 3, ["0"]), ([1.05], 1.0, 3, []), ([89.9], 100.0, 3, ["0"]),
        ([0.01], 0.5, 2, []), ([0.01], 0.5, 0, []), ([-1.0], 0.0, 3, []), ([0.01], NAN, 3, []), ([0.01], 7.0, 9, ["0"]),
    ],
)  # fmt: skip
def test_with_too_little_data_the_effects_that_take_a_tenth_off_are_reported_best_first(
    errors: list[float], value: float, count: int, told: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = nearest(monkeypatch, errors, value, count)
    assert names(found) == told
    assert [item.gain for item in found] == [100.0 + float(name) for name in told]
    assert [item.error.value for item in found if item.error] == [errors[int(name)] for name in told]
    for item in found:
        assert (item.stage, item.decision, item.reason, item.before) == (0, "suspected", "too little data", value)


def test_the_best_three_have_their_own_numbers_smallest_sizes_and_drives(monkeypatch: pytest.MonkeyPatch) -> None:
    """An effect whose name begins with the name of another does not get the numbers of the other."""
    made = [("drag",), ("lag", "grip"), ("drift",), ("more",)]
    items = [
        Judged(1, trial(*own, model=f"with {own[0]}"), 2.0 + number, error(0.25), "suspected", f"why {number}", (), 1.0)
        for number, own in enumerate(made)
    ]
    items[2] = Judged(1, items[2].trial, 4.0, None, "suspected", "why 2", ())
    paths = ("base.mass", "drag.c", "lag.drag", "grip.g", "grip.h", "drift.d", "dragging.c")
    numbers = {path: Value(float(number), 0.1, "s") for number, path in enumerate(paths)}
    wanted = (
        ("drag", "c", 0.3),
        ("drag", "d", None),
        ("lag", "drag", 0.0),
        ("drift", "d", 0.5),
        ("dragging", "c", 0.6),
    )
    sizes = [Detectable(name, parameter, "1/s", smallest, 1.0, ()) for name, parameter, smallest in wanted]
    search: Any = SimpleNamespace(current=trial(model="now"))
    noise = np.array([0.1, 0.2])

    def manoeuvres(model: Any, others: Any, given: Any) -> list[str]:
        assert (model, others, given is noise) == ("now", ["with drag", "with lag", "with drift"], True)
        return [f"drive {number}" for number in range(len(others))]

    monkeypatch.setattr(closest, "telling_manoeuvres", manoeuvres)

    def smallest(path: str, value: float) -> dict[str, Value]:
        return {path: Value(value, None, "1/s")}

    pair = {path: numbers[path] for path in ("lag.drag", "grip.g", "grip.h")}
    assert closest_effects(items, search, [numbers] * 4, sizes, noise) == (
        Close("drag", {"drag.c": numbers["drag.c"]}, 0.75, 2.0, smallest("drag.c", 0.3), "drive 0", "why 0"),
        Close("lag + grip", pair, 0.75, 3.0, smallest("lag.drag", 0.0), "drive 1", "why 1"),
        Close("drift", {"drift.d": numbers["drift.d"]}, None, 4.0, smallest("drift.d", 0.5), "drive 2", "why 2"),
    )
    monkeypatch.setattr(closest, "telling_manoeuvres", lambda *_: [])
    assert closest_effects([], search, [], sizes, np.ones(2)) == ()


def test_the_undecided_sentence_names_what_helps_and_the_open_size() -> None:
    value = {"value": 0.8, "std": 6.2, "unit": "1/s"}
    document = {
        "added": ["viscous_drag", "understeer"],
        "closest": [{"effect": "viscous_drag", "parameters": {"viscous_drag.coefficient": value}}],
    }
    said = unsure_sentence(document, "viscous_drag and understeer", 0.55, 0.12)
    assert said.startswith(
        "Undecided: with viscous_drag and understeer the error on such driving falls from 0.55 to 0.12"
    )
    assert "coefficient 0.8 +- 6.2 1/s" in said
    assert "understeer (" not in said
