"""Numbers of a fleet: when robots differ, pooled means and spreads, and evidence over robots.

Expected values are worked out by hand or by SciPy.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy import stats

from safedpa.fleet.alike import apart
from safedpa.fleet.common import common_effects, confirmed
from safedpa.fleet.discovery import upper_tail
from safedpa.fleet.outcome import Number, RobotOutcome, Tried, outcome_of
from safedpa.fleet.pooled_evidence import evidence_over, pooled_number


def number(value: float, std: float = math.nan) -> Number:
    return Number(value, std, "1")


def robot(name: str, *found: Tried, **more: Any) -> RobotOutcome:
    return RobotOutcome(name, "diagnosed", "", tuple(found), **more)


def force(values: tuple[float, ...], stds: tuple[float, ...]) -> RobotOutcome:
    numbers = {axis: number(*pair) for axis, pair in zip(("ax", "ay"), zip(values, stds, strict=True), strict=False)}
    return robot("r", Tried("constant_force", numbers, 9.0))


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
    assert apart(force(*one), force(*other), "car") is differ
    assert apart(force(*other), force(*one), "car") is differ


@pytest.mark.parametrize(("other", "differ"), [(1.22, False), (1.21, True), (1.40, False), (1.43, True)])
def test_a_gain_differs_by_its_change_from_one(other: float, differ: bool) -> None:
    gains = [robot("r", Tried("steering_gain", {"gain": number(value, 1e-4)}, 9.0)) for value in (1.3, other)]
    assert apart(*gains, "car") is differ


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
def test_a_common_number_differs_where_it_spreads_by_half_of_what_sets_two_robots_apart(
    step: float, differs: bool
) -> None:
    """Five robots about 0.6 m/s2: their spread is 1.58 steps, the limit 0.5 * 0.33 * 0.6 = 0.099."""
    other = Tried("understeer", {"gradient": number(0.0, 1.0)}, 9.0)
    every = [
        robot(f"r{n}", other, Tried("rolling_resistance", {"deceleration": number(0.6 + n * step, 1e-4)}, 9.0))
        for n in (-2, -1, 0, 1, 2)
    ]
    found = {item.effect: item for item in common_effects(every, "car")}
    assert set(found) == {"understeer", "rolling_resistance"}
    rolling = found["rolling_resistance"]
    assert (rolling.found_in, rolling.of, rolling.differs) == (5, 5, differs)
    assert rolling.numbers["deceleration"].mean == pytest.approx(0.6)
    assert {item.effect for item in rolling.said.values()} == {"rolling_resistance"}
    assert found["understeer"].numbers["gradient"].mean == 0.0
    assert common_effects(every[:4], "car") == [], "four robots are too few to speak for a fleet"


@pytest.mark.parametrize("robots", [7, 20, 49, 50, 51, 80, 200, 1000])
def test_a_corrected_model_is_confirmed_if_a_fair_coin_is_as_good_once_in_a_hundred(robots: int) -> None:
    enough = next(hits for hits in range(robots + 1) if stats.binom.sf(hits - 1, robots, 0.5) < 0.01)
    before = {f"r{n}": 1.0 for n in range(robots)}
    for better in (enough, enough - 1):
        after = {f"r{n}": 0.5 if n < better else 1.01 for n in range(robots)}
        found = confirmed(before, after)
        assert (found.robots, found.better, found.holds) == (robots, better, better == enough)
    large = {name: 0.99 if int(name[1:]) < enough else 9.0 for name in before}
    assert confirmed(before, large).holds is (enough == robots), "a few large rises outweigh many small falls"


@pytest.mark.parametrize(
    ("deviate", "tail"), [(0.0, 0.5), (1.0, 0.158655), (1.959964, 0.025), (-1.0, 0.841345), (3.0, 0.00134990)]
)
def test_the_upper_tail_of_the_normal_distribution(deviate: float, tail: float) -> None:
    assert upper_tail(deviate) == pytest.approx(tail, rel=1e-5)


def tried_by(scores: dict[str, list[float]]) -> list[RobotOutcome]:
    """Robots that tried each effect last, with these scores in turn."""
    count = len(next(iter(scores.values())))
    return [
        robot(f"r{n}", last={name: Tried(name, {"x": number(1.0, 1.0)}, own[n]) for name, own in scores.items()})
        for n in range(count)
    ]


def test_evidence_of_a_fleet_is_stouffers_sum() -> None:
    (found,) = evidence_over(tried_by({"drag": [3.0, -1.0, 2.0, 4.0]}))
    assert (found.robots, found.favourable) == (4, 3)
    expected = stats.combine_pvalues(stats.norm.sf([3.0, -1.0, 2.0, 4.0]), "stouffer").statistic
    assert found.score == pytest.approx(expected)


@pytest.mark.parametrize(("mean", "rivals"), [(1.9, ("lag",)), (2.1, ())])
def test_effects_are_rivals_where_their_scores_differ_by_less_than_two_standard_errors(
    mean: float, rivals: tuple[str, ...]
) -> None:
    differences = np.array([-3.0, -1.0, 1.0, 3.0, -2.0, 2.0])
    differences += mean * stats.sem(differences)
    found = evidence_over(tried_by({"drag": (5.0 + differences).tolist(), "lag": [5.0] * 6}))
    assert (found[0].effect, found[0].rivals) == ("drag", rivals)


RESULT = {"robot": "r1", "status": "missing", "reason": "", "unreadable_files": []}


def report(scores: dict[str, float], parameters: dict[str, Any]) -> dict[str, Any]:
    """A report of a car in which effects were accepted with these scores."""
    common = {"decision": "accepted", "parameters": {}, "indistinguishable_from": []}
    candidates = [{**common, "effect": name, "stage": n, "score": own} for n, (name, own) in enumerate(scores.items())]
    stages = [{"heldout_error": error} for error in (0.75, 0.5, 0.25)]
    return {
        "robot": "car", "added": list(scores), "unexplained": None, "candidates": candidates, "stages": stages,
        "parameters": parameters, "data_quality": [],
    }  # fmt: skip


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
    score: float, effect: str, numbers: dict[str, Any], evidence: float
) -> None:
    own = {f"{effect}.{k}": {"value": value, "std": std, "unit": "1"} for k, (value, std) in numbers.items()}
    assert outcome_of(RESULT, report({effect: score}, own)).evidence == pytest.approx(evidence)


def test_the_evidence_of_a_robot_with_two_effects_is_that_of_the_weaker_one() -> None:
    for scores in ({"payload": 5.0, "understeer": 7.0}, {"payload": 7.0, "understeer": 5.0}):
        assert outcome_of(RESULT, report(scores, {})).evidence == 5.0
