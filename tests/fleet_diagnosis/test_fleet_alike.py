"""Groups: one name for what cannot be told apart, numbers without a gap."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from safedpa.fleet.alike import clusters, same_effects, with_one_name
from safedpa.fleet.document import analysed, fleet_document
from safedpa.fleet.story import group_title, headline


def members(outcomes):
    return [sorted(item.name for item in group.members) for group in same_effects(outcomes, "car")]


def test_three_dragging_brakes_are_one_group(make_tried, make_robot):
    brakes = [
        make_robot(f"b{i}", make_tried("rolling_resistance", deceleration=d)) for i, d in enumerate((0.4, 0.45, 0.5))
    ]
    assert members(brakes) == [["b0", "b1", "b2"]]


def test_two_towed_loads_are_two_groups(make_tried, make_robot):
    loads = [0.8, 0.82, 1.3, 1.29]
    cars = [make_robot(f"t{i}", make_tried("towed_load", mass_ratio=m, deceleration=1.0)) for i, m in enumerate(loads)]
    assert members(cars) == [["t0", "t1"], ["t2", "t3"]]


def test_uncertain_numbers_make_no_groups(make_tried, make_robot):
    loads = [0.8, 1.3]
    cars = [make_robot(f"t{i}", make_tried("towed_load", std=0.1, mass_ratio=m)) for i, m in enumerate(loads)]
    assert members(cars) == [["t0", "t1"]]


def test_unknown_deviations_make_no_groups(make_tried, make_robot):
    cars = [
        make_robot(f"t{i}", make_tried("towed_load", std=float("nan"), mass_ratio=m)) for i, m in enumerate((0.2, 2.0))
    ]
    assert members(cars) == [["t0", "t1"]]


@pytest.mark.parametrize(("one", "other", "groups"), [((0.4, 0.3), (-0.4, 0.3), 2), ((0.4, 0.0), (0.39, 0.05), 1)])
def test_the_direction_of_a_slope_counts_with_its_size(make_tried, make_robot, one, other, groups):
    cars = [make_robot(f"s{i}", make_tried("constant_force", ax=x, ay=y)) for i, (x, y) in enumerate((one, other))]
    assert len(members(cars)) == groups


def test_opposite_offsets_are_two_faults(make_tried, make_robot):
    cars = [make_robot(f"o{i}", make_tried("steering_offset", angle=a)) for i, a in enumerate((0.04, -0.04))]
    assert len(members(cars)) == 2


def test_gains_are_distinguished_by_their_change(make_tried, make_robot):
    from safedpa.fleet.outcome import Number, Tried

    gains = [Tried("steering_gain", {"gain": Number(value, 0.001, "1")}, 9.0) for value in (0.95, 0.85)]
    assert len(members([make_robot(f"g{i}", item) for i, item in enumerate(gains)])) == 2


def test_indistinguishable_effects_take_the_most_frequent_name(make_tried, make_robot):
    from dataclasses import replace

    rolling = [
        make_robot(f"r{i}", make_tried("rolling_resistance", equals=("towed_load",), deceleration=0.45))
        for i in range(3)
    ]
    other = make_tried("rolling_resistance", deceleration=0.46)
    towed = replace(
        make_tried("towed_load", equals=("rolling_resistance",), mass_ratio=0.3), others={other.effect: other}
    )
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

    parts = clusters(values, far)
    assert sorted(each for part in parts for each in part) == sorted(values)
    shuffled = random.sample(values, len(values))
    assert sorted(map(sorted, clusters(shuffled, far))) == sorted(map(sorted, parts))
    for part in parts:
        own = sorted(part)
        assert all(b - a <= 1.0 for a, b in pairwise(own))


def test_the_fleet_in_one_sentence(make_tried, make_robot):
    brakes = [
        make_robot(f"b{i}", make_tried("rolling_resistance", deceleration=d)) for i, d in enumerate((0.4, 0.45, 0.5))
    ]
    slope = make_robot("slope", make_tried("constant_force", ax=0.4, ay=0.3))
    weak = make_robot("weak", make_tried("payload", score=3.05, mass_ratio=0.1))
    healthy = [make_robot(f"h{i}") for i in range(40)]
    lost = make_robot("lost", status="unreadable")
    analysis = analysed([*brakes, slope, weak, *healthy, lost], "car")
    document = fleet_document(analysis, [])
    assert headline(document) == (
        "46 robots: 3 lack rolling_resistance (deceleration 0.4 to 0.5 m/s2); 1 lacks constant_force (ax 0.4 m/s2, "
        "ay 0.3 m/s2); in 1 payload is suspected only; in 40 nothing is missing; 1 is unreadable."
    )
    assert document["counts"]["suspected"] == 1
    assert sum(len(group["robots"]) for group in document["groups"]) == 46
    assert group_title(document["groups"][0]) == "rolling_resistance"


def test_a_robot_that_does_not_fit_is_named(make_robot):
    healthy = [make_robot(f"h{i}", error_after=0.02 + 0.0005 * i) for i in range(12)]
    analysis = analysed([*healthy, make_robot("odd", error_after=0.2)], "car")
    assert [name for name, _ in analysis.odd] == ["odd"]
    assert analysed(healthy, "car").odd == ()
