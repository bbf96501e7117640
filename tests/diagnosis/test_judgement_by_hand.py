"""When a trial is added, which others the data cannot tell from it, and what is said of it: at every limit, by hand."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.diagnosis.fit.trial import Trial
from safedpa.diagnosis.search import judgement
from safedpa.diagnosis.search.judgement import (
    Stage,
    farthest,
    feigned_lateness,
    inside,
    judged,
    likely,
    passes,
    plainest,
    preferred,
    with_reason,
)
from safedpa.effects import effect

NONE = float("nan")


def error(value: float) -> Any:
    return SimpleNamespace(value=value)


def trial(*effects: str, loss: float = 0.0, paths: int = 1, free: Any = True, explained: Any = 0.0, **more: Any) -> Any:
    """Of a model that makes nothing late."""
    model = SimpleNamespace(system=SimpleNamespace(action_names=()), effects=(), settings={})
    names = tuple(f"{effects[0]}.{number}" for number in range(paths))
    fit: Any = SimpleNamespace(model=model, paths=names, free=np.full(paths, free), **more)
    return Trial(effects, fit, np.zeros(1), np.asarray(explained, dtype=float), loss)


def searching(value: float = 0.1, loss: float = 0.0, paths: Any = (), patch: Any = None) -> Any:
    fit = SimpleNamespace(paths=tuple(paths))
    windows = SimpleNamespace(horizon=1.25)
    current = SimpleNamespace(loss=loss, fit=fit)
    return SimpleNamespace(shooting=SimpleNamespace(windows=windows), current=current, error=error(value), patch=patch)


def of(trials: list[Any], gain: float = 0.0, errors: Any = None, **more: Any) -> Stage:
    return Stage(4, trials, {one.effects: gain for one in trials}, {} if errors is None else errors, **more)


def by_table(monkeypatch: pytest.MonkeyPatch, gains: dict[tuple[str, str], float], alike: float = 0.0) -> None:
    """``gains[one, other]``: how much better the other predicts."""
    monkeypatch.setattr(judgement, "block_gain", lambda one, other, _: gains[one.name, other.name])
    monkeypatch.setattr(judgement, "likeness", lambda *_: alike)


@pytest.mark.parametrize(
    ("gain", "after", "added"),
    [
        (3.0, 50.0, False), (3.001, 50.0, True), (3.001, 96.9, True), (3.001, 97.1, False), (4.5, 97.1, False),
        (4.501, 97.1, True), (4.501, 99.5, True), (4.501, 99.7, False), (9.0, 99.7, False), (9.0, 100.0, False),
        (9.0, 130.0, False), (2.0, 0.0, False), (9.0, NONE, False),
    ],
)  # fmt: skip
def test_three_standard_errors_and_three_hundredths_or_more_of_one_and_less_of_the_other(
    gain: float, after: float, added: bool
) -> None:
    assert passes(gain, error(after), error(100.0)) is added


def test_what_was_not_worked_out_or_falls_from_nothing_is_not_added() -> None:
    assert not passes(9.0, None, error(1.0))
    assert not passes(9.0, error(-1.0), error(0.0))
    assert not passes(9.0, error(0.1), error(NONE))
    assert not passes(9.0, error(0.0), error(NONE))


def test_a_trial_of_a_stage_is_added_by_its_own_gain_and_error() -> None:
    one = trial("drag")
    stage = Stage(0, [one], {("drag",): 4.0}, {("drag",): error(0.05)})
    assert stage.passes(one, error(0.1))
    assert not Stage(0, [one], {("drag",): 2.9}, {("drag",): error(0.05)}).passes(one, error(0.1))
    assert not Stage(0, [one], {("drag",): 4.0}, {}).passes(one, error(0.1))
    assert stage.row == 0.0, "nothing is late by less than no row"


@pytest.mark.parametrize(
    ("gain", "after", "found"),
    [(1.5, 0.5, False), (1.501, 0.5, True), (1.501, 0.969, True), (1.501, 0.97, False), (9.0, 0.98, False)],
)
def test_likely_is_one_and_a_half_standard_errors_and_three_hundredths(gain: float, after: float, found: bool) -> None:
    one = trial("drag")
    assert likely(one, of([one], gain, {("drag",): error(after)}), error(1.0)) is found
    assert likely(one, of([one], gain, {("drag",): error(4.0 * after)}), error(4.0)) is found
    assert not likely(one, of([one], gain), error(1.0))


def late(name: str, seconds: float, *more: tuple[str, float]) -> Any:
    items = {one: effect("car", one) for one in (name, *(other for other, _ in more))}
    values = {name: seconds, **dict(more)}
    settings = {
        f"{one}.{p.name}": SimpleNamespace(value=values[one]) for one, item in items.items() for p in item.parameters
    }
    system = SimpleNamespace(action_names=("throttle", "steer"))
    return SimpleNamespace(system=system, effects=tuple(items.values()), settings=settings)


def test_what_feigns_lateness_is_judged_by_the_row_and_by_a_fall_of_fifteen_hundredths() -> None:
    """A lag beside one that is there already; alone, one of less than a row; a pair whatever it takes off."""
    lag, row = late("steering_lag", 0.06), 0.05
    alone = SimpleNamespace(effects=("steering_lag",), fit=SimpleNamespace(model=lag))
    assert not feigned_lateness(alone, error(0.99), error(1.0), row)  # type: ignore[arg-type]
    assert not feigned_lateness(alone, error(0.99), error(1.0), 0.06), "a whole row is none of the servo's"  # type: ignore[arg-type]
    assert feigned_lateness(alone, error(0.85), error(1.0), 0.061)  # type: ignore[arg-type]
    assert not feigned_lateness(alone, error(0.849), error(1.0), 0.061)  # type: ignore[arg-type]
    assert feigned_lateness(alone, None, error(1.0), 0.061)  # type: ignore[arg-type]
    model = late("steering_lag", 0.06, ("viscous_drag", 0.01))
    pair = SimpleNamespace(effects=("steering_lag", "viscous_drag"), fit=SimpleNamespace(model=model))
    assert feigned_lateness(pair, error(0.1), error(1.0), 0.061)  # type: ignore[arg-type]
    slow = late("steering_lag", 0.06, ("drive_lag", 0.01))
    other = SimpleNamespace(effects=("steering_lag",), fit=SimpleNamespace(model=slow))
    assert not feigned_lateness(other, error(0.99), error(1.0), row), "another command's lag is none of its own"  # type: ignore[arg-type]
    assert not feigned_lateness(pair, error(0.1), error(1.0), row), "a drag has no seconds"  # type: ignore[arg-type]
    twice = late("steering_delay", 0.2, ("steering_lag", 0.2))
    second = SimpleNamespace(effects=("steering_delay",), fit=SimpleNamespace(model=twice))
    assert feigned_lateness(second, error(0.9), error(1.0), row)  # type: ignore[arg-type]
    both = SimpleNamespace(effects=("steering_delay", "steering_lag"), fit=SimpleNamespace(model=twice))
    assert not feigned_lateness(both, error(0.9), error(1.0), row), "they come together"  # type: ignore[arg-type]


def test_the_simplest_of_those_that_cannot_be_told_from_the_best_is_preferred(monkeypatch: pytest.MonkeyPatch) -> None:
    best, other, third = trial("a", loss=-3, paths=3), trial("b", loss=-2, paths=2), trial("c", loss=-1, paths=1)
    table = {("a", "a"): 0.0, ("b", "a"): 1.999, ("c", "a"): 2.0}
    by_table(monkeypatch, table)
    assert preferred([best, other, third], searching()) is other, "two standard errors tell the third from the best"
    table["b", "a"] = 2.0
    assert preferred([best, other, third], searching()) is best
    table["c", "a"] = -1.0
    assert preferred([best, other, third], searching()) is third
    table["a", "a"] = table["b", "a"] = table["c", "a"] = 5.0
    assert preferred([best, other, third], searching()) is best, "no other is close to it"


def test_of_as_many_numbers_the_better_one_is_preferred_and_only_what_fits_better_than_before(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    by_table(monkeypatch, dict.fromkeys([("a", "a"), ("b", "a"), ("b", "b")], 0.0))
    one, two = trial("a", loss=-2.0), trial("b", loss=-1.0)
    assert preferred([one, two], searching()) is one
    assert preferred([one, two], searching(loss=-2.0)) is None
    assert preferred([one, two], searching(loss=-1.5)) is one
    assert preferred([], searching()) is None
    bound = trial("a", loss=-2.0, free=False)
    assert preferred([bound, two], searching()) is two


def test_only_the_best_eight_are_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    trials = [trial(f"t{number}", loss=-20.0 + number, paths=20 - number) for number in range(12)]
    by_table(monkeypatch, {(one.name, "t0"): 0.0 for one in trials})
    assert preferred(trials, searching()) is trials[7]


@pytest.mark.parametrize(
    ("before", "first", "least", "turned"),
    [
        (0.4, 0.40, 0.30, True), (0.4, 0.35, 0.30, False), (0.25, 0.25, 0.01, False), (0.26, 0.25, 0.01, True),
        (1.0, 0.6499, 0.5, False), (1.0, 0.6501, 0.5, True),
    ],
)  # fmt: skip
def test_what_takes_fifteen_hundredths_more_off_comes_first_while_a_quarter_is_missing(
    before: float, first: float, least: float, turned: bool
) -> None:
    one, middle, other = trial("a"), trial("b"), trial("c")
    errors = {("a",): error(first), ("b",): error(least + 0.001), ("c",): error(least)}
    found = farthest([one, middle, other], of([one, middle, other], errors=errors), error(before))
    assert found == ([other, one, middle] if turned else [one, middle, other])
    found = farthest([one, other], of([one, other], errors=errors), error(before))
    assert found == ([other, one] if turned else [one, other])


def test_at_the_limit_of_the_fall_the_order_stays() -> None:
    one, other = trial("a"), trial("b")
    errors = {("a",): error(0.15), ("b",): error(0.0)}
    assert farthest([one, other], of([one, other], errors=errors), error(1.0)) == [one, other]
    assert farthest([one], of([one], errors={}), error(1.0)) == [one]


def test_a_number_at_its_bound_is_no_proof_while_half_is_missing() -> None:
    pushed = trial("a", paths=3)
    pushed.fit.free[:] = [False, True, True]
    assert inside(pushed, searching(paths=["x"])), "the model's own number may stand at its bound"
    assert not inside(pushed, searching())
    pushed.fit.free[:] = [True, False, True]
    assert not inside(pushed, searching(paths=["x"]))
    assert not inside(pushed, searching(value=0.5, paths=["x"]))
    assert inside(pushed, searching(value=0.501, paths=["x"]))


def test_the_plainest_explains_the_very_same_with_the_fewest_numbers() -> None:
    explained = np.array([3.0, 4.0])
    big, two, one = (trial(n, loss=-1, paths=p, explained=explained) for n, p in (("big", 3), ("two", 2), ("one", 1)))
    alike = trial("alike", loss=-1, paths=1, explained=explained + np.array([0.0, 0.3]))
    as_many, worse = trial("as", loss=-1, paths=3, explained=explained), trial("w", loss=0, explained=explained)
    pushed = trial("pushed", loss=-1, free=False, explained=explained)
    search = searching()
    assert plainest(big, [big, two, one], search) is one
    assert plainest(big, [big, two, alike], search) is two, "0.09 of 25 is more than a five hundredth"
    assert plainest(big, [as_many, worse, pushed, alike], search) is big


@pytest.mark.parametrize(("off", "same"), [(0.2236, False), (0.2236 - 1e-4, True), (0.3, False), (0.0, True)])
def test_one_and_the_same_is_a_difference_of_a_five_hundredth_of_the_smaller_one(off: float, same: bool) -> None:
    """25 / 500 = 0.05 = 0.22361^2; the larger of both does not count."""
    big, one = trial("big", paths=2, loss=-1, explained=[5.0, 0.0]), trial("one", loss=-1, explained=[5.0, off])
    off_by = 0.2236068 if off == 0.2236 else off
    one.explained[1] = off_by
    assert (plainest(big, [one], searching()) is one) is same
    turned = trial("turned", paths=2, loss=-1, explained=[5.0, off_by]), trial("less", loss=-1, explained=[5.0, 0.0])
    assert (plainest(turned[0], [turned[1]], searching()) is turned[1]) is same


def test_the_smaller_of_both_is_what_counts() -> None:
    """3 of 1000 beside 1000 + 3: a five hundredth of the larger would be 2.006."""
    big = trial("big", paths=2, loss=-1, explained=[math.sqrt(1000.0), 0.0])
    one = trial("one", loss=-1, explained=[math.sqrt(1000.0), math.sqrt(2.003)])
    assert plainest(big, [one], searching()) is big


BASE = "gain on unseen blocks"


@pytest.mark.parametrize(
    ("gain", "after", "passed", "decision", "reason"),
    [
        (5.04, 0.05, True, "accepted",
         f"{BASE} 5.0 standard errors; the held-out error after 1.25 s changes by -50.0 %"),
        (5.0, 0.05, False, "suspected",
         f"{BASE} 5.0 standard errors; the held-out error after 1.25 s changes by -50.0 %: too little to be worth it"),
        (3.0, 0.11, False, "rejected",
         f"{BASE} 3.0 standard errors; the held-out error after 1.25 s changes by +10.0 %"),
        (3.1, None, False, "suspected", f"{BASE} 3.1 standard errors: too little to be worth it"),
    ],
)  # fmt: skip
def test_what_is_said_of_the_best(gain: float, after: float | None, passed: bool, decision: str, reason: str) -> None:
    one = trial("a")
    stage = of([one], gain, {} if after is None else {("a",): error(after)})
    found = judged(searching(), stage, one, one, passed)
    assert (found.decision, found.reason) == (decision, reason)
    assert (found.stage, found.trial, found.gain, found.before, found.equals) == (4, one, gain, 0.1, ())
    assert (found.error.value if found.error else None) == after


def test_where_a_place_explains_more_or_the_filter_doubts_it_is_suspected() -> None:
    one, errors = trial("a"), {("a",): error(0.05)}
    found = judged(searching(patch=object()), of([one], 5.0, errors), one, one, False)
    assert found.decision == "suspected"
    assert found.reason.endswith("changes by -50.0 %; but a place explains more")
    found = judged(searching(patch=object()), of([one], 5.0, errors), one, None, False)
    assert found.reason.endswith("too little to be worth it"), "it is not the best"
    doubted = of([one], 5.0, errors, doubted=frozenset({("a",)}))
    found = judged(searching(), doubted, one, None, False)
    assert found.decision == "suspected"
    assert found.reason.endswith("but a filter that knows lasting pushes does not confirm it")


@pytest.mark.parametrize(
    ("gain", "behind", "alike", "decision"),
    [
        (3.1, 1.99, 0.0, "suspected"), (3.1, 2.0, 0.0, "rejected"), (3.0, 1.99, 0.0, "rejected"),
        (3.0, 1.99, 0.95, "suspected"), (1.5, 1.99, 0.95, "rejected"), (3.1, 2.5, 0.99, "suspected"),
    ],
)  # fmt: skip
def test_who_passed_beside_a_better_one_is_suspected_where_they_cannot_be_told_apart(
    monkeypatch: pytest.MonkeyPatch, gain: float, behind: float, alike: float, decision: str
) -> None:
    one, best = trial("a", loss=-1.0), trial("b", loss=-2.0)
    by_table(monkeypatch, {("a", "b"): behind, ("b", "a"): -behind}, alike)
    found = judged(searching(), of([best, one], gain), one, best, True)
    assert found.decision == decision
    assert found.reason == f"{BASE} {gain:.1f} standard errors; {behind:.1f} standard errors behind b"
    assert found.equals == (("b",) if alike and gain > 1.5 else ())


@pytest.mark.parametrize(
    ("apart", "alike", "equal"),
    [
        (0.99, 0.51, True), (1.0, 0.51, False), (0.99, 0.5, False), (-0.99, 0.51, True), (-1.0, 0.51, False),
        (1.99, 0.91, True), (2.0, 0.91, False), (1.99, 0.9, False), (2.99, 0.986, True), (3.0, 0.986, False),
        (2.99, 0.985, False), (-2.99, 0.986, True), (9.0, -1.0, False), (0.5, -0.99, False),
    ],
)  # fmt: skip
def test_two_are_equal_the_closer_they_predict_the_less_alike_they_need_be(
    monkeypatch: pytest.MonkeyPatch, apart: float, alike: float, equal: bool
) -> None:
    one, other = trial("a", loss=-1.0), trial("b", loss=-2.0)
    by_table(monkeypatch, {("b", "a"): apart}, alike)
    assert judged(searching(), of([one, other], 2.0), one, None, False).equals == (("b",) if equal else ())


def test_who_explains_the_very_same_is_equal_whatever_blocks_say(monkeypatch: pytest.MonkeyPatch) -> None:
    by_table(monkeypatch, {("b", "a"): 9.0, ("c", "a"): 0.0, ("a + d", "a"): 0.0}, 0.6)
    one, other = (trial(name, loss=-1.0, explained=[1.0, 2.0]) for name in "ab")
    no_better, with_it = trial("c", loss=0.0), trial("a", "d", loss=-1.0)
    assert judged(searching(), of([one, other, no_better, with_it], 1.6), one, None, False).equals == ("b",)
    assert judged(searching(), of([one, other, no_better, with_it], 1.5), one, None, False).equals == ()


def test_the_best_ten_are_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    trials = [trial(f"t{number:02d}", loss=-1.0) for number in range(14)]
    by_table(monkeypatch, {(one.name, "t00"): 0.0 for one in trials}, 0.6)
    found = judged(searching(), of(trials, 2.0), trials[0], None, False).equals
    assert found == tuple(f"t{number:02d}" for number in range(1, 10))


def with_columns(known: Any, new: Any, *effects: str) -> Any:
    columns = np.column_stack([*known, *new])[:, None, :]
    return trial(*(effects or ("a",)), columns=columns)


def test_what_free_numbers_do_already_is_rejected_and_the_most_alike_of_them_named() -> None:
    """Two numbers of the base span what the effect does: 3 p + 4 q."""
    p, q, r = np.eye(3)
    search = searching(paths=["base.p", "base.q"])
    item = with_columns([p, q], [3.0 * p + 4.0 * q])
    found = judged(search, of([item], 9.0), item, item, True)
    assert (found.decision, found.equals) == ("rejected", ("base.q",))
    assert found.reason == "the free base.q does the same"
    assert (found.stage, found.gain, found.before) == (4, 9.0, 0.1)
    for known, new, base in (
        ([p, 100.0 * q], [3.0 * p + 4.0 * q], "base.q"),
        ([1e-4 * p, 1e-6 * q], [3e-6 * p + 4e-6 * q], "base.q"),
        ([p + 0.1 * q, q], [10.0 * p, q], "base.q"),
        ([0.0 * p, q], [q], "base.q"),
    ):
        sized = with_columns(known, new)
        assert judged(search, of([sized], 9.0), sized, sized, True).equals == (base,), "whatever the sizes"
    weak = with_columns([1e-6 * p, 1e-6 * q], [3e-6 * p + 4e-6 * q])
    assert judged(search, of([weak], 9.0), weak, weak, True).equals == ("base.q",)
    long = with_columns([p, q], [100.0 * p + 5.0 * r])
    assert judged(search, of([long], 9.0), long, long, True).decision == "accepted", "0.0025 of a large one"
    short = with_columns([p, q], [1e-2 * p + 1e-3 * r])
    assert judged(search, of([short], 9.0), short, short, True).decision == "accepted", "a hundredth of a small one"
    spread = with_columns([p + 0.1 * q, q], [p, q])
    assert judged(search, of([spread], 9.0), spread, spread, True).equals == ("base.q",), "one of its numbers whole"
    larger = with_columns([100.0 * p, q], [3.0 * p + 4.0 * q])
    assert judged(search, of([larger], 9.0), larger, larger, True).equals == ("base.q",), "whatever its unit"
    opposite = with_columns([p, q], [-4.0 * p + 3.0 * q])
    assert judged(search, of([opposite], 9.0), opposite, opposite, True).equals == ("base.p",)
    left = with_columns([p, q], [p + 0.05 * r])
    assert judged(search, of([left], 9.0), left, left, True).decision == "accepted", "0.0025 of its squares are left"
    hardly = with_columns([p, q], [p + 0.04 * r])
    assert judged(search, of([hardly], 9.0), hardly, hardly, True).decision == "rejected", "0.0016"
    two = with_columns([p, q], [p, r])
    assert judged(search, of([two], 9.0), two, two, True).decision == "accepted", "half of it is new"
    pair = with_columns([p, q], [p], "a", "b")
    assert judged(search, of([pair], 9.0), pair, pair, True).decision == "accepted", "pairs are not asked"
    nothing = with_columns([p, q], [0.0 * p])
    assert judged(search, of([nothing], 9.0), nothing, nothing, True).decision == "accepted"
    one = searching(paths=["base.p"])
    only = with_columns([p], [p])
    assert judged(one, of([only], 9.0), only, only, True).equals == ("base.p",)


def test_what_is_decided_anew_tells_both_reasons() -> None:
    one = trial("a")
    first = judged(searching(), of([one], 1.0), one, None, False)
    again = with_reason(first, "suspected", "but it rains")
    assert (again.decision, again.reason) == ("suspected", f"{BASE} 1.0 standard errors; but it rains")
    assert (again.trial, again.gain, again.before) == (one, 1.0, 0.1)
