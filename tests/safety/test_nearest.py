"""The closed forms of the nearest point, with slack and for many robots, and where they must not answer."""

from collections.abc import Iterable
from itertools import permutations
from math import inf, nan
from typing import Any

import numpy as np
import pytest
import quadprog
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from safedpa.safety.batch.active_set_2d import solve_hard_qp_2d_batch
from safedpa.safety.solver.active_set_2d import LINEAR_PRICE, QUADRATIC_PRICE, HardQP2D, SoftQP2D

Row = tuple[float, float, float]
"""a_1, a_2, b."""
Point = tuple[float, float]


def nearest_feasible(rows: Iterable[Row], nominal: Point, weights: Point) -> Point | None:
    """The point of the unit square; None where it has no answer."""
    return answer(HardQP2D(*nominal, *weights), rows)


def nearest_with_slack(rows: Iterable[Row], nominal: Point, weights: Point) -> Point | None:
    return answer(SoftQP2D(*nominal, *weights), rows)


def answer(problem: Any, rows: Iterable[Row]) -> Point | None:
    for row in rows:
        problem.add(*row)
    return (problem.x, problem.y) if problem.solve() else None


def test_wherever_all_can_be_kept_it_answers_as_quadprog_does() -> None:
    random = np.random.default_rng(0)
    for _ in range(500):
        A, inside = random.normal(size=(random.integers(1, 8), 2)), random.uniform(0.0, 1.0, 2)
        right, nominal = A @ inside - random.uniform(0.0, 0.2, len(A)), random.uniform(-1.0, 2.0, 2)
        weights = 10.0 ** random.uniform(-2.0, 0.0, 2)
        rows = [(a, b, limit) for (a, b), limit in zip(A.tolist(), right.tolist(), strict=True)]
        C, d = np.vstack([A, np.eye(2), -np.eye(2)]), np.concatenate([right, [0.0, 0.0, -1.0, -1.0]])
        truth = quadprog.solve_qp(np.diag(2.0 * weights), 2.0 * weights * nominal, C.T, d)[0]
        found = nearest_feasible(rows, (nominal[0], nominal[1]), (weights[0], weights[1]))
        assert found == pytest.approx(truth, abs=1e-7)


def test_among_many_sides_it_gives_the_minimiser_or_nothing() -> None:
    """Polygons of up to 60 sides, each in a unit of its own: some take more turns than there are."""
    random, silent = np.random.default_rng(1), 0
    for _ in range(150):
        count, centre = int(random.integers(5, 60)), random.uniform(0.2, 0.8, 2)
        angle, unit = random.uniform(0.0, 2.0 * np.pi, count), 10.0 ** random.uniform(-2.0, 0.0, count)
        A = np.stack([np.cos(angle), np.sin(angle)], axis=1) * unit[:, np.newaxis]
        right, nominal = A @ centre - 10.0 ** random.uniform(-2.0, 0.2) * unit, centre + random.normal(0.0, 3.0, 2)
        found = nearest_feasible(
            [(a, b, c) for (a, b), c in zip(A.tolist(), right.tolist(), strict=True)], nominal, (1.0, 0.3)
        )
        C, d = np.vstack([A, np.eye(2), -np.eye(2)]), np.concatenate([right, [0.0, 0.0, -1.0, -1.0]])
        truth = quadprog.solve_qp(np.diag([2.0, 0.6]), np.array([2.0, 0.6]) * nominal, C.T, d)[0]
        silent += found is None
        assert found is None or found == pytest.approx(truth, abs=1e-6)
    assert 0 < silent < 30


def test_the_nominal_action_itself_a_foot_or_a_corner_is_nearest_and_weights_say_which_entry_moves_more() -> None:
    assert nearest_feasible([(1.0, 0.0, 0.2)], (0.5, 0.5), (1.0, 1.0)) == (0.5, 0.5)
    assert nearest_feasible([(1.0, 0.0, 0.75)], (0.5, 0.5), (1.0, 1.0)) == (0.75, 0.5)
    assert nearest_feasible([(1.0, 0.0, 0.75), (0.0, 2.0, 1.5)], (0.5, 0.5), (1.0, 1.0)) == (0.75, 0.75)
    assert nearest_feasible([], (2.0, -3.0), (1.0, 1.0)) == (1.0, 0.0)
    found = nearest_feasible([(1.0, 1.0, 1.6)], (0.5, 0.5), (1.0, 2.0))
    assert found == pytest.approx((0.9, 0.7))


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
def test_no_condition_is_too_dear_however_steep_for_one_robot_or_many(size: float) -> None:
    """There is no price at which one would rather be broken."""
    foot: list[Row] = [(size, 0.0, 0.75 * size)]
    assert nearest_feasible([*foot], (0.5, 0.5), (1.0, 1.0)) == pytest.approx((0.75, 0.5), abs=1e-6)
    corner: list[Row] = [*foot, (0.0, size, 0.75 * size)]
    for order in (corner, corner[::-1]):
        assert nearest_feasible([*order], (0.5, 0.5), (1.0, 1.0)) == pytest.approx((0.75, 0.75), abs=1e-6)
    found, certain = one([[size, 0.0], [0.0, size]], [0.75 * size, 0.75 * size], (0.5, 0.5))
    assert certain
    np.testing.assert_allclose(found, 0.75, atol=1e-6)


@pytest.mark.parametrize("order", list(permutations(range(3))))
def test_in_whatever_order_a_condition_that_another_makes_needless_is_left_behind(order: tuple[int, ...]) -> None:
    """x >= 0.6 is kept by anyone who keeps x >= 0.75; in whatever order they stand."""
    rows: list[Row] = [(1.0, 0.0, 0.6), (1.0, 0.0, 0.75), (1.0, 1.0, 1.2)]
    assert nearest_feasible([*[rows[index] for index in order]], (0.5, 0.5), (1.0, 1.0)) == (0.75, 0.5)
    rows: list[Row] = [(1.0, 0.0, 0.9), (-0.5, 0.5, 0.4), (-0.3, -0.7, -0.1)]
    found = nearest_with_slack([rows[index] for index in order], (0.5, 0.5), (1.0, 0.01))
    assert found == pytest.approx(nearest_with_slack(rows, (0.5, 0.5), (1.0, 0.01)), abs=1e-11)


def test_a_corner_with_one_foot_that_is_no_corner() -> None:
    """The corner of both would need to pull: the foot on the newest alone is the optimum."""
    rows: list[Row] = [(1.0, 1.0, 1.2), (1.0, -1.0, 0.3)]
    found = nearest_feasible([*rows], (0.5, 0.5), (1.0, 1.0))
    assert found == pytest.approx((0.75, 0.45))
    rows = [(1.0, 0.0, 0.7), (2.0, 1.0, 2.2)]
    assert nearest_feasible([*rows], (0.5, 0.5), (1.0, 1.0)) == pytest.approx((0.78, 0.64))


@pytest.mark.parametrize("missed", [0.9e-12, 1.1e-12])
def test_what_rounding_breaks_is_kept(missed: float) -> None:
    found = nearest_feasible([(1.0, 0.0, 0.5 + missed)], (0.5, 0.5), (1.0, 1.0))
    assert found is not None
    assert (found[0] == 0.5) == (missed < 1e-12)


@pytest.mark.parametrize("row", [(0.0, 0.0, 0.1), (1.0, 0.0, 1.1), (nan, 0.0, 0.1), (1.0, inf, 0.1), (1.0, 0.0, nan)])
def test_no_answer_where_there_is_none(row: Row) -> None:
    assert nearest_feasible([row], (0.5, 0.5), (1.0, 1.0)) is None


@pytest.mark.parametrize("nominal", [(nan, 0.5), (0.5, nan), (inf, 0.5), (0.5, -inf)])
@pytest.mark.parametrize("rows", [[], [(1.0, 0.0, 0.6)], [(0.0, 1.0, 0.6), (1.0, 1.0, 1.2)]])
def test_no_answer_to_a_nominal_action_that_is_not_finite(nominal: tuple[float, float], rows: list[Row]) -> None:
    assert nearest_feasible(rows, nominal, (1.0, 1.0)) is None


def test_rows_that_are_zero_or_almost_parallel_have_no_corner() -> None:
    assert nearest_feasible([(0.0, 0.0, 0.1)], (2.0, 0.5), (1.0, 1.0)) is None
    rows: list[Row] = [(1.0, 0.0, 0.6), (-1.0, 1e-12, -0.4)]
    assert nearest_feasible([*rows], (0.5, 0.5), (1.0, 1.0)) is None


Values = NDArray[np.float64]
CLOSE = np.array([0.0, 1e-6, 1e-4, 0.01, *np.linspace(0.05, 0.95, 10), 0.99, 1.0 - 1e-4, 1.0 - 1e-6, 1.0])
GRID = np.array([(x, y) for x in CLOSE for y in CLOSE])
ANGLES = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
AROUND = np.vstack([size * np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1) for size in (1e-2, 1e-4, 1e-6)])


def cost(points: Any, rows: list[Row], nominal: Any, weights: Any) -> Values:
    """Of points (n, 2) of the unit square, as the problem has it."""
    found = ((np.atleast_2d(points) - nominal) ** 2) @ np.array(weights)
    for a, b, limit in rows:
        slack = np.maximum(0.0, limit - np.atleast_2d(points) @ [a, b])
        found = found + LINEAR_PRICE * slack + QUADRATIC_PRICE * slack**2
    return np.asarray(found)


def truth(rows: list[Row], nominal: Values, weights: Values) -> Values:
    """(2 + rows,) u and slack by quadprog."""
    count, table = len(rows), np.array(rows)
    G = np.diag(2.0 * np.concatenate([weights, np.full(count, QUADRATIC_PRICE)]))
    c = np.concatenate([2.0 * weights * nominal, np.full(count, -LINEAR_PRICE)])
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
        rows, nominal, weights = drawn(random)
        found = nearest_with_slack(rows, (nominal[0], nominal[1]), (weights[0], weights[1]))
        if found is None:
            silent += 1
            continue
        expected = truth(rows, nominal, weights)
        assert (
            cost(found, rows, nominal, weights)[0]
            <= cost(expected[:2], rows, nominal, weights)[0] * (1.0 + 1e-12) + 1e-9
        )
        assert found == pytest.approx(expected[:2], abs=2e-5)
        slack += bool(expected[2:].max() > 1e-6)
    assert silent <= 5
    assert 500 < slack < 1500


@settings(max_examples=300, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_no_other_point_costs_less(seed: int) -> None:
    rows, nominal, weights = drawn(np.random.default_rng(seed))
    found = nearest_with_slack(rows, (nominal[0], nominal[1]), (weights[0], weights[1]))
    if found is None:
        return
    assert 0.0 <= min(found) <= max(found) <= 1.0
    here = cost(found, rows, nominal, weights)[0]
    points = np.vstack([GRID, np.clip(found + AROUND, 0.0, 1.0)])
    assert here <= cost(points, rows, nominal, weights).min() * (1.0 + 1e-12) + 1e-9


def test_without_a_condition_the_nominal_action_stays_and_what_can_be_kept_costs_but_the_way_there() -> None:
    assert nearest_with_slack([], (0.25, 0.5), (1.0, 1.0)) == (0.25, 0.5)
    assert nearest_with_slack([], (2.0, -3.0), (1.0, 0.5)) == (1.0, 0.0)
    assert nearest_with_slack([(1.0, 0.0, 0.2)], (0.5, 0.5), (1.0, 1.0)) == (0.5, 0.5)
    assert nearest_with_slack([(1.0, 0.0, 0.75)], (0.5, 0.5), (1.0, 1.0)) == pytest.approx((0.75, 0.5), abs=1e-12)
    corner: list[Row] = [(1.0, 0.0, 0.75), (0.0, 1.0, 0.75)]
    for order in (corner, corner[::-1]):
        assert nearest_with_slack(order, (0.5, 0.5), (1.0, 1.0)) == pytest.approx((0.75, 0.75), abs=1e-12)
    assert nearest_with_slack([(0.5, 0.5, 0.8)], (0.5, 0.5), (1.0, 2.0)) == pytest.approx((0.9, 0.7), abs=1e-12)


def test_two_that_contradict_each_other_share_what_is_missing_by_what_they_cost() -> None:
    """x >= 0.8 and x <= 0.2: either is short of 0.3; the nominal action's pull of 1e-5 of their prices moves them by
    no more."""
    rows: list[Row] = [(1.0, 0.0, 0.8), (-1.0, 0.0, -0.2)]
    found = nearest_with_slack(rows, (0.9, 0.4), (1.0, 1.0))
    assert found is not None
    pull = 2.0 * (0.9 - 0.5) / (2.0 + 4.0 * QUADRATIC_PRICE)
    assert found == pytest.approx((0.5 + pull, 0.4), abs=1e-12)
    # Of 2 x >= 1.6 and x <= 0.5: twice the price for the same way.
    rows: list[Row] = [(2.0, 0.0, 1.6), (-1.0, 0.0, -0.5)]
    found = nearest_with_slack(rows, (0.5, 0.5), (1.0, 1.0))
    assert found is not None
    # 2 (x - 0.5) - 2 (rho1 + 2 rho (1.6 - 2 x)) + rho1 + 2 rho (x - 0.5) = 0, as long as 2 x < 1.6
    x = (1.0 + LINEAR_PRICE + 2.0 * QUADRATIC_PRICE * (3.2 + 0.5)) / (2.0 + 10.0 * QUADRATIC_PRICE)
    assert found == pytest.approx((x, 0.5), abs=1e-12)
    assert 0.5 < x < 0.8


def test_a_condition_that_costs_more_than_its_price_is_given_up_and_one_out_of_reach_leads_to_the_bounds() -> None:
    """A slope of 1e-5 pulls with 0.1 where it is short at all; the way to its line would cost 2 * 0.3."""
    found = nearest_with_slack([(1e-5, 0.0, 0.8e-5)], (0.5, 0.5), (1.0, 1.0))
    assert found is not None
    pull = LINEAR_PRICE * 1e-5 + 2.0 * QUADRATIC_PRICE * 1e-5 * (0.8e-5 - 0.5e-5)
    assert found == pytest.approx((0.5 + 0.5 * pull, 0.5), abs=1e-6)
    assert nearest_with_slack([(0.5, 0.5, 2.0)], (0.3, 0.6), (1.0, 1.0)) == (1.0, 1.0)
    assert nearest_with_slack([(-0.5, -0.5, 2.0)], (0.3, 0.6), (1.0, 1.0)) == (0.0, 0.0)
    found = nearest_with_slack([(-1.0, 0.0, 2.0)], (0.3, 0.6), (1.0, 1.0))
    assert found == (0.0, pytest.approx(0.6, abs=1e-12))
    assert nearest_with_slack([(0.0, 1.0, 2.0)], (0.3, 0.6), (1.0, 1.0)) == (pytest.approx(0.3, abs=1e-12), 1.0)


def test_the_same_condition_twice_costs_twice() -> None:
    rows: list[Row] = [(1.0, 0.0, 0.8), (1.0, 0.0, 0.8), (-1.0, 0.0, -0.2)]
    found = nearest_with_slack(rows, (0.5, 0.5), (1.0, 1.0))
    assert found is not None
    # 2 (x - 0.5) - 2 (rho1 + 2 rho (0.8 - x)) + rho1 + 2 rho (x - 0.2) = 0
    assert found[0] == pytest.approx(
        (1.0 + LINEAR_PRICE + 2.0 * QUADRATIC_PRICE * 1.8) / (2.0 + 6.0 * QUADRATIC_PRICE), abs=1e-12
    )


@pytest.mark.parametrize("row", [(nan, 0.0, 0.1), (1.0, inf, 0.1), (1.0, 0.0, nan), (-inf, 0.0, 0.5)])
def test_numbers_that_are_none_have_no_answer(row: Row) -> None:
    assert nearest_with_slack([row], (0.5, 0.5), (1.0, 1.0)) is None


@pytest.mark.parametrize("nominal", [(nan, 0.5), (0.5, nan), (inf, 0.5), (0.5, -inf)])
def test_a_nominal_action_that_is_no_number_has_no_answer(nominal: tuple[float, float]) -> None:
    assert nearest_with_slack([(1.0, 0.0, 0.2)], nominal, (1.0, 1.0)) is None


@pytest.mark.parametrize("far", [1e154, 1e160, -1e160, 1e200, 1e308])
def test_a_nominal_action_beyond_all_squares_is_never_answered_with_what_is_no_number(far: float) -> None:
    for nominal in ((far, 0.5), (0.5, far)):
        found = nearest_with_slack([(1.0, 0.0, 0.7), (-1.0, 0.0, -0.3)], nominal, (1.0, 1.0))
        assert found is None or np.isfinite(found).all()


def test_a_weight_too_faint_for_its_price_is_left_to_others() -> None:
    """The bound of y would be held for a price of 4e-10, though nothing but the nominal action says where y should
    be."""
    rows: list[Row] = [(1.0, 0.0, 0.25), (0.57, 0.43, -0.5), (-0.87, -0.13, -0.25), (-1.0, 0.0, 0.5)]
    assert nearest_with_slack(rows, (0.99, 0.82), (1.0, 1e-9)) is None
    assert nearest_with_slack(rows, (0.99, 0.82), (0.9e-6, 1.0)) is None
    found = nearest_with_slack(rows, (0.99, 0.82), (1.0, 1.1e-6))
    assert found is not None
    assert found[1] == pytest.approx(0.82, abs=1e-3)


WEIGHTS = np.array([1.0, 2.0])
BOX = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
BOX_LIMITS = np.array([0.0, -1.0, 0.0, -1.0])


def alone(slopes: Any, limits: Any, nominal: Any) -> tuple[float, float] | None:
    """What one robot's form says without the rows that are none."""
    rows: list[Row] = [
        (float(a), float(b), float(limit)) for (a, b), limit in zip(slopes, limits, strict=True) if limit > -inf
    ]
    return nearest_feasible(rows, (float(nominal[0]), float(nominal[1])), (float(WEIGHTS[0]), float(WEIGHTS[1])))


@pytest.mark.parametrize("rows", range(1, 10))
def test_every_robot_gets_what_it_gets_alone(rows: int) -> None:
    random = np.random.default_rng(rows)
    robots = 300
    slopes = np.concatenate([random.normal(size=(robots, rows, 2)), np.tile(BOX, (robots, 1, 1))], axis=1)
    limits = np.concatenate([random.normal(0.0, 0.7, (robots, rows)), np.tile(BOX_LIMITS, (robots, 1))], axis=1)
    limits[:, :rows][random.random((robots, rows)) < 0.1] = -inf
    nominal = random.uniform(-1.0, 2.0, (robots, 2))
    # Around a place that keeps all of them, seen from far away: many are taken in before it is found.
    inside = random.uniform(0.2, 0.8, (robots // 2, 2))
    own = (slopes[::2, :rows] @ inside[:, :, np.newaxis])[..., 0] - random.uniform(0.0, 0.2, (robots // 2, rows))
    limits[::2, :rows], nominal[::2] = own, inside + random.normal(0.0, 3.0, (robots // 2, 2))
    points, certain = solve_hard_qp_2d_batch(slopes, limits, nominal, WEIGHTS)
    for robot in range(robots):
        own = alone(slopes[robot, :rows], limits[robot, :rows], nominal[robot])
        assert certain[robot] == (own is not None)
        if own is not None:
            np.testing.assert_allclose(points[robot], own, rtol=0.0, atol=1e-9)
    assert certain[::2].mean() > 0.9


def one(slopes: Any, limits: Any, nominal: Any) -> tuple[list[float], bool]:
    all_slopes = np.concatenate([np.array(slopes, dtype=float), BOX])[np.newaxis]
    all_limits = np.concatenate([np.array(limits, dtype=float), BOX_LIMITS])[np.newaxis]
    points, certain = solve_hard_qp_2d_batch(all_slopes, all_limits, np.array([nominal]), np.ones(2))
    return points[0].tolist(), bool(certain[0])


def test_what_cannot_be_kept_or_is_no_number_is_not_certain() -> None:
    for slopes, limits in (
        ([[0.0, 0.0]], [0.5]),  # no action helps
        ([[1.0, 0.0], [-1.0, 0.0]], [0.8, -0.2]),  # one excludes the other
        ([[nan, 0.0]], [0.5]),
        ([[1.0, inf]], [0.5]),
        ([[1.0, 0.0]], [nan]),
        ([[1.0, 0.0]], [inf]),
    ):
        assert not one(slopes, limits, (0.5, 0.5))[1]


def test_a_robot_without_numbers_changes_nothing_for_the_next() -> None:
    slopes = np.tile(np.concatenate([[[1.0, 0.0]], BOX]), (3, 1, 1))
    limits = np.tile(np.concatenate([[0.75], BOX_LIMITS]), (3, 1))
    slopes[1, 0, 0] = nan
    points, certain = solve_hard_qp_2d_batch(slopes, limits, np.full((3, 2), 0.5), np.ones(2))
    assert certain.tolist() == [True, False, True]
    np.testing.assert_array_equal(points[[0, 2]], [[0.75, 0.5], [0.75, 0.5]])


@pytest.mark.parametrize("size", [1.0, 100.0])
def test_the_corner_of_almost_parallel_conditions_is_not_believed(size: float) -> None:
    """x >= 0.75 and 1e-10 y >= x - 0.75 + 5e-11 meet at y = 0.5, but not so that rounding could tell."""
    slopes = [[size, 0.0], [-size, 1e-10 * size]]
    assert not one(slopes, [0.75 * size, (-0.75 + 5e-11) * size], (0.5, 0.2))[1]
