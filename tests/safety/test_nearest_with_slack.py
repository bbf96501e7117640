"""The nearest point with slack: beside quadprog and a grid, worked by hand, and where it must not answer."""

from __future__ import annotations

from itertools import permutations
from math import inf, nan
from typing import Any

import numpy as np
import pytest
import quadprog
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from tests.safety.closed_form import Row, nearest_with_slack

from safedpa.safety.nearest import LINEAR, QUADRATIC

Values = NDArray[np.float64]

CLOSE = np.array([0.0, 1e-6, 1e-4, 0.01, *np.linspace(0.05, 0.95, 10), 0.99, 1.0 - 1e-4, 1.0 - 1e-6, 1.0])
GRID = np.array([(x, y) for x in CLOSE for y in CLOSE])
ANGLES = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
AROUND = np.vstack([size * np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1) for size in (1e-2, 1e-4, 1e-6)])


def cost(points: Any, rows: list[Row], wish: Any, weights: Any) -> Values:
    """Of points (n, 2) of the unit square, as the problem has it."""
    found = ((np.atleast_2d(points) - wish) ** 2) @ np.array(weights)
    for a, b, limit in rows:
        slack = np.maximum(0.0, limit - np.atleast_2d(points) @ [a, b])
        found = found + LINEAR * slack + QUADRATIC * slack**2
    return np.asarray(found)


def truth(rows: list[Row], wish: Values, weights: Values) -> Values:
    """(2 + rows,) u and slack by quadprog."""
    count, table = len(rows), np.array(rows)
    G = np.diag(2.0 * np.concatenate([weights, np.full(count, QUADRATIC)]))
    c = np.concatenate([2.0 * weights * wish, np.full(count, -LINEAR)])
    eye = np.eye(2 + count)
    C = np.vstack([np.hstack([table[:, :2], np.eye(count)]), eye, -eye[:2]])
    return np.asarray(quadprog.solve_qp(G, c, C.T, np.concatenate([table[:, 2], np.zeros(2 + count), [-1.0, -1.0]]))[0])


def drawn(random: np.random.Generator) -> tuple[list[Row], Values, Values]:
    """Rows as the program has them, their slopes' sizes summing to 1; some of one action alone, some twice."""
    slopes = random.normal(size=(int(random.integers(1, 14)), 2))
    slopes[random.random(slopes.shape) < 0.1] = 0.0
    slopes[np.abs(slopes).sum(axis=1) == 0.0] = 1.0
    slopes /= np.abs(slopes).sum(axis=1)[:, np.newaxis]
    limits = np.minimum(random.normal(size=len(slopes)) * random.choice([0.3, 1.0, 2.0], len(slopes)), 2.0)
    rows: list[Row] = [(a, b, limit) for (a, b), limit in zip(slopes.tolist(), limits.tolist(), strict=True)]
    again = rows[:1] if random.random() < 0.2 else []
    return rows + again, random.uniform(-0.2, 1.2, 2), np.array([1.0, 10.0 ** random.uniform(-2.0, 0.0)])


def test_it_answers_as_quadprog_does_and_leaves_next_to_nothing_to_others() -> None:
    random, silent, slack = np.random.default_rng(0), 0, 0
    for _ in range(1500):
        rows, wish, weights = drawn(random)
        found = nearest_with_slack(rows, (wish[0], wish[1]), (weights[0], weights[1]))
        if found is None:
            silent += 1
            continue
        expected = truth(rows, wish, weights)
        assert cost(found, rows, wish, weights)[0] <= cost(expected[:2], rows, wish, weights)[0] * (1.0 + 1e-12) + 1e-9
        assert found == pytest.approx(expected[:2], abs=2e-5)
        slack += bool(expected[2:].max() > 1e-6)
    assert silent <= 5
    assert 500 < slack < 1500


@settings(max_examples=300, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_no_other_point_costs_less(seed: int) -> None:
    rows, wish, weights = drawn(np.random.default_rng(seed))
    found = nearest_with_slack(rows, (wish[0], wish[1]), (weights[0], weights[1]))
    if found is None:
        return
    assert 0.0 <= min(found) <= max(found) <= 1.0
    here = cost(found, rows, wish, weights)[0]
    points = np.vstack([GRID, np.clip(found + AROUND, 0.0, 1.0)])
    assert here <= cost(points, rows, wish, weights).min() * (1.0 + 1e-12) + 1e-9


def test_without_a_condition_the_wish_within_its_bounds() -> None:
    assert nearest_with_slack([], (0.25, 0.5), (1.0, 1.0)) == (0.25, 0.5)
    assert nearest_with_slack([], (2.0, -3.0), (1.0, 0.5)) == (1.0, 0.0)
    assert nearest_with_slack([(1.0, 0.0, 0.2)], (0.5, 0.5), (1.0, 1.0)) == (0.5, 0.5)


def test_what_can_be_kept_costs_nothing_but_the_way_there() -> None:
    assert nearest_with_slack([(1.0, 0.0, 0.75)], (0.5, 0.5), (1.0, 1.0)) == pytest.approx((0.75, 0.5), abs=1e-12)
    corner: list[Row] = [(1.0, 0.0, 0.75), (0.0, 1.0, 0.75)]
    for order in (corner, corner[::-1]):
        assert nearest_with_slack(order, (0.5, 0.5), (1.0, 1.0)) == pytest.approx((0.75, 0.75), abs=1e-12)
    assert nearest_with_slack([(0.5, 0.5, 0.8)], (0.5, 0.5), (1.0, 2.0)) == pytest.approx((0.9, 0.7), abs=1e-12)


def test_two_that_contradict_each_other_share_what_is_missing() -> None:
    """x >= 0.8 and x <= 0.2: either is short of 0.3; the wish's pull of 1e-5 of their prices moves them by no more."""
    rows: list[Row] = [(1.0, 0.0, 0.8), (-1.0, 0.0, -0.2)]
    found = nearest_with_slack(rows, (0.9, 0.4), (1.0, 1.0))
    assert found is not None
    pull = 2.0 * (0.9 - 0.5) / (2.0 + 4.0 * QUADRATIC)
    assert found == pytest.approx((0.5 + pull, 0.4), abs=1e-12)


def test_the_dearer_of_two_is_kept_and_the_other_one_pays() -> None:
    """Of 2 x >= 1.6 and x <= 0.5: twice the price for the same way."""
    rows: list[Row] = [(2.0, 0.0, 1.6), (-1.0, 0.0, -0.5)]
    found = nearest_with_slack(rows, (0.5, 0.5), (1.0, 1.0))
    assert found is not None
    # 2 (x - 0.5) - 2 (rho1 + 2 rho (1.6 - 2 x)) + rho1 + 2 rho (x - 0.5) = 0, as long as 2 x < 1.6
    x = (1.0 + LINEAR + 2.0 * QUADRATIC * (3.2 + 0.5)) / (2.0 + 10.0 * QUADRATIC)
    assert found == pytest.approx((x, 0.5), abs=1e-12)
    assert 0.5 < x < 0.8


def test_a_condition_is_given_up_where_it_costs_more_than_its_price() -> None:
    """A slope of 1e-5 pulls with 0.1 where it is short at all; the way to its line would cost 2 * 0.3."""
    found = nearest_with_slack([(1e-5, 0.0, 0.8e-5)], (0.5, 0.5), (1.0, 1.0))
    assert found is not None
    pull = LINEAR * 1e-5 + 2.0 * QUADRATIC * 1e-5 * (0.8e-5 - 0.5e-5)
    assert found == pytest.approx((0.5 + 0.5 * pull, 0.5), abs=1e-6)


def test_a_limit_out_of_reach_leads_to_the_bounds_exactly() -> None:
    assert nearest_with_slack([(0.5, 0.5, 2.0)], (0.3, 0.6), (1.0, 1.0)) == (1.0, 1.0)
    assert nearest_with_slack([(-0.5, -0.5, 2.0)], (0.3, 0.6), (1.0, 1.0)) == (0.0, 0.0)
    found = nearest_with_slack([(-1.0, 0.0, 2.0)], (0.3, 0.6), (1.0, 1.0))
    assert found == (0.0, pytest.approx(0.6, abs=1e-12))
    assert nearest_with_slack([(0.0, 1.0, 2.0)], (0.3, 0.6), (1.0, 1.0)) == (pytest.approx(0.3, abs=1e-12), 1.0)


@pytest.mark.parametrize("order", list(permutations(range(3))))
def test_the_order_of_conditions_does_not_matter(order: tuple[int, ...]) -> None:
    rows: list[Row] = [(1.0, 0.0, 0.9), (-0.5, 0.5, 0.4), (-0.3, -0.7, -0.1)]
    found = nearest_with_slack([rows[index] for index in order], (0.5, 0.5), (1.0, 0.01))
    assert found == pytest.approx(nearest_with_slack(rows, (0.5, 0.5), (1.0, 0.01)), abs=1e-11)


def test_the_same_condition_twice_costs_twice() -> None:
    rows: list[Row] = [(1.0, 0.0, 0.8), (1.0, 0.0, 0.8), (-1.0, 0.0, -0.2)]
    found = nearest_with_slack(rows, (0.5, 0.5), (1.0, 1.0))
    assert found is not None
    # 2 (x - 0.5) - 2 (rho1 + 2 rho (0.8 - x)) + rho1 + 2 rho (x - 0.2) = 0
    assert found[0] == pytest.approx((1.0 + LINEAR + 2.0 * QUADRATIC * 1.8) / (2.0 + 6.0 * QUADRATIC), abs=1e-12)


@pytest.mark.parametrize("row", [(nan, 0.0, 0.1), (1.0, inf, 0.1), (1.0, 0.0, nan), (-inf, 0.0, 0.5)])
def test_numbers_that_are_none_have_no_answer(row: Row) -> None:
    assert nearest_with_slack([row], (0.5, 0.5), (1.0, 1.0)) is None


@pytest.mark.parametrize("wish", [(nan, 0.5), (0.5, nan), (inf, 0.5), (0.5, -inf)])
def test_a_wish_that_is_no_number_has_no_answer(wish: tuple[float, float]) -> None:
    assert nearest_with_slack([(1.0, 0.0, 0.2)], wish, (1.0, 1.0)) is None


@pytest.mark.parametrize("far", [1e154, 1e160, -1e160, 1e200, 1e308])
def test_a_wish_beyond_all_squares_is_never_answered_with_what_is_no_number(far: float) -> None:
    for wish in ((far, 0.5), (0.5, far)):
        found = nearest_with_slack([(1.0, 0.0, 0.7), (-1.0, 0.0, -0.3)], wish, (1.0, 1.0))
        assert found is None or np.isfinite(found).all()


def test_a_weight_too_faint_for_its_price_is_left_to_others() -> None:
    """The bound of y would be held for a price of 4e-10, though nothing but the wish says where y should be."""
    rows: list[Row] = [(1.0, 0.0, 0.25), (0.57, 0.43, -0.5), (-0.87, -0.13, -0.25), (-1.0, 0.0, 0.5)]
    assert nearest_with_slack(rows, (0.99, 0.82), (1.0, 1e-9)) is None
    assert nearest_with_slack(rows, (0.99, 0.82), (0.9e-6, 1.0)) is None
    found = nearest_with_slack(rows, (0.99, 0.82), (1.0, 1.1e-6))
    assert found is not None
    assert found[1] == pytest.approx(0.82, abs=1e-3)
