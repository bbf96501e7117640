"""The closed form alongside quadprog, and where it must not answer."""

from __future__ import annotations

from itertools import permutations
from math import inf, nan

import numpy as np
import pytest
import quadprog
from hypothesis import strategies as st
from tests.safety.closed_form import Row, nearest_kept

from safedpa.safety import QuadraticProgram

numbers = st.integers(-200, 200).map(lambda number: number / 100)
"""Slopes of 1e-7 are beyond what PIQP can tell."""


def test_wherever_all_can_be_kept_it_answers_as_quadprog_does() -> None:
    random = np.random.default_rng(0)
    for _ in range(500):
        A, inside = random.normal(size=(random.integers(1, 8), 2)), random.uniform(0.0, 1.0, 2)
        right, wish = A @ inside - random.uniform(0.0, 0.2, len(A)), random.uniform(-1.0, 2.0, 2)
        weights = 10.0 ** random.uniform(-2.0, 0.0, 2)
        rows = [(a, b, limit) for (a, b), limit in zip(A.tolist(), right.tolist(), strict=True)]
        C, d = np.vstack([A, np.eye(2), -np.eye(2)]), np.concatenate([right, [0.0, 0.0, -1.0, -1.0]])
        truth = quadprog.solve_qp(np.diag(2.0 * weights), 2.0 * weights * wish, C.T, d)[0]
        found = nearest_kept(rows, (wish[0], wish[1]), (weights[0], weights[1]))
        assert found == pytest.approx(truth, abs=1e-7)


def test_among_many_sides_it_gives_the_minimiser_or_nothing() -> None:
    """Polygons of up to 60 sides, each in a unit of its own: some take more turns than there are."""
    random, silent = np.random.default_rng(1), 0
    for _ in range(150):
        count, centre = int(random.integers(5, 60)), random.uniform(0.2, 0.8, 2)
        angle, unit = random.uniform(0.0, 2.0 * np.pi, count), 10.0 ** random.uniform(-2.0, 0.0, count)
        A = np.stack([np.cos(angle), np.sin(angle)], axis=1) * unit[:, np.newaxis]
        right, wish = A @ centre - 10.0 ** random.uniform(-2.0, 0.2) * unit, centre + random.normal(0.0, 3.0, 2)
        found = nearest_kept(
            [(a, b, c) for (a, b), c in zip(A.tolist(), right.tolist(), strict=True)], wish, (1.0, 0.3)
        )
        C, d = np.vstack([A, np.eye(2), -np.eye(2)]), np.concatenate([right, [0.0, 0.0, -1.0, -1.0]])
        truth = quadprog.solve_qp(np.diag([2.0, 0.6]), np.array([2.0, 0.6]) * wish, C.T, d)[0]
        silent += found is None
        assert found is None or found == pytest.approx(truth, abs=1e-6)
    assert 0 < silent < 30


def test_the_wish_itself_where_it_keeps_all() -> None:
    assert nearest_kept([(1.0, 0.0, 0.2)], (0.5, 0.5), (1.0, 1.0)) == (0.5, 0.5)


def test_a_foot_and_a_corner() -> None:
    assert nearest_kept([(1.0, 0.0, 0.75)], (0.5, 0.5), (1.0, 1.0)) == (0.75, 0.5)
    assert nearest_kept([(1.0, 0.0, 0.75), (0.0, 2.0, 1.5)], (0.5, 0.5), (1.0, 1.0)) == (0.75, 0.75)
    assert nearest_kept([], (2.0, -3.0), (1.0, 1.0)) == (1.0, 0.0)


def test_weights_say_which_entry_moves_more() -> None:
    found = nearest_kept([(1.0, 1.0, 1.6)], (0.5, 0.5), (1.0, 2.0))
    assert found == pytest.approx((0.9, 0.7))


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
def test_no_condition_is_too_dear_however_steep_it_is(size: float) -> None:
    """There is no price at which one would rather be broken."""
    foot: list[Row] = [(size, 0.0, 0.75 * size)]
    assert nearest_kept([*foot], (0.5, 0.5), (1.0, 1.0)) == pytest.approx((0.75, 0.5), abs=1e-6)
    corner: list[Row] = [*foot, (0.0, size, 0.75 * size)]
    for order in (corner, corner[::-1]):
        assert nearest_kept([*order], (0.5, 0.5), (1.0, 1.0)) == pytest.approx((0.75, 0.75), abs=1e-6)


@pytest.mark.parametrize("order", list(permutations(range(3))))
def test_a_condition_that_another_makes_needless_is_left_behind(order: tuple[int, ...]) -> None:
    """x >= 0.6 is kept by whoever keeps x >= 0.75; in whatever order they stand."""
    rows: list[Row] = [(1.0, 0.0, 0.6), (1.0, 0.0, 0.75), (1.0, 1.0, 1.2)]
    assert nearest_kept([*[rows[index] for index in order]], (0.5, 0.5), (1.0, 1.0)) == (0.75, 0.5)


def test_a_corner_with_one_foot_that_is_no_corner() -> None:
    """The corner of both would need to pull: the foot on the newest alone is the optimum."""
    rows: list[Row] = [(1.0, 1.0, 1.2), (1.0, -1.0, 0.3)]
    found = nearest_kept([*rows], (0.5, 0.5), (1.0, 1.0))
    assert found == pytest.approx((0.75, 0.45))
    rows = [(1.0, 0.0, 0.7), (2.0, 1.0, 2.2)]
    assert nearest_kept([*rows], (0.5, 0.5), (1.0, 1.0)) == pytest.approx((0.78, 0.64))


@pytest.mark.parametrize("missed", [0.9e-12, 1.1e-12])
def test_what_rounding_breaks_is_kept(missed: float) -> None:
    found = nearest_kept([(1.0, 0.0, 0.5 + missed)], (0.5, 0.5), (1.0, 1.0))
    assert found is not None
    assert (found[0] == 0.5) == (missed < 1e-12)


def test_faint_conditions_have_a_corner_too() -> None:
    rows: list[Row] = [(1e-5, 0.0, 0.75e-5), (0.0, 1e-5, 0.75e-5)]
    assert nearest_kept([*rows], (0.5, 0.5), (1.0, 1.0)) == pytest.approx((0.75, 0.75))


@pytest.mark.parametrize(
    "row",
    [(0.0, 0.0, 0.1), (1.0, 0.0, 1.1), (nan, 0.0, 0.1), (1.0, inf, 0.1), (1.0, 0.0, nan)],
)
def test_no_answer_where_there_is_none(row: Row) -> None:
    assert nearest_kept([row], (0.5, 0.5), (1.0, 1.0)) is None


@pytest.mark.parametrize("wish", [(nan, 0.5), (0.5, nan), (inf, 0.5), (0.5, -inf)])
@pytest.mark.parametrize("rows", [[], [(1.0, 0.0, 0.6)], [(0.0, 1.0, 0.6), (1.0, 1.0, 1.2)]])
def test_no_answer_to_a_wish_that_is_not_finite(wish: tuple[float, float], rows: list[Row]) -> None:
    assert nearest_kept(rows, wish, (1.0, 1.0)) is None


def test_a_row_of_zeros_has_no_corner_with_what_was_taken_in_before() -> None:
    assert nearest_kept([(0.0, 0.0, 0.1)], (2.0, 0.5), (1.0, 1.0)) is None


def test_rows_that_are_almost_parallel_have_no_corner() -> None:
    rows: list[Row] = [(1.0, 0.0, 0.6), (-1.0, 1e-12, -0.4)]
    assert nearest_kept([*rows], (0.5, 0.5), (1.0, 1.0)) is None


def test_one_action_and_three() -> None:
    one = QuadraticProgram(np.array([-1.0]), np.array([3.0]), np.array([2.0]))
    assert one.solve([[2.0]], [1.0], [-0.5]).action == [0.5]
    three = QuadraticProgram(np.full(3, -1.0), np.full(3, 1.0), np.ones(3))
    np.testing.assert_allclose(three.solve([[1.0] * 3], [1.5], [0.0] * 3).action, 0.5, atol=1e-7)
