"""The closed form beside PIQP, and where it must not answer."""

from __future__ import annotations

from math import inf, nan

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.safety import QuadraticProgram
from safedpa.safety.nearest import Row, nearest_kept

numbers = st.integers(-200, 200).map(lambda number: number / 100)
"""Slopes of 1e-7 are beyond what PIQP can tell."""
BOX: tuple[Row, ...] = ((1.0, 0.0, 0.0, inf), (-1.0, 0.0, -1.0, inf), (0.0, 1.0, 0.0, inf), (0.0, -1.0, -1.0, inf))


@settings(max_examples=300, deadline=None)
@given(
    conditions=st.lists(st.tuples(numbers, numbers, numbers), min_size=1, max_size=10),
    wish=st.tuples(numbers, numbers),
    weights=st.tuples(st.floats(0.1, 3.0), st.floats(0.1, 3.0)),
)
def test_what_it_gives_is_what_piqp_gives(
    conditions: list[tuple[float, float, float]], wish: tuple[float, float], weights: tuple[float, float]
) -> None:
    program = QuadraticProgram(np.full(2, -1.0), np.full(2, 1.5), np.array(weights), 1e5, 1e4)
    table = np.array(conditions)
    quick = program.solve(table[:, :2].tolist(), table[:, 2].tolist(), wish)
    scaled, right = table[:, :2] * program.range, table[:, 2] - table[:, :2] @ program.low
    rows = list(zip(scaled.tolist(), right.tolist(), range(len(right)), strict=True))
    closed = program._without_slack(rows, wish)
    if closed is None:
        return  # PIQP answers
    certain = program._with_slack(rows, wish, len(rows))
    assert max(quick.slack) == 0.0
    if certain.solved:
        np.testing.assert_allclose(closed, certain.action, atol=2e-5)  # its gap of 1e-11 leaves a square root
        assert program.distance(closed, wish) <= program.distance(certain.action, wish) + 1e-9
    assert (table[:, :2] @ closed >= table[:, 2] - 1e-11).all()
    assert (np.array(closed) >= program.low - 1e-11).all()
    assert (np.array(closed) <= program.high + 1e-11).all()


def test_it_answers_most_problems_that_need_no_slack() -> None:
    random, answered, possible = np.random.default_rng(0), 0, 0
    for _ in range(500):
        A, inside = random.normal(size=(random.integers(1, 8), 2)), random.uniform(0.0, 1.0, 2)
        right, wish = A @ inside - random.uniform(0.0, 0.2, len(A)), random.uniform(-1.0, 2.0, 2)
        rows = [(a, b, limit, 1e9) for (a, b), limit in zip(A.tolist(), right.tolist(), strict=True)]
        possible += 1
        answered += nearest_kept([*rows, *BOX], (wish[0], wish[1]), (1.0, 2.0)) is not None
    assert answered == possible


def test_the_wish_itself_where_it_keeps_all() -> None:
    assert nearest_kept([(1.0, 0.0, 0.2, 1.0), *BOX], (0.5, 0.5), (1.0, 1.0)) == (0.5, 0.5)


def test_a_foot_and_a_corner() -> None:
    assert nearest_kept([(1.0, 0.0, 0.75, 10.0), *BOX], (0.5, 0.5), (1.0, 1.0)) == (0.75, 0.5)
    assert nearest_kept([(1.0, 0.0, 0.75, 10.0), (0.0, 2.0, 1.5, 10.0), *BOX], (0.5, 0.5), (1.0, 1.0)) == (0.75, 0.75)
    assert nearest_kept(BOX, (2.0, -3.0), (1.0, 1.0)) == (1.0, 0.0)


def test_weights_say_which_entry_moves_more() -> None:
    found = nearest_kept([(1.0, 1.0, 1.6, 10.0), *BOX], (0.5, 0.5), (1.0, 2.0))
    assert found == pytest.approx((0.9, 0.7))


@pytest.mark.parametrize(("price", "answers"), [(0.5, True), (0.49, False)])
def test_a_condition_dearer_than_its_slack_is_left_to_the_solver(price: float, answers: bool) -> None:
    """2 (0.75 - 0.5) = 0.5 is its multiplier."""
    assert (nearest_kept([(1.0, 0.0, 0.75, price), *BOX], (0.5, 0.5), (1.0, 1.0)) is not None) == answers
    corner: list[Row] = [(1.0, 0.0, 0.75, price), (0.0, 1.0, 0.75, 9.0)]
    assert (nearest_kept([*corner, *BOX], (0.5, 0.5), (1.0, 1.0)) is not None) == answers
    assert (nearest_kept([*corner[::-1], *BOX], (0.5, 0.5), (1.0, 1.0)) is not None) == answers


@pytest.mark.parametrize(("price", "answers"), [(0.25, True), (0.24, False)])
def test_a_corner_of_steep_conditions_has_small_multipliers(price: float, answers: bool) -> None:
    """2 (0.75 - 0.5) = 0.25 times the slope 2."""
    rows: list[Row] = [(2.0, 0.0, 1.5, price), (0.0, 2.0, 1.5, 9.0)]
    for order in (rows, rows[::-1]):
        assert (nearest_kept([*order, *BOX], (0.5, 0.5), (1.0, 1.0)) is not None) == answers


def test_faint_conditions_have_a_corner_too() -> None:
    rows: list[Row] = [(1e-5, 0.0, 0.75e-5, inf), (0.0, 1e-5, 0.75e-5, inf)]
    assert nearest_kept([*rows, *BOX], (0.5, 0.5), (1.0, 1.0)) == pytest.approx((0.75, 0.75))


@pytest.mark.parametrize(
    "row",
    [(0.0, 0.0, 0.1, 1e9), (1.0, 0.0, 1.1, 1e9), (nan, 0.0, 0.1, 1e9), (1.0, inf, 0.1, 1e9), (1.0, 0.0, nan, 1e9)],
)
def test_no_answer_where_there_is_none(row: Row) -> None:
    assert nearest_kept([row, *BOX], (0.5, 0.5), (1.0, 1.0)) is None
    assert nearest_kept([*BOX, row], (0.5, 0.5), (1.0, 1.0)) is None


def test_a_row_of_zeros_has_no_corner_with_what_was_taken_in_before() -> None:
    assert nearest_kept([(0.0, 0.0, 0.1, 1e9), *BOX], (2.0, 0.5), (1.0, 1.0)) is None


def test_rows_that_are_almost_parallel_have_no_corner() -> None:
    rows: list[Row] = [(1.0, 0.0, 0.6, 1e9), (-1.0, 1e-12, -0.4, 1e9)]
    assert nearest_kept([*rows, *BOX], (0.5, 0.5), (1.0, 1.0)) is None


def test_one_action_and_three() -> None:
    one = QuadraticProgram(np.array([-1.0]), np.array([3.0]), np.array([2.0]), 1e5, 1e4)
    assert one.solve([[2.0]], [1.0], [-0.5]).action == [0.5]
    three = QuadraticProgram(np.full(3, -1.0), np.full(3, 1.0), np.ones(3), 1e5, 1e4)
    np.testing.assert_allclose(three.solve([[1.0] * 3], [1.5], [0.0] * 3).action, 0.5, atol=1e-7)
