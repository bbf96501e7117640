"""What only a fleet can say: one number from many robots, and effects that all of them have."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from safedpa.dynamics import load_model
from safedpa.fleet.common import common_effects, confirmed, mended_model, mended_settings, together_effects
from safedpa.fleet.outcome import Number
from safedpa.fleet.pooled_evidence import evidence_over, pooled_number

numbers = st.lists(st.tuples(st.floats(-5, 5), st.floats(0.01, 2.0)), min_size=1, max_size=30)


@given(numbers)
@example([(1.75, 1.609375)])
def test_the_mean_lies_among_the_robots_and_the_spread_is_no_larger_than_theirs(values):
    found = pooled_number([Number(value, std, "m") for value, std in values])
    assert found.low - 1e-9 <= found.mean <= found.high + 1e-9
    assert 0.0 <= found.spread <= (found.high - found.low) * 2 + 1e-9
    assert found.robots == len(values)


def test_without_a_spread_it_is_the_weighted_mean():
    found = pooled_number([Number(1.0, 0.1, "m"), Number(1.05, 0.2, "m")])
    assert found.spread == 0.0
    assert found.mean == pytest.approx((1.0 / 0.01 + 1.05 / 0.04) / (1 / 0.01 + 1 / 0.04))
    assert found.std == pytest.approx((1 / 0.01 + 1 / 0.04) ** -0.5)


def test_the_spread_from_robot_to_robot_is_found():
    random = np.random.default_rng(0)
    found = pooled_number([Number(v, 0.01, "m") for v in random.normal(2.0, 0.3, 400)])
    assert found.spread == pytest.approx(0.3, rel=0.1)
    assert abs(found.mean - 2.0) < 4 * found.std


def test_a_robot_that_states_no_deviation_counts_like_the_others():
    found = pooled_number([Number(1.0, 0.1, "m"), Number(3.0, float("nan"), "m")])
    assert found.mean == pytest.approx(2.0)


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
    model = mended_model(load_model("car"), mended_settings("car", [found]))
    setting = model.settings["payload.mass_ratio"]
    assert setting.free is differs
    assert 0.2 <= setting.value <= 0.8


def test_a_robots_own_number_has_no_part_in_the_model_that_is_tried_on_it(make_tried, make_robot):
    values = [0.30] * 9 + [0.36]
    robots = [make_robot(f"r{i}", make_tried("payload", mass_ratio=value)) for i, value in enumerate(values)]
    (found,) = common_effects(robots, "car")
    without = mended_settings("car", [found], "r9")["payload"]["mass_ratio"].value
    assert without == pytest.approx(0.30)
    assert mended_settings("car", [found])["payload"]["mass_ratio"].value > 0.30


def errors(*values):
    return {f"r{i}": value for i, value in enumerate(values)}


def test_a_coin_does_not_mend_a_model():
    assert confirmed(errors(*[0.2] * 10), errors(*[0.1] * 10)).holds
    assert not confirmed(errors(*[0.2, 0.1] * 10), errors(*[0.1, 0.2] * 10)).holds
    assert not confirmed(errors(*[0.2] * 4), errors(*[0.1] * 4)).holds  # a sixteenth is chance enough
    assert not confirmed(errors(*[0.2] * 10), errors(*[float("nan")] * 10)).holds
    assert confirmed(errors(*[0.2] * 100), errors(*[0.1] * 100)).holds
    assert confirmed(errors(0.2), {}).robots == 0


def test_a_number_that_was_pushed_to_its_bound_speaks_for_nothing(make_tried, make_robot):
    stuck = [make_tried("drive_delay", score=3.0, std=float("nan"), deceleration=0.0) for _ in range(20)]
    robots = [make_robot(f"r{i}", last={"drive_delay": item}) for i, item in enumerate(stuck)]
    assert evidence_over(robots)[0].score == 0.0
