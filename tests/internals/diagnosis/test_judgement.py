"""When a trial is added, which others the data cannot tell from it, and the verdict on it: every limit with numbers."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.diagnosis.fit.trial import EffectTrial
from safedpa.diagnosis.search import acceptance
from safedpa.diagnosis.search.acceptance import (
    SearchStage,
    fewest_parameters,
    is_promising,
    is_spurious_delay,
    judge_trial,
    order_by_heldout_gain,
    passes,
    simplest_equivalent,
    with_reason,
    within_bounds,
)
from safedpa.effects import effect

BASE = "gain on unseen blocks"


def error(value: float) -> Any:
    return SimpleNamespace(value=value)


def trial(*effects: str, loss: float = 0.0, paths: int = 1, free: Any = True, explained: Any = 0.0, **more: Any) -> Any:
    """A trial whose model makes no command late."""
    names = tuple(f"{effects[0]}.{number}" for number in range(paths))
    known = dict.fromkeys(names, SimpleNamespace(neutral=0.0))
    model = SimpleNamespace(system=SimpleNamespace(action_names=()), effects=(), settings={}, parameters=known)
    fit: Any = SimpleNamespace(model=model, paths=names, free=np.full(paths, free), **more)
    return EffectTrial(effects, fit, np.zeros(1), np.asarray(explained, dtype=float), loss)


def searching(value: float = 0.1, loss: float = 0.0, paths: Any = (), region: Any = None) -> Any:
    current = SimpleNamespace(loss=loss, fit=SimpleNamespace(paths=tuple(paths)))
    shooting = SimpleNamespace(windows=SimpleNamespace(horizon=1.25))
    return SimpleNamespace(shooting=shooting, current=current, error=error(value), region=region)


def of(trials: list[Any], gain: float = 0.0, errors: Any = None, **more: Any) -> SearchStage:
    return SearchStage(4, trials, {one.effects: gain for one in trials}, {} if errors is None else errors, **more)


def by_table(monkeypatch: pytest.MonkeyPatch, gains: dict[tuple[str, str], float], alike: float = 0.0) -> None:
    """``gains[one, other]``: how much better the other predicts."""
    monkeypatch.setattr(acceptance, "block_gain", lambda one, other, _: gains[one.name, other.name])
    monkeypatch.setattr(acceptance, "explanation_correlation", lambda *_: alike)


@pytest.mark.parametrize(
    ("gain", "after", "before", "added"),
    [
        (2.0, 50.0, 100.0, False), (2.001, 69.0, 100.0, True), (2.001, 71.0, 100.0, False), (3.0, 0.1, 0.2, False),
        (3.001, 50.0, 100.0, True), (3.001, 96.9, 100.0, True),
        (3.001, 97.1, 100.0, False), (4.5, 97.1, 100.0, False), (4.501, 97.1, 100.0, True),
        (4.501, 99.5, 100.0, True), (4.501, 99.7, 100.0, False), (9.0, 99.7, 100.0, False),
        (9.0, 130.0, 100.0, False), (9.0, math.nan, 100.0, False), (9.0, -1.0, 0.0, False),
        (9.0, 0.1, math.nan, False),
    ],
)  # fmt: skip
def test_a_trial_passes_with_3_standard_errors_and_3_percent_or_4_5_and_0_4_percent(gain, after, before, added):
    assert passes(gain, error(after), error(before)) is added
    assert not passes(gain, None, error(before))
    one = trial("drag")
    assert SearchStage(0, [one], {("drag",): gain}, {("drag",): error(after)}).passes(one, error(before)) is added
    assert not SearchStage(0, [one], {("drag",): gain}, {}).passes(one, error(before))


@pytest.mark.parametrize(
    ("gain", "after", "found"),
    [(1.5, 0.5, False), (1.501, 0.5, True), (1.501, 0.969, True), (1.501, 0.97, False), (9.0, 0.98, False)],
)
def test_a_trial_is_likely_with_1_5_standard_errors_and_3_percent(gain: float, after: float, found: bool) -> None:
    one = trial("drag")
    for size in (1.0, 4.0):
        assert is_promising(one, of([one], gain, {("drag",): error(size * after)}), error(size)) is found
    assert not is_promising(one, of([one], gain), error(1.0))


@pytest.mark.parametrize(
    ("values", "own", "after", "row", "feigned"),
    [
        ({"steering_lag": 0.06}, 1, 0.99, 0.05, False),
        ({"steering_lag": 0.06}, 1, 0.99, 0.06, False),  # a whole row is not the servo's own
        ({"steering_lag": 0.06}, 1, 0.85, 0.061, True),
        ({"steering_lag": 0.06}, 1, 0.849, 0.061, False),
        ({"steering_lag": 0.06}, 1, None, 0.061, True),
        ({"steering_lag": 0.06, "viscous_drag": 0.01}, 2, 0.1, 0.061, True),  # in a pair the fall may be the other's
        ({"steering_lag": 0.06, "viscous_drag": 0.01}, 2, 0.1, 0.05, False),  # a drag has no seconds
        ({"steering_lag": 0.06, "drive_lag": 0.01}, 1, 0.99, 0.05, False),  # another command's lag
        ({"steering_delay": 0.2, "steering_lag": 0.2}, 1, 0.9, 0.05, True),  # late already
        ({"steering_delay": 0.2, "steering_lag": 0.2}, 2, 0.9, 0.05, False),
    ],
)
def test_a_lag_below_one_row_or_a_second_lag_is_spurious_without_a_15_percent_reduction(
    values: dict[str, float], own: int, after: float | None, row: float, feigned: bool
) -> None:
    items = {name: effect("car", name) for name in values}
    settings = {f"{n}.{p.name}": SimpleNamespace(value=values[n]) for n, item in items.items() for p in item.parameters}
    system = SimpleNamespace(action_names=("throttle", "steer"))
    model = SimpleNamespace(system=system, effects=tuple(items.values()), settings=settings)
    one: Any = SimpleNamespace(effects=tuple(values)[:own], fit=SimpleNamespace(model=model))
    assert is_spurious_delay(one, None if after is None else error(after), error(1.0), row) is feigned


@pytest.mark.parametrize(
    ("b_behind", "c_behind", "chosen"), [(1.999, 2.0, "b"), (2.0, 2.0, "a"), (2.0, -1.0, "c"), (5.0, 5.0, "a")]
)
def test_the_simplest_trial_within_two_standard_errors_of_the_best_is_preferred(
    b_behind: float, c_behind: float, chosen: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    best, other, third = trial("a", loss=-3, paths=3), trial("b", loss=-2, paths=2), trial("c", loss=-1, paths=1)
    by_table(monkeypatch, {("a", "a"): 0.0, ("b", "a"): b_behind, ("c", "a"): c_behind})
    assert simplest_equivalent([best, other, third], searching()).name == chosen  # type: ignore[union-attr]


def test_only_trials_within_bounds_and_better_than_the_current_model_are_considered(monkeypatch: pytest.MonkeyPatch):
    by_table(monkeypatch, dict.fromkeys([("a", "a"), ("b", "a"), ("b", "b")], 0.0))
    one, two = trial("a", loss=-2.0), trial("b", loss=-1.0)
    assert simplest_equivalent([one, two], searching()) is one
    assert simplest_equivalent([one, two], searching(loss=-2.0)) is None
    assert simplest_equivalent([one, two], searching(loss=-1.5)) is one
    assert simplest_equivalent([], searching()) is None
    assert simplest_equivalent([trial("a", loss=-2.0, free=False), two], searching()) is two
    many = [trial(f"t{number}", loss=-20.0 + number, paths=20 - number) for number in range(12)]
    by_table(monkeypatch, {(one.name, "t0"): 0.0 for one in many})
    assert simplest_equivalent(many, searching()) is many[7], "the best eight are compared"


@pytest.mark.parametrize(
    ("before", "first", "least", "turned"),
    [
        (0.4, 0.40, 0.30, True), (0.4, 0.35, 0.30, False), (0.25, 0.25, 0.01, False), (0.26, 0.25, 0.01, True),
        (1.0, 0.6499, 0.5, False), (1.0, 0.6501, 0.5, True), (1.0, 0.15, 0.0, False),
    ],
)  # fmt: skip
def test_while_a_quarter_is_missing_a_trial_with_a_15_percent_larger_reduction_comes_first(
    before: float, first: float, least: float, turned: bool
) -> None:
    one, middle, other = trial("a"), trial("b"), trial("c")
    errors = {("a",): error(first), ("b",): error(least + 0.001), ("c",): error(least)}
    found = order_by_heldout_gain([one, middle, other], of([one, middle, other], errors=errors), error(before))
    assert found == ([other, one, middle] if turned else [one, middle, other])
    assert order_by_heldout_gain([one, other], of([one], errors=errors), error(before)) == (
        [other, one] if turned else [one, other]
    )
    assert order_by_heldout_gain([one], of([one], errors={}), error(before)) == [one]


@pytest.mark.parametrize(
    ("free", "paths", "value", "reported"),
    [
        ([False, True, True], ["x"], 0.1, True),  # the base's own number may be at its bound
        ([False, True, True], [], 0.1, False), ([True, False, True], ["x"], 0.1, False),
        ([True, False, True], ["x"], 0.5, False), ([True, False, True], ["x"], 0.501, True),
    ],
)  # fmt: skip
def test_an_effect_at_a_bound_is_rejected_unless_half_of_the_physics_is_missing(free, paths, value, reported):
    pushed = trial("a", paths=3)
    pushed.fit.free[:] = free
    assert within_bounds(pushed, searching(value=value, paths=paths)) is reported


def test_among_identical_explanations_the_one_with_the_fewest_parameters_is_chosen() -> None:
    explained = np.array([3.0, 4.0])
    big, two, one = (trial(n, loss=-1, paths=p, explained=explained) for n, p in (("big", 3), ("two", 2), ("one", 1)))
    alike = trial("alike", loss=-1, paths=1, explained=explained + np.array([0.0, 0.3]))
    as_many, worse = trial("as", loss=-1, paths=3, explained=explained), trial("w", loss=0, explained=explained)
    pushed = trial("pushed", loss=-1, free=False, explained=explained)
    assert fewest_parameters(big, [big, two, one], searching()) is one
    assert fewest_parameters(big, [big, two, alike], searching()) is two
    assert fewest_parameters(big, [as_many, worse, pushed, alike], searching()) is big


@pytest.mark.parametrize(
    ("whole", "other", "same"),
    [
        ([5.0, 0.0], [5.0, 0.22362], False), ([5.0, 0.0], [5.0, 0.2235], True), ([5.0, 0.2235], [5.0, 0.0], True),
        ([5.0, 0.22362], [5.0, 0.0], False), ([1000.0**0.5, 0.0], [1000.0**0.5, 2.003**0.5], False),
    ],
)  # fmt: skip
def test_two_trials_are_identical_up_to_1_500_of_the_smaller_square(whole: list[float], other: list[float], same: bool):
    """25 / 500 = 0.05 = 0.22361^2; a 500th of the larger one would be 2.006 in the last case."""
    big, one = trial("big", paths=2, loss=-1, explained=whole), trial("one", loss=-1, explained=other)
    assert (fewest_parameters(big, [one], searching()) is one) is same


@pytest.mark.parametrize(
    ("gain", "after", "passed", "decision", "reason"),
    [
        (5.04, 0.05, True, "accepted", "5.0 standard errors; the held-out error after 1.25 s changes by -50.0 %"),
        (5.0, 0.05, False, "suspected",
         "5.0 standard errors; the held-out error after 1.25 s changes by -50.0 %: "
         "the error falls too little to add it"),
        (3.0, 0.11, False, "rejected", "3.0 standard errors; the held-out error after 1.25 s changes by +10.0 %"),
        (3.1, None, False, "suspected", "3.1 standard errors: the error falls too little to add it"),
    ],
)  # fmt: skip
def test_the_verdict_on_the_best_trial(gain: float, after: float | None, passed: bool, decision: str, reason: str):
    one = trial("a")
    stage = of([one], gain, {} if after is None else {("a",): error(after)})
    found = judge_trial(searching(), stage, one, one, passed)
    assert (found.decision, found.reason) == (decision, f"{BASE} {reason}")
    assert (found.stage, found.trial, found.gain, found.before, found.equals) == (4, one, gain, 0.1, ())
    assert (found.error.value if found.error else None) == after
    again = with_reason(found, "suspected", "but it rains")
    assert (again.decision, again.reason) == ("suspected", f"{BASE} {reason}; but it rains")
    assert (again.trial, again.gain, again.before) == (one, gain, 0.1)


def test_a_trial_is_suspected_if_a_region_explains_more_or_the_filter_does_not_confirm_it() -> None:
    one, errors = trial("a"), {("a",): error(0.05)}
    found = judge_trial(searching(region=object()), of([one], 5.0, errors), one, one, False)
    assert found.decision == "suspected"
    assert found.reason.endswith("changes by -50.0 %; but a region of the floor explains more")
    found = judge_trial(searching(region=object()), of([one], 5.0, errors), one, None, False)
    assert found.reason.endswith("the error falls too little to add it"), "it is not the best"
    doubted = of([one], 5.0, errors, doubted=frozenset({("a",)}))
    found = judge_trial(searching(), doubted, one, None, False)
    assert found.decision == "suspected"
    assert found.reason.endswith("but a filter that estimates lasting disturbances does not confirm it")


@pytest.mark.parametrize(
    ("gain", "behind", "alike", "decision"),
    [
        (3.1, 1.99, 0.0, "suspected"), (3.1, 2.0, 0.0, "rejected"), (3.0, 1.99, 0.0, "rejected"),
        (3.0, 1.99, 0.95, "suspected"), (1.5, 1.99, 0.95, "rejected"), (3.1, 2.5, 0.99, "suspected"),
    ],
)  # fmt: skip
def test_a_trial_that_the_data_cannot_distinguish_from_the_accepted_one_is_suspected(
    monkeypatch: pytest.MonkeyPatch, gain: float, behind: float, alike: float, decision: str
) -> None:
    one, best = trial("a", loss=-1.0), trial("b", loss=-2.0)
    by_table(monkeypatch, {("a", "b"): behind, ("b", "a"): -behind}, alike)
    found = judge_trial(searching(), of([best, one], gain), one, best, True)
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
def test_two_trials_are_equivalent_if_gains_are_close_and_explanations_correlated(monkeypatch, apart, alike, equal):
    one, other = trial("a", loss=-1.0), trial("b", loss=-2.0)
    by_table(monkeypatch, {("b", "a"): apart}, alike)
    assert judge_trial(searching(), of([one, other], 2.0), one, None, False).equals == (("b",) if equal else ())


def test_the_best_ten_that_fit_better_and_share_no_effect_are_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    by_table(monkeypatch, {("b", "a"): 9.0, ("c", "a"): 0.0, ("a + d", "a"): 0.0}, 0.6)
    one, other = (trial(name, loss=-1.0, explained=[1.0, 2.0]) for name in "ab")
    every = [one, other, trial("c", loss=0.0), trial("a", "d", loss=-1.0)]
    assert judge_trial(searching(), of(every, 1.6), one, None, False).equals == ("b",), "it explains the same"
    assert judge_trial(searching(), of(every, 1.5), one, None, False).equals == ()
    trials = [trial(f"t{number:02d}", loss=-1.0) for number in range(14)]
    by_table(monkeypatch, {(one.name, "t00"): 0.0 for one in trials}, 0.6)
    found = judge_trial(searching(), of(trials, 2.0), trials[0], None, False).equals
    assert found == tuple(f"t{number:02d}" for number in range(1, 10))


P, Q, R = np.eye(3)


@pytest.mark.parametrize(
    ("known", "new", "effects", "base"),
    [
        ([P, Q], [3 * P + 4 * Q], "a", "q"),
        ([P, 100 * Q], [3 * P + 4 * Q], "a", "q"), ([100 * P, Q], [3 * P + 4 * Q], "a", "q"),  # whatever the unit
        ([1e-4 * P, 1e-6 * Q], [3e-6 * P + 4e-6 * Q], "a", "q"), ([P + 0.1 * Q, Q], [10 * P, Q], "a", "q"),
        ([0 * P, Q], [Q], "a", "q"), ([1e-6 * P, 1e-6 * Q], [3e-6 * P + 4e-6 * Q], "a", "q"),
        ([P + 0.1 * Q, Q], [P, Q], "a", "q"), ([P, Q], [-4 * P + 3 * Q], "a", "p"),
        ([P, Q], [P + 0.04 * R], "a", "p"),  # 0.0016 of the squares are left
        ([P, Q], [P + 0.05 * R], "a", ""),  # 0.0025 are
        ([P, Q], [100 * P + 5 * R], "a", ""), ([P, Q], [1e-2 * P + 1e-3 * R], "a", ""),
        ([P, Q], [P, R], "a", ""),  # half of it is new
        ([P, Q], [P], "ab", ""),  # pairs are not asked
        ([P, Q], [0 * P], "a", ""), ([P], [P], "a", "p"),
    ],
)  # fmt: skip
def test_an_effect_that_a_free_parameter_can_absorb_is_rejected_with_its_name(known, new, effects, base):
    item = trial(*effects, columns=np.column_stack([*known, *new])[:, None, :])
    search = searching(paths=[f"base.{name}" for name in "pq"[: len(known)]])
    found = judge_trial(search, of([item], 9.0), item, item, True)
    if base:
        assert (found.decision, found.equals) == ("rejected", (f"base.{base}",))
        assert found.reason == f"the free base.{base} does the same"
        assert (found.stage, found.gain, found.before) == (4, 9.0, 0.1)
    else:
        assert found.decision == "accepted"
