"""Edges of a filter's check: several actions, several barriers, and which of several cases is reported."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.safety.checked import Values, first, made, probe, slide

from safedpa.errors import InputError
from safedpa.safety import FilterSettings, FunctionBarrier, RolloutBarrier, SafetyFilter, check_filter
from safedpa.safety.checks.backup import backup_issues, horizon_issues
from safedpa.safety.checks.barriers import condition_issues, gradient_issues, margin_issues, scale_issues, tick_issues
from safedpa.safety.checks.probes import FilterUnderTest, collect_probes
from safedpa.safety.prediction.predictor import Prediction
from safedpa.safety.validation import Plausible
from safedpa.safety.verdict import Status, resting_verdict

SETTINGS = FilterSettings(action_low=(-1.0,), action_high=(1.0,), epsilon=0.001)


def wide(x: Values) -> tuple[Values, Values]:
    return x, np.full((len(x), 2), 0.1)


@pytest.mark.parametrize(
    ("action", "reported"),
    [([0.0, 0.0], False), ([0.0, np.nan], True), ([-1.5, 0.0], True), ([0.0, 2.5], True), ([2.0, -1.0], False)],
)
def test_one_entry_of_a_backup_is_enough(action: list[float], reported: bool) -> None:
    checked = made(first, model=wide, actions=2, backup=lambda x: action if x[0] == 1.0 else [0.0, 0.0])
    assert bool(backup_issues(checked, [probe(0.0), probe(1.0)], can_stop=False)) is reported


@pytest.mark.parametrize(("beyond", "reported"), [(3e-6, False), (5e-6, True)])
def test_rounding_is_a_share_of_the_range(beyond: float, reported: bool) -> None:
    """4000 from end to end: a billionth of that is 4e-6."""
    limits = (-1000.0, 3000.0)
    checked = made(first, limits=limits, backup=lambda x: [3000.0 + beyond * (x[0] == 1.0)])
    assert bool(backup_issues(checked, [probe(1.0)], can_stop=False)) is reported
    part = RolloutBarrier(lambda x: (x, 0.1 * np.eye(1)), [0.0], first, 5, ["r"])
    other = made(part, limits=limits, backup=lambda x: [beyond])
    assert bool(backup_issues(other, [probe(1.0)], can_stop=False)) is reported


def test_an_action_is_moved_inward_by_a_tenth_of_its_range_and_one_entry_of_another_backup_is_enough() -> None:
    part = RolloutBarrier(wide, [0.0, 0.5], first, 5, ["r"])
    checked = made(part, model=wide, actions=2, backup=lambda x: [0.0, 0.4])
    assert len(backup_issues(checked, [probe(1.0), probe(2.0)], can_stop=False)) == 1
    checked, asked = recorded(made(first))
    condition_issues(checked, [probe(0.5, h=0.5, residuals=[[-0.3], [-0.1]], kept=False)])
    assert sorted({round(action, 9) for action in asked}) == [-1.0, -0.7, 0.5, 0.8, 1.7, 2.0]


def test_of_conditions_that_break_or_are_missed_the_worst_is_named_first() -> None:
    checked = made(first, lambda x: 3.0 * x[0], backup=lambda x: [-1.0])
    (found,) = backup_issues(checked, [probe(0.5, h=[0.5, 1.5])], can_stop=True)
    assert found.names == ("h1", "h0")
    one = probe(0.5, h=[0.5] * 2, residuals=[[-0.1, -0.3], [-0.9, -0.3]], kept=False)
    (found,) = condition_issues(made(first, first), [one])
    assert found.names == ("h1", "h0")


def test_of_a_rollout_with_two_values_both_count() -> None:
    """The second falls for ever, the first stands; and one that is below its threshold is no promise."""
    part = RolloutBarrier(lambda x: (x - 0.1, 0.1 * np.eye(1)), [0.0], lambda x: [9.0, x[0]], 3, ["a", "b"])
    checked = made(part, epsilon=0.5, eta=0.5)
    assert len(horizon_issues(checked, [probe(8.0, h=[9.0, 7.7]), probe(7.0, h=[9.0, 6.7])])) == 1
    assert horizon_issues(checked, [probe(8.0, h=[9.0, 1.0])]), "just at the threshold is inside"
    assert horizon_issues(checked, [probe(8.0, h=[9.0, 0.99])]) == []


def recorded(checked: FilterUnderTest) -> tuple[FilterUnderTest, list[float]]:
    asked: list[float] = []

    def step(state: Values, action: Values) -> Values:
        asked.append(float(action[0]))
        f, g = slide(state)
        return np.asarray(f + g @ action)

    tools = replace(checked.safe.tools, prediction=Prediction(slide, step))
    safe: Any = type("Safe", (), {"settings": checked.safe.settings, "tools": tools})()
    return FilterUnderTest(safe, checked.barriers, checked.margins, None), asked


def curving(x: Values) -> tuple[Values, Values]:
    """Position follows the push at once where x_0 < 1, half of it within the tick below 5, none of it beyond."""
    now = 0.1 if x[0] < 1.0 else 0.005 if x[0] < 5.0 else 0.0
    return np.array([x[0] + 0.1 * x[1], x[1]]), np.array([[now], [0.1]])


def test_states_where_the_condition_breaks_are_judged_and_no_others() -> None:
    """Two break it; one is outside, one keeps it by little, one only just; of 30 the first 24 are judged."""
    broken = probe(2.0, -1.0, h=0.5, residuals=[[-0.3], [0.1]])
    others = [
        probe(2.1, -1.0, h=0.5, residuals=[[-0.3], [-0.1]], inside=False),
        probe(2.2, -1.0, h=0.5, residuals=[[0.5], [0.9]]),
        probe(2.3, -1.0, h=0.5, residuals=[[0.0], [0.9]]),
    ]
    (found,) = condition_issues(made(first, model=curving), [*others, broken, broken])
    assert "answers with its time to the 2 at any of 2 states" in found.sentence
    (many,) = condition_issues(made(first, model=curving), [broken] * 30)
    assert "at any of 24 states" in many.sentence


def test_where_it_answers_at_once_somewhere_the_degree_is_one() -> None:
    here = [probe(at, -1.0, h=at, residuals=[[-0.3], [0.1]]) for at in (0.5, 2.0, 7.0)]
    assert condition_issues(made(first, model=curving), here) == []
    (found,) = condition_issues(made(first, model=curving), here[1:])
    assert "answers with its time to the 2 at any of 2 states" in found.sentence, "the quickest answer counts"


def test_a_condition_that_is_just_kept_is_not_missed_and_an_effect_within_rounding_is_ignored() -> None:
    one = probe(0.5, h=0.5, residuals=[[-0.1], [0.0]], kept=False)
    (found,) = condition_issues(made(first), [one])
    assert found.names == (), "all of them together, it says then"
    (found,) = condition_issues(
        made(lambda x: 1e6 + 1e-6 * x[0]), [probe(0.5, h=1e6, residuals=[[-0.3], [-0.1]], kept=False)]
    )
    assert "does not answer to the action in one tick" in found.sentence


def test_a_kind_without_a_margin_has_none_and_the_middle_lies_between_the_ends() -> None:
    checked = replace(made(first), margins={"some": 0.3})
    assert checked.epsilon.tolist() == [0.0]
    assert made(first, limits=(-1.0, 3.0)).corners()[-1] == [1.0]


class Refuses:
    """Stands for a filter that finds no action, or lets every nominal action pass."""

    def __init__(self, checked: FilterUnderTest, *, passes: bool) -> None:
        self.settings, self.tools, self._passes = checked.safe.settings, checked.safe.tools, passes
        self.nominal_actions: list[tuple[float, ...]] = []

    def decide(self, state: Values, nominal: Values, latent: Any, **_: Any) -> Any:
        self.nominal_actions.append(tuple(nominal.tolist()))
        return replace(resting_verdict(np.array(nominal), ""), status=Status.passed if self._passes else Status.relaxed)


def refused(checked: FilterUnderTest, *, passes: bool = False) -> tuple[FilterUnderTest, Refuses]:
    safe: Any = Refuses(checked, passes=passes)
    return FilterUnderTest(safe, checked.barriers, checked.margins, None), safe


@pytest.mark.parametrize(("missed", "kept"), [(-0.001, True), (0.0005, True), (0.0015, False)])
def test_where_the_filter_finds_nothing_the_actions_tried_say_whether_it_was_slight(missed: float, kept: bool) -> None:
    """From x the best of them leads to x + 0.2, which is asked to be 0.9 x + 0.02: it misses 0.001 at -1.81."""
    checked, _ = refused(made(first, lambda x: 50.0 + x[0], epsilon=0.02))
    given, driven, *_ = collect_probes(checked, [np.array([-1.8 - 10.0 * missed])], 8, 0)
    assert given.is_feasible, "not asked there"
    assert driven.is_feasible is kept


def test_inside_is_where_every_h_is_at_its_threshold() -> None:
    checked, _ = refused(made(first, lambda x: x[0] - 4.0, epsilon=0.5, eta=0.5))
    for at, inside in ((5.0, True), (4.999, False), (1.0, False), (0.5, False)):
        (one, *_) = collect_probes(checked, [np.array([at])], 1, 0)
        assert one.inside is inside


def test_every_extreme_action_is_held_to_the_end_in_six_drives() -> None:
    checked, safe = refused(made(first, model=lambda x: (x, np.full((1, 4), 0.1)), actions=4), passes=True)
    collect_probes(checked, [np.array([9.0])], 60, 0)
    drives = [set(safe.nominal_actions[60 * drive : 60 * drive + 60]) for drive in range(12)]
    assert [len(drive) == 1 for drive in drives] == [True] * 6 + [False] * 6
    assert len(set().union(*drives[:6])) == 6
    two, both = refused(made(first), passes=True)
    collect_probes(two, [np.array([9.0])], 60, 0)
    held = [set(both.nominal_actions[60 * drive : 60 * drive + 60]) for drive in range(12)]
    assert held[:2] == [{(-1.0,)}, {(2.0,)}]
    assert sum(len(drive) == 2 for drive in held[2:]) >= 8, "some are held for all of it by chance"


def test_a_kind_with_some_margin_is_no_issue_and_a_wrong_unit_is_reported_with_its_ratio() -> None:
    assert margin_issues(made(first, epsilon={"function": 0.1}), []) == []
    parts = [FunctionBarrier(first, names=(name,), kind=name) for name in ("a", "b")]
    checked = made(*parts, epsilon={"a": 1e-3, "b": 1e3})
    (found,) = scale_issues(checked, [probe(0.0, h=[1e6, 1e6], reached=[1e-6, 1e-2])])
    assert found.names == ("b", "a"), "five decades, three"


def sloped(h: Callable[[Values], float], *gradient: float) -> FunctionBarrier:
    return FunctionBarrier(h, lambda x: np.array(gradient), ("h",))


@pytest.mark.parametrize(
    ("gradient", "reported"),
    [((2.0, 0.001), ""), ((2.0, 0.015), ""), ((2.04, 0.001), "got a slope of 2.04 in entry 0 of the state, wanted 2,")],
)
def test_a_hundredth_of_the_largest_part_may_be_missing(gradient: tuple[float, float], reported: str) -> None:
    barrier = sloped(lambda x: 2.0 * x[0] + 0.001 * x[1], *gradient)
    found = gradient_issues(made(barrier), [probe(at, 0.0, h=2.0 * at, moved=[0.1, 0.1]) for at in (0.0, 1.0)])
    assert bool(found) is bool(reported)
    assert reported in "".join(issue.sentence for issue in found)


def test_where_a_slope_matters_most_is_reported_and_what_moves_somewhere_is_judged_everywhere() -> None:
    """Entry 1 is off by less, but moves a thousand times as far; the state at 3 is the worst."""
    barrier = FunctionBarrier(lambda x: x[0] + x[1], lambda x: np.array([30.0, 1.5 + x[0]]), ("h",))
    probes = [probe(at, 0.0, h=at, moved=[0.001, 1.0]) for at in (1.0, 3.0, 2.0)]
    (found,) = gradient_issues(made(barrier), probes)
    assert "got a slope of 4.5 in entry 1 of the state, wanted 1," in found.sentence
    barrier = sloped(lambda x: x[0], 5.0)
    assert gradient_issues(made(barrier), [probe(0.0, h=0.0, moved=0.1), probe(1.0, h=1.0, moved=0.0)])


@pytest.mark.parametrize("moved", [0.1, 1e-6])
def test_what_bends_is_compared_close_by(moved: float) -> None:
    for slope, reported in ((2.0, False), (2.05, True)):
        barrier = sloped(lambda x: x[0] ** 2, slope)
        found = gradient_issues(made(barrier), [probe(1.0, h=1.0, moved=moved)] * 2)
        assert bool(found) is reported
    assert "wanted 2," in found[0].sentence


def test_rounding_about_a_constant_is_no_gradient() -> None:
    assert gradient_issues(made(sloped(lambda x: 7.0, 1e-10)), [probe(0.0, h=7.0)] * 3) == []


def walls(*deep: tuple[float, float]) -> Callable[[Values], float]:
    """Falls by depth about some places, a twentieth wide; and a little to the right."""
    return lambda x: float(1.0 - 0.01 * x[0] - sum(depth * (abs(x[0] - at) < 0.025) for at, depth in deep))


def test_h_is_chased_by_the_actions_that_lower_it_most_and_of_several_by_those_that_do_something() -> None:
    """To the right by 0.3 a tick, with an action of 3: at 0.3 and 0.6, and what lies at 0.45 is jumped over."""
    checked = made(walls((0.45, 3.0)), limits=(-1.0, 3.0))
    (found,) = tick_issues(checked, [probe(0.0, h=1.0)])
    assert "got h = 0.994 at two ticks and -2 between them" in found.sentence
    (left,) = tick_issues(made(lambda x: walls((0.35, 3.0))(-x), limits=(-3.0, 1.0)), [probe(0.0, h=1.0)])
    assert "at two ticks" in left.sentence
    checked = made(walls((0.45, 3.0)), limits=(-1.0, 3.0), actions=2, model=lambda x: (x, np.array([[0.1, 0.0]])))
    (found,) = tick_issues(checked, [probe(0.0, h=1.0)])
    assert "got h = 0.994 at two ticks" in found.sentence


def test_the_deepest_of_all_dips_is_reported_with_the_barrier_that_dips_from_whichever_start() -> None:
    for deep in (((0.45, 3.0), (1.05, 2.5)), ((0.45, 2.5), (1.05, 3.0))):
        (found,) = tick_issues(made(walls(*deep), limits=(-1.0, 3.0)), [probe(0.0, h=1.0)])
        assert "and -1.5" not in found.sentence
    checked = made(first, first, lambda x: walls((20.45, 3.0))(x) + 0.011 * x[0], limits=(-1.0, 0.0))
    low, high = probe(0.0, h=[0.0, 0.0, 1.0]), probe(20.6, h=[20.6, 20.6, 1.02])
    (found,) = tick_issues(checked, [low, high])
    assert found.names == ("h2",)


@pytest.mark.parametrize("states", [[[np.nan, 0.0]], [[0.0, np.inf]], [[[0.0]]], []])
def test_states_that_are_none_are_refused(states: Any) -> None:
    with pytest.raises(InputError, match="states: got shape"):
        check_filter(made(first).safe, states)


@pytest.mark.parametrize("h", [lambda x: np.nan, lambda x: np.inf, lambda x: np.nan if x[0] > 0.5 else 1.0 - x[0]])
def test_an_h_that_is_not_finite_is_reported(h: Callable[[Any], float]) -> None:
    safe = SafetyFilter(lambda x: (x, 0.05 * np.eye(1)), [FunctionBarrier(h)], SETTINGS)
    assert "got NaN or infinity from h at [0.6]" in str(check_filter(safe, [[0.6]]))


def test_an_h_that_is_not_finite_one_tick_later_is_reported() -> None:
    blind = FunctionBarrier(lambda x: np.nan if x[0] > 0.5 else 1.0 - x[0])
    safe = SafetyFilter(lambda x: (x, 0.05 * np.eye(1)), [blind], SETTINGS)
    assert "got NaN or infinity from h one tick from [0.48]" in str(check_filter(safe, [[0.48]]))


def test_what_the_filter_itself_refuses_is_reported() -> None:
    def of(**given: Any) -> SafetyFilter:
        return SafetyFilter(lambda x: (x, 0.05 * np.eye(1)), [FunctionBarrier(lambda x: 1.0 - x[0])], SETTINGS, **given)

    far = of(state_range=Plausible(np.array(-0.1), np.array(0.1), ("x",)))
    assert "out of its plausible range" in str(check_filter(far, [[0.5]]))
    assert "a kind without barriers: did you mean 'function'" in str(
        check_filter(of(), [[0.5]], epsilon={"functio": 0.1})
    )
    assert not len(check_filter(of(), [[0.5]]))


def test_what_cannot_be_checked_is_an_error_of_one_line() -> None:
    safe = SafetyFilter(lambda x: (x, np.eye(1)), [FunctionBarrier(lambda x: 1.0 - x[0])], SETTINGS)
    for given, phrase in (
        ((3, [[0.5]]), "safe: got int"),
        ((safe, "a"), "states: got str"),
        ((safe, [[1.0], [1.0, 2.0]]), "states: got list"),
    ):
        with pytest.raises(InputError, match=phrase):
            check_filter(*given)
    with pytest.raises(InputError, match="wanted an AbstractBarrier"):
        check_filter(safe, [[0.5]], barriers=[abs])  # type: ignore[list-item]
    with pytest.raises(InputError, match="latent: got str"):
        check_filter(safe, [[0.5]], latent="a")


def test_a_backup_that_writes_into_its_state_changes_no_state() -> None:
    def writes(x: Any) -> Any:
        if x is not None:
            x[0] = -100.0
        return np.zeros(1)

    states = np.array([[0.5]])
    safe = SafetyFilter(
        lambda x: (x, 0.05 * np.eye(1)), [FunctionBarrier(lambda x: 1.0 - x[0])], SETTINGS, None, writes
    )
    assert not len(check_filter(safe, states))
    assert states.tolist() == [[0.5]]
