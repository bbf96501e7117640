"""Actions spread over the whole of their range."""

from itertools import pairwise

import numpy as np
import pytest

from safedpa.safety.lattice import NEARBY, around, lattice

SIDE = (-1.0, 2.0, 3.0)


@pytest.mark.parametrize(("actions", "points"), [(1, 9), (2, 5), (3, 3), (4, 2)])
def test_evenly_spread_with_all_corners(actions: int, points: int) -> None:
    found = lattice((SIDE,) * actions, affine=False)
    assert len(found) == len(set(found)) == points**actions
    for entry in range(actions):
        values = sorted({action[entry] for action in found})
        np.testing.assert_allclose(values, np.linspace(-1.0, 2.0, points), atol=1e-15)
        assert (values[0], values[-1]) == (-1.0, 2.0)  # bit for bit: within the bounds


@pytest.mark.parametrize("actions", [1, 2, 3, 4])
def test_of_an_affine_model_the_corners_alone(actions: int) -> None:
    found = lattice((SIDE,) * actions, affine=True)
    assert len(found) == 2**actions
    assert {value for action in found for value in action} == {-1.0, 2.0}


@pytest.mark.parametrize("affine", [False, True])
def test_of_many_actions_none(affine: bool) -> None:
    assert lattice((SIDE,) * 5, affine=affine) == []


def test_the_highest_value_is_the_bound_itself() -> None:
    """0.1 + 0.2 * 3 / 3 would be beyond 0.3."""
    assert max(lattice(((0.1, 0.3, 0.2),), affine=False)) == (0.3,)
    assert lattice(((0.1, 0.3, 0.2), (0.0, 1.0, 1.0)), affine=True) == [(0.1, 0.0), (0.1, 1.0), (0.3, 0.0), (0.3, 1.0)]


def test_what_lies_around_an_action_is_one_entry_moved_at_a_time_within_the_bounds() -> None:
    sides = ((0.0, 10.0, 10.0), (-1.0, 1.0, 2.0))
    assert around(sides, (5.0, 0.0), 0.25) == [(2.5, 0.0), (7.5, 0.0), (5.0, -0.5), (5.0, 0.5)]
    assert around(sides, (0.0, 0.75), 0.25) == [(2.5, 0.75), (0.0, 0.25), (0.0, 1.0)], "no step that a bound forbids"
    assert around(sides, (0.0, 1.0), 0.0) == []


def test_of_three_actions_the_others_stay_where_they_are() -> None:
    sides = (SIDE,) * 3
    for other in around(sides, (0.1, 0.2, 0.3), 0.1):
        assert sum(one != kept for one, kept in zip(other, (0.1, 0.2, 0.3), strict=True)) == 1


def test_it_is_looked_nearer_and_nearer() -> None:
    """From a quarter of the range, between the points of the lattice, down to what is as good as the same."""
    assert tuple(sorted(NEARBY, reverse=True)) == NEARBY
    assert 0.2 < NEARBY[0] <= 0.25
    assert 0.005 < NEARBY[-1] < 0.01
    assert all(0.3 < less / more < 0.6 for more, less in pairwise(NEARBY))
