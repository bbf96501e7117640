"""False discoveries: what stands up to the size of a fleet."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safedpa.fleet.discovery import FALSE_SHARE, believed, chance, upper_tail

chances = st.lists(st.floats(0.0, 1.0), min_size=1, max_size=60)


def test_the_tail_of_the_normal_distribution():
    assert upper_tail(0.0) == 0.5
    assert upper_tail(1.959964) == pytest.approx(0.025, rel=1e-5)
    assert chance(float("nan"), 24) == 1.0
    assert chance(-1.0, 24) == 1.0


def test_the_example_of_benjamini_and_hochberg():
    """Section 4 of their paper: of fifteen hypotheses the first four are rejected at 0.05, Bonferroni rejects three."""
    p = [
        0.0001,
        0.0004,
        0.0019,
        0.0095,
        0.0201,
        0.0278,
        0.0298,
        0.0344,
        0.0459,
        0.3240,
        0.4262,
        0.5719,
        0.6528,
        0.7590,
        1.0,
    ]
    stands, limit = believed(p, 0.05)
    assert stands == [True] * 4 + [False] * 11
    assert limit == 0.0095


@given(chances)
def test_what_is_believed_is_what_has_the_smallest_chances(p):
    stands, limit = believed(p)
    assert [value <= limit and any(stands) for value in p] == stands
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
    alarms = np.mean([any(believed(row)[0]) for row in p])
    assert alarms < FALSE_SHARE + 3 * np.sqrt(0.05 * 0.95 / fleets)
    alone = np.mean(tails < upper_tail(3.0))  # what one robot's own threshold would let through
    assert 300 * alone > 5.0


def test_true_ones_among_many_are_believed():
    p = [chance(8.0, 29)] * 6 + [1.0] * 294 + [chance(3.1, 29)]
    stands, _ = believed(p)
    assert stands == [True] * 6 + [False] * 295
