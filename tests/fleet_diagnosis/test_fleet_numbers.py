"""Numbers of a fleet: outcomes, false discoveries, pooled means and spreads, and which robots are alike."""

import json
import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy import stats

from safedpa.dynamics import load_model
from safedpa.fleet.common import (
    common_effects,
    confirm_correction,
    corrected_model,
    corrected_settings,
    together_effects,
)
from safedpa.fleet.document import analyse_fleet, fleet_document
from safedpa.fleet.outcome import EffectEvidence, Number, RobotOutcome, neutral_of, outcome_of
from safedpa.fleet.pooled_evidence import FALSE_SHARE, believed, chance, evidence_over, pooled_number, upper_tail
from safedpa.fleet.similar_robots import connected_components, differ_significantly, same_effects, with_one_name
from safedpa.fleet.summary import common_sentence, discovery_sentence, group_title, headline, listed, range_text

RESULT = {"robot": "car_1", "status": "diagnosed", "reason": "", "unreadable_files": [{"path": "x", "reason": "y"}]}


def candidate(stage, effect, score, decision="rejected", equals=(), **parameters):
    numbers = {name: {"value": value, "std": std, "unit": "1"} for name, (value, std) in parameters.items()}
    return {
        "stage": stage, "effect": effect, "parameters": numbers, "heldout_error": 0.1, "score": score,
        "indistinguishable_from": list(equals), "decision": decision, "reason": "",
    }  # fmt: skip


def report(*candidates, added=(), parameters=(), **more):
    return {
        "robot": "car", "added": list(added), "candidates": list(candidates), "unexplained": None,
        "stages": [{"heldout_error": 0.3}, {"heldout_error": 0.1}], "data_quality": [{"message": "a"}] * 2,
        "parameters": {path: {"value": value, "std": std, "unit": "1"} for path, value, std in parameters},
    } | more  # fmt: skip


def test_the_final_numbers_of_what_was_found_and_its_rivals_of_the_same_stage():
    found = outcome_of(
        RESULT,
        report(
            candidate(0, "payload", 6.0, "accepted", ("towed_load", "a + b"), mass_ratio=(0.3, 0.01)),
            candidate(0, "towed_load", 5.5, mass_ratio=(0.4, 0.02)),
            candidate(0, "a + b", 5.0),
            candidate(1, "towed_load", 0.1, mass_ratio=(0.0, 0.02)),
            candidate(1, "understeer", 0.7, gradient=(0.001, 0.001)),
            added=["payload"],
            parameters=[("payload.mass_ratio", 0.31, 0.005), ("base.speed_gain", 3.1, 0.1)],
        ),
    )
    (payload,) = found.found
    assert (payload.numbers["mass_ratio"].value, payload.equals) == (0.31, ("towed_load",))
    assert payload.others["towed_load"].numbers["mass_ratio"].value == 0.4
    assert (found.evidence, found.trials) == (6.0, 3)
    assert set(found.last) == {"towed_load", "understeer"}
    assert found.free["base.speed_gain"].value == 3.1
    assert (found.error_before, found.error_after, found.unread, found.findings) == (0.3, 0.1, 1, 1)
    assert found.judged


def test_where_nothing_was_found_the_best_candidate_is_reported():
    found = outcome_of(RESULT, report(candidate(0, "payload", 1.2), candidate(0, "understeer", None)))
    assert (found.found, found.evidence) == ((), 1.2)
    assert math.isnan(found.last["understeer"].score)


def test_a_pair_is_found_effect_by_effect():
    pair = candidate(0, "drive_dead_zone + viscous_drag", 5.0, "accepted")
    numbers = [("drive_dead_zone.width", 0.1, 0.01), ("viscous_drag.coefficient", 0.3, 0.01)]
    found = outcome_of(RESULT, report(pair, added=["drive_dead_zone", "viscous_drag"], parameters=numbers))
    reported = [(item.effect, list(item.numbers), item.score) for item in found.found]
    assert reported == [("drive_dead_zone", ["width"], 5.0), ("viscous_drag", ["coefficient"], 5.0)]


def test_what_was_rejected_again_later_does_not_speak_for_what_was_found():
    """The candidate of a found effect is the one that was accepted, whatever later stages decide about it."""
    first = candidate(0, "payload", 6.0, "accepted", ("towed_load",), mass_ratio=(0.3, 0.01))
    again = candidate(1, "payload", 0.4, "rejected", ("understeer",), mass_ratio=(0.2, 0.01))
    numbers = [("payload.mass_ratio", 0.31, 0.005)]
    found = outcome_of(RESULT, report(first, again, added=["payload"], parameters=numbers))
    assert [(item.score, item.equals) for item in found.found] == [(6.0, ("towed_load",))]


def test_without_a_report_there_is_a_status_and_a_reason():
    found = outcome_of(RESULT | {"status": "unreadable", "reason": "empty"}, None)
    assert (found.status, found.reason, found.judged) == ("unreadable", "empty", False)


def test_where_an_effect_does_nothing():
    assert neutral_of("car", "steering_gain", "gain") == 1.0
    assert neutral_of("car", "payload", "mass_ratio") == 0.0
    assert neutral_of("car", "no_such_effect", "x") is None


def test_sentences():
    assert range_text({"low": 0.4, "high": 0.5, "unit": "m/s2"}) == "0.4 to 0.5 m/s2"
    assert range_text({"low": 0.4, "high": 0.4, "unit": "1"}) == "0.4"
    assert listed([str(i) for i in range(9)], 4) == "0, 1, 2 and 6 more"
    assert common_sentence({"common": None}) == ""
    found = {"judged": 300, "found": 7, "believed": 6, "share": 0.05}
    assert discovery_sentence({"false_discovery": found}).endswith(", 1 is suspected only.")
    assert discovery_sentence({"false_discovery": found | {"found": 0}}) == ""


def number(value: float, std: float = math.nan) -> Number:
    return Number(value, std, "1")


def robot(name: str, *found: EffectEvidence, **more: Any) -> RobotOutcome:
    return RobotOutcome(name, "diagnosed", "", tuple(found), **more)


def force(values: tuple[float, ...], stds: tuple[float, ...]) -> RobotOutcome:
    numbers = {axis: number(*pair) for axis, pair in zip(("ax", "ay"), zip(values, stds, strict=True), strict=False)}
    return robot("r", EffectEvidence("constant_force", numbers, 9.0))


@pytest.mark.parametrize(
    ("one", "other", "differ"),
    [
        # surely: (a - b)^2 / (s^2 + t^2) > 16
        (((3.0,), (0.70,)), ((-1.0,), (0.70,)), True), (((3.0,), (0.71,)), ((-1.0,), (0.71,)), False),
        (((3.0,), (0.59,)), ((-1.0,), (0.79,)), True), (((3.0,), (0.61,)), ((-1.0,), (0.81,)), False),
        (((3.0,), (0.0,)), ((-1.0,), (0.99,)), True), (((3.0,), (0.0,)), ((-1.0,), (0.0,)), False),
        (((3.0,), (math.nan,)), ((-1.0,), (0.1,)), False),
        (((3.0, 4.0), (1.2, 1.2)), ((0.0, 0.0), (0.0, 0.0)), True),  # 25 / 1.44 = 17.4
        (((3.0, 4.0), (1.3, 1.3)), ((0.0, 0.0), (0.0, 0.0)), False),  # 25 / 1.69 = 14.8
        # widely: |a - b| > 0.33 (|a| + |b|) / 2, as vectors
        (((0.30,), (1e-3,)), ((0.22,), (1e-3,)), False), (((0.30,), (1e-3,)), ((0.21,), (1e-3,)), True),
        (((0.3, 0.0), (1e-3, 1e-3)), ((0.3, 0.09), (1e-3, 1e-3)), False),
        (((0.3, 0.0), (1e-3, 1e-3)), ((0.3, 0.11), (1e-3, 1e-3)), True),
    ],
)  # fmt: skip
def test_two_robots_differ_where_their_numbers_do_widely_and_surely(one: Any, other: Any, differ: bool) -> None:
    assert differ_significantly(force(*one), force(*other), "car") is differ
    assert differ_significantly(force(*other), force(*one), "car") is differ


@pytest.mark.parametrize(("other", "differ"), [(1.22, False), (1.21, True), (1.40, False), (1.43, True)])
def test_a_gain_differs_by_its_change_from_one(other: float, differ: bool) -> None:
    gains = [robot("r", EffectEvidence("steering_gain", {"gain": number(value, 1e-4)}, 9.0)) for value in (1.3, other)]
    assert differ_significantly(*gains, "car") is differ


def test_a_pooled_number_and_its_spread() -> None:
    """Values 1, 2, 6 with deviation 1: weights 1, centre 3, surplus 14 - 2 = 12, size 3 - 1 = 2, spread sqrt(6)."""
    found = pooled_number([number(1.0, 1.0), number(2.0, 1.0), number(6.0, 1.0)])
    assert (found.low, found.high, found.robots, found.stated) == (1.0, 6.0, 3, 1.0)
    assert [found.mean, found.spread, found.std] == pytest.approx([3.0, math.sqrt(6.0), math.sqrt(7.0 / 3.0)])


def test_a_robot_with_a_smaller_deviation_counts_more_in_a_pooled_number() -> None:
    """Deviations 1 and 2 of 0 and 1: weights 1 and 1 / 4, mean 0.2, deviation 1 / sqrt(1.25); the median is 1.5."""
    found = pooled_number([number(0.0, 1.0), number(1.0, 2.0)])
    assert [found.mean, found.std, found.spread] == pytest.approx([0.2, 1.25**-0.5, 0.0])
    again = pooled_number([number(0.0, 1.0), number(1.0, 2.0), number(0.2)])
    assert (again.stated, again.spread) == (1.5, 0.0)
    assert again.std == pytest.approx((1.25 + 1.0 / 2.25) ** -0.5)


@pytest.mark.parametrize(("step", "differs"), [(0.060, False), (0.066, True)])
def test_a_common_number_differs_where_it_spreads_by_half_of_what_sets_two_robots_apart(step, differs):
    """Five robots about 0.6 m/s2: their spread is 1.58 steps, the limit 0.5 * 0.33 * 0.6 = 0.099."""
    other = EffectEvidence("understeer", {"gradient": number(0.0, 1.0)}, 9.0)
    every = [
        robot(f"r{n}", other, EffectEvidence("rolling_resistance", {"deceleration": number(0.6 + n * step, 1e-4)}, 9.0))
        for n in (-2, -1, 0, 1, 2)
    ]
    found = {item.effect: item for item in common_effects(every, "car")}
    assert set(found) == {"understeer", "rolling_resistance"}
    rolling = found["rolling_resistance"]
    assert (rolling.found_in, rolling.of, rolling.differs) == (5, 5, differs)
    assert rolling.numbers["deceleration"].mean == pytest.approx(0.6)
    assert {item.effect for item in rolling.notice.values()} == {"rolling_resistance"}
    assert found["understeer"].numbers["gradient"].mean == 0.0
    assert common_effects(every[:4], "car") == [], "four robots are too few to speak for a fleet"


@pytest.mark.parametrize("robots", [7, 20, 49, 50, 51, 80, 200, 1000])
def test_a_corrected_model_is_confirmed_if_a_fair_coin_is_as_good_once_in_a_hundred(robots: int) -> None:
    enough = next(hits for hits in range(robots + 1) if stats.binom.sf(hits - 1, robots, 0.5) < 0.01)
    before = {f"r{n}": 1.0 for n in range(robots)}
    for better in (enough, enough - 1):
        after = {f"r{n}": 0.5 if n < better else 1.01 for n in range(robots)}
        found = confirm_correction(before, after)
        assert (found.robots, found.better, found.holds) == (robots, better, better == enough)
    large = {name: 0.99 if int(name[1:]) < enough else 9.0 for name in before}
    assert confirm_correction(before, large).holds is (enough == robots), "a few large rises outweigh many small falls"


@pytest.mark.parametrize(
    ("deviate", "tail"), [(0.0, 0.5), (1.0, 0.158655), (1.959964, 0.025), (-1.0, 0.841345), (3.0, 0.00134990)]
)
def test_the_upper_tail_of_the_normal_distribution(deviate: float, tail: float) -> None:
    assert upper_tail(deviate) == pytest.approx(tail, rel=1e-5)


def tried_by(scores: dict[str, list[float]]) -> list[RobotOutcome]:
    """Robots that tried each effect last, with these scores in turn."""
    count = len(next(iter(scores.values())))
    return [
        robot(
            f"r{n}", last={name: EffectEvidence(name, {"x": number(1.0, 1.0)}, own[n]) for name, own in scores.items()}
        )
        for n in range(count)
    ]


def test_evidence_of_a_fleet_is_stouffers_sum() -> None:
    (found,) = evidence_over(tried_by({"drag": [3.0, -1.0, 2.0, 4.0]}))
    assert (found.robots, found.favourable) == (4, 3)
    expected = stats.combine_pvalues(stats.norm.sf([3.0, -1.0, 2.0, 4.0]), "stouffer").statistic
    assert found.score == pytest.approx(expected)


@pytest.mark.parametrize(("mean", "rivals"), [(1.9, ("lag",)), (2.1, ())])
def test_effects_are_rivals_where_their_scores_differ_by_less_than_two_standard_errors(mean, rivals):
    differences = np.array([-3.0, -1.0, 1.0, 3.0, -2.0, 2.0])
    differences += mean * stats.sem(differences)
    found = evidence_over(tried_by({"drag": (5.0 + differences).tolist(), "lag": [5.0] * 6}))
    assert (found[0].effect, found[0].rivals) == ("drag", rivals)


@pytest.mark.parametrize(
    ("score", "effect", "numbers", "evidence"),
    [
        (5.0, "steering_gain", {"gain": (9.0, 0.1)}, 5.0),
        (0.5, "steering_gain", {"gain": (9.0, 0.5)}, 16.0 / 3.0),  # 8 from doing nothing
        (2.0, "steering_gain", {"gain": (1.5, 0.5)}, 2.0),
        (0.5, "constant_force", {"ax": (8.0, 4.0), "ay": (-4.0, 0.5)}, 8.0 / 3.0),
        (0.5, "constant_force", {"ax": (9.0, 0.0), "ay": (2.0, None)}, 0.5),
    ],
)
def test_the_evidence_of_a_robot_is_that_of_blocks_or_a_third_of_the_filters_deviations(
    score, effect, numbers, evidence
):
    own = [(f"{effect}.{k}", *number) for k, number in numbers.items()]
    made = report(candidate(0, effect, score, "accepted"), added=[effect], parameters=own)
    assert outcome_of(RESULT, made).evidence == pytest.approx(evidence)


def test_the_evidence_of_a_robot_with_two_effects_is_that_of_the_weaker_one() -> None:
    for scores in ({"payload": 5.0, "understeer": 7.0}, {"payload": 7.0, "understeer": 5.0}):
        found = [candidate(n, name, own, "accepted") for n, (name, own) in enumerate(scores.items())]
        assert outcome_of(RESULT, report(*found, added=list(scores))).evidence == 5.0


chances = st.lists(st.floats(0.0, 1.0), min_size=1, max_size=60)


def test_evidence_that_is_missing_or_negative_is_chance():
    assert chance(float("nan"), 24) == chance(-1.0, 24) == 1.0


def test_the_example_of_benjamini_and_hochberg():
    """Section 4 of their paper: of fifteen hypotheses the first four are rejected at 0.05, Bonferroni rejects three."""
    p = [
        0.0001, 0.0004, 0.0019, 0.0095, 0.0201, 0.0278, 0.0298, 0.0344, 0.0459, 0.3240, 0.4262, 0.5719, 0.6528,
        0.7590, 1.0,
    ]  # fmt: skip
    significant, limit = believed(p, 0.05)
    assert (significant, limit) == ([True] * 4 + [False] * 11, 0.0095)


@given(chances)
def test_what_is_believed_is_what_has_the_smallest_chances(p):
    significant, limit = believed(p)
    assert [value <= limit and any(significant) for value in p] == significant
    assert limit <= FALSE_SHARE


@given(chances, st.integers(0, 59), st.floats(0.0, 1.0))
def test_stronger_evidence_of_one_robot_takes_belief_from_none(p, index, share):
    better = [value * share if place == index % len(p) else value for place, value in enumerate(p)]
    before, after = believed(p)[0], believed(better)[0]
    assert all(now or not then for then, now in zip(before, after, strict=True))


def test_three_hundred_healthy_robots_give_no_false_group_but_rarely():
    """The best of 24 candidates in each of 300 robots, were gains normal; one fleet in twenty at most has any."""
    random = np.random.default_rng(1)
    fleets, robots, trials = 1000, 300, 24
    # the largest of n normal deviates: its distribution function is that of one to the power n
    tails = -np.expm1(np.log(random.random((fleets, robots))) / trials)
    p = np.minimum(1.0, trials * tails)
    assert np.mean([any(believed(row)[0]) for row in p]) < FALSE_SHARE + 3 * np.sqrt(0.05 * 0.95 / fleets)
    alone = np.mean(tails < upper_tail(3.0))  # what one robot's own threshold would let through
    assert 300 * alone > 5.0


def test_true_ones_among_many_are_believed():
    p = [chance(8.0, 29)] * 6 + [1.0] * 294 + [chance(3.1, 29)]
    significant, _ = believed(p)
    assert significant == [True] * 6 + [False] * 295


numbers = st.lists(st.tuples(st.floats(-5, 5), st.floats(0.01, 2.0)), min_size=1, max_size=30)


@given(numbers)
@example([(1.75, 1.609375)])
def test_the_mean_lies_among_the_robots_and_the_spread_is_no_larger_than_theirs(values):
    found = pooled_number([Number(value, std, "m") for value, std in values])
    assert found.low - 1e-9 <= found.mean <= found.high + 1e-9
    assert 0.0 <= found.spread <= (found.high - found.low) * 2 + 1e-9
    assert found.robots == len(values)


def weak(make_tried, make_robot, scores, value=0.02):
    drag = [make_tried("quadratic_drag", score=z, std=0.01, coefficient=value) for z in scores]
    other = [make_tried("payload", score=-0.5, mass_ratio=0.01) for _ in scores]
    return [
        make_robot(f"r{i}", last={"quadratic_drag": d, "payload": p})
        for i, (d, p) in enumerate(zip(drag, other, strict=True))
    ]


def test_what_is_too_weak_in_each_is_sure_in_all(make_tried, make_robot):
    robots = weak(make_tried, make_robot, [1.1, 0.9, 1.3, 0.7] * 8)
    evidence = evidence_over(robots)
    assert evidence[0].effect == "quadratic_drag"
    assert evidence[0].score == pytest.approx(1.0 * np.sqrt(32))
    assert common_effects(robots, "car") == []
    found = together_effects(robots, evidence)
    assert [item.effect for item in found] == ["quadratic_drag"]
    assert found[0].numbers["coefficient"].mean == pytest.approx(0.02)


def test_a_few_robots_are_not_the_fleet(make_tried, make_robot):
    robots = weak(make_tried, make_robot, [12.0] * 4 + [-0.1] * 28)
    assert evidence_over(robots)[0].score > 4.0
    assert together_effects(robots, evidence_over(robots)) == []


def test_without_evidence_there_is_nothing_in_common(make_tried, make_robot):
    robots = weak(make_tried, make_robot, [0.2, -0.3] * 16)
    assert together_effects(robots, evidence_over(robots)) == []
    assert common_effects([], "car") == together_effects([], []) == []


@pytest.mark.parametrize(("values", "differs"), [([0.30, 0.31, 0.29] * 4, False), ([0.2, 0.4, 0.8] * 4, True)])
def test_what_all_have_belongs_to_the_model_free_where_it_differs(make_tried, make_robot, values, differs):
    robots = [make_robot(f"r{i}", make_tried("payload", mass_ratio=value)) for i, value in enumerate(values)]
    (found,) = common_effects(robots, "car")
    assert (found.effect, found.found_in, found.differs) == ("payload", 12, differs)
    model = corrected_model(load_model("car"), corrected_settings("car", [found]))
    setting = model.settings["payload.mass_ratio"]
    assert setting.free is differs
    assert 0.2 <= setting.value <= 0.8


def test_a_robots_own_number_has_no_part_in_the_model_that_is_tried_on_it(make_tried, make_robot):
    values = [0.30] * 9 + [0.36]
    robots = [make_robot(f"r{i}", make_tried("payload", mass_ratio=value)) for i, value in enumerate(values)]
    (found,) = common_effects(robots, "car")
    assert corrected_settings("car", [found], "r9")["payload"]["mass_ratio"].value == pytest.approx(0.30)
    assert corrected_settings("car", [found])["payload"]["mass_ratio"].value > 0.30


def test_a_few_robots_or_errors_that_are_no_numbers_confirm_nothing():
    before = dict.fromkeys("abcdefghij", 0.2)
    assert not confirm_correction(
        dict.fromkeys("abcd", 0.2), dict.fromkeys("abcd", 0.1)
    ).holds  # a sixteenth is chance enough
    assert not confirm_correction(before, dict.fromkeys(before, math.nan)).holds
    assert confirm_correction({"a": 0.2}, {}).robots == 0


def test_a_number_that_was_pushed_to_its_bound_speaks_for_nothing(make_tried, make_robot):
    stuck = [make_tried("drive_delay", score=3.0, std=float("nan"), deceleration=0.0) for _ in range(20)]
    robots = [make_robot(f"r{i}", last={"drive_delay": item}) for i, item in enumerate(stuck)]
    assert evidence_over(robots)[0].score == 0.0


@pytest.mark.parametrize(
    ("effect", "std", "numbers", "groups"),
    [
        ("rolling_resistance", 0.002, [{"deceleration": d} for d in (0.4, 0.45, 0.5)], [["0", "1", "2"]]),
        ("towed_load", 0.002, [{"mass_ratio": m, "deceleration": 1.0} for m in (0.8, 0.82, 1.3, 1.29)],
         [["0", "1"], ["2", "3"]]),
        ("towed_load", 0.1, [{"mass_ratio": 0.8}, {"mass_ratio": 1.3}], [["0", "1"]]),
        ("towed_load", math.nan, [{"mass_ratio": 0.2}, {"mass_ratio": 2.0}], [["0", "1"]]),
        ("constant_force", 0.002, [{"ax": 0.4, "ay": 0.3}, {"ax": -0.4, "ay": 0.3}], [["0"], ["1"]]),
        ("constant_force", 0.002, [{"ax": 0.4, "ay": 0.0}, {"ax": 0.39, "ay": 0.05}], [["0", "1"]]),
        ("steering_offset", 0.002, [{"angle": 0.04}, {"angle": -0.04}], [["0"], ["1"]]),
    ],
)  # fmt: skip
def test_robots_with_one_effect_are_one_group_unless_their_numbers_surely_differ(
    make_tried, make_robot, effect, std, numbers, groups
):
    cars = [make_robot(str(i), make_tried(effect, std=std, **own)) for i, own in enumerate(numbers)]
    assert [sorted(item.name for item in group.members) for group in same_effects(cars, "car")] == groups


def test_indistinguishable_effects_take_the_most_frequent_name(make_tried, make_robot):
    found = make_tried("rolling_resistance", equals=("towed_load",), deceleration=0.45)
    rolling = [make_robot(f"r{i}", found) for i in range(3)]
    other = make_tried("rolling_resistance", deceleration=0.46)
    towed = make_tried("towed_load", equals=("rolling_resistance",), mass_ratio=0.3)
    towed = replace(towed, others={other.effect: other})
    renamed = with_one_name([*rolling, make_robot("t", towed)])
    groups = same_effects(renamed, "car")
    assert [item.effects for item in groups] == [("rolling_resistance",)]
    assert groups[0].equals == {"rolling_resistance": ("towed_load",)}
    assert renamed[3].found[0].numbers["deceleration"].value == 0.46


def test_a_robot_that_can_distinguish_effects_names_those_of_its_group(make_tried, make_robot):
    sure = make_robot("a", make_tried("rolling_resistance", deceleration=0.45))
    unsure = make_robot("b", make_tried("rolling_resistance", equals=("towed_load",), deceleration=0.45))
    towed = make_robot("c", make_tried("towed_load", mass_ratio=0.4))
    groups = same_effects(with_one_name([sure, unsure, towed]), "car")
    assert {item.effects for item in groups} == {("rolling_resistance",), ("towed_load",)}
    assert groups[0].equals == {"rolling_resistance": ()}


@given(st.lists(st.floats(-10, 10), min_size=1, max_size=20), st.randoms())
def test_groups_are_a_partition_that_does_not_depend_on_the_order(values, random):
    def far(one, other):
        return abs(one - other) > 1.0

    parts = connected_components(values, far)
    assert sorted(each for part in parts for each in part) == sorted(values)
    assert sorted(map(sorted, connected_components(random.sample(values, len(values)), far))) == sorted(
        map(sorted, parts)
    )
    for part in parts:
        own = sorted(part)
        assert all(b - a <= 1.0 for a, b in pairwise(own))


def test_the_fleet_in_one_sentence(make_tried, make_robot):
    brakes = [make_robot(f"b{d}", make_tried("rolling_resistance", deceleration=d)) for d in (0.4, 0.45, 0.5)]
    slope = make_robot("slope", make_tried("constant_force", ax=0.4, ay=0.3))
    weak = make_robot("weak", make_tried("payload", score=3.05, mass_ratio=0.1))
    healthy = [make_robot(f"h{i}") for i in range(40)]
    lost = make_robot("lost", status="unreadable")
    analysis = analyse_fleet([*brakes, slope, weak, *healthy, lost], "car")
    document = fleet_document(analysis, [])
    assert headline(document) == (
        "46 robots: 3 lack rolling_resistance (deceleration 0.4 to 0.5 m/s2); 1 lacks constant_force (ax 0.4 m/s2, "
        "ay 0.3 m/s2); in 1 payload is suspected only; in 40 nothing is missing; 1 is unreadable."
    )
    assert document["counts"]["suspected"] == 1
    assert sum(len(group["robots"]) for group in document["groups"]) == 46
    assert group_title(document["groups"][0]) == "rolling_resistance"
    wanted = json.loads(Path(__file__).with_name("document.json").read_text(encoding="utf-8"))
    assert parts(json.loads(json.dumps(document))) == wanted, "names that programs of the users read"


def parts(document: Any) -> Any:
    """The names in a document; of a list, those of all entries."""
    if isinstance(document, dict):
        return {name: parts(value) for name, value in document.items()}
    if isinstance(document, list) and document and isinstance(document[0], dict):
        return parts({name: value for row in document for name, value in row.items()})
    return ""


def test_a_robot_that_does_not_fit_is_named(make_robot):
    healthy = [make_robot(f"h{i}", error_after=0.02 + 0.0005 * i) for i in range(12)]
    analysis = analyse_fleet([*healthy, make_robot("odd", error_after=0.2)], "car")
    assert ([name for name, _ in analysis.odd], analyse_fleet(healthy, "car").odd) == (["odd"], ())
