"""The vertex at which the least height is highest: beside scipy's, and where it must not answer."""

from __future__ import annotations

from math import inf, nan

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.safety.test_highest import least, reference

from safedpa.safety.highest import highest_vertex

Values = NDArray[np.float64]


def drawn(random: np.random.Generator, actions: int) -> tuple[Values, Values, Values]:
    """Slopes, heights and levels that some action holds; at least the first row is free."""
    rows = int(random.integers(1, 20))
    slopes, heights = random.normal(size=(rows, actions)), random.normal(size=rows)
    inside = heights + slopes @ random.uniform(0.0, 1.0, actions)
    some = random.random(rows) < 0.4
    some[0] = False
    return slopes, heights, np.where(some, inside - random.uniform(0.0, 0.2, rows), nan)


@pytest.mark.parametrize("actions", [1, 2, 3, 4])
def test_it_is_as_high_as_scipy_can_make_it_and_nearly_always_answers(actions: int) -> None:
    random, silent = np.random.default_rng(actions), 0
    for _ in range(400):
        slopes, heights, levels = drawn(random, actions)
        found = highest_vertex(slopes.tolist(), heights.tolist(), levels.tolist())
        if found is None:
            silent += 1
            continue
        u, best = np.array(found), reference(slopes, heights, levels)
        assert best is not None
        assert (u >= 0.0).all()
        assert (u <= 1.0).all()
        assert least(slopes, heights, levels, u) == pytest.approx(best, abs=1e-9)
        assert ((heights + slopes @ u >= levels - 1e-10) | np.isnan(levels)).all()
    assert silent <= 2


def test_a_single_row_leads_to_the_bounds_that_its_slopes_name() -> None:
    assert highest_vertex([[1.0, -0.5]], [0.0], [nan]) == [1.0, 0.0]
    assert highest_vertex([[-1.0]], [3.0], [nan]) == [0.0]


def test_two_rows_that_pull_apart_meet() -> None:
    assert highest_vertex([[1.0], [-1.0]], [0.0, 0.5], [nan, nan]) == pytest.approx([0.25], abs=1e-12)
    assert highest_vertex([[1.0], [-3.0]], [0.0, 1.0], [nan, nan]) == pytest.approx([0.25], abs=1e-12)


def test_a_level_holds_a_row_that_is_not_free() -> None:
    """Alone the first would go to 1; the second one falls below -0.4 there."""
    assert highest_vertex([[1.0], [-1.0]], [0.0, 0.0], [nan, -0.4]) == pytest.approx([0.4], abs=1e-12)
    assert highest_vertex([[1.0], [-1.0]], [0.0, 0.0], [nan, -2.0]) == [1.0]


def test_heights_of_any_size_are_compared_to_their_own_rounding() -> None:
    found = highest_vertex([[1.0, 0.2], [-1.0, 0.1]], [1e6, 1e6 + 0.5], [nan, nan])
    assert found == pytest.approx([0.2, 1.0], abs=1e-9)
    assert highest_vertex([[1.0], [1.0]], [0.0, 1e12], [nan, nan]) == [1.0]


def test_several_optima_are_left_to_the_solver_which_takes_the_middle() -> None:
    assert highest_vertex([[1.0, 0.0]], [0.0], [nan]) is None
    assert highest_vertex([[0.0, 0.0]], [0.0], [nan]) is None
    assert highest_vertex([[1.0, 1.0], [-1.0, -1.0]], [0.0, 1.0], [nan, nan]) is None
    assert highest_vertex([[1.0, 4e-10]], [0.0], [nan]) is None  # less than the pull towards the middle
    assert highest_vertex([[1.0, 6e-10]], [0.0], [nan]) == [1.0, 1.0]


@pytest.mark.parametrize(
    ("slopes", "levels"),
    [
        ([[1.0], [1.0]], [nan, 1.5]),
        ([[1.0], [-1.0]], [0.75, -0.25]),
        ([[1.0], [1.0], [-1.0]], [nan, 0.75, -0.25]),
        ([[1.0]], [0.5]),
        ([[1.0], [0.0]], [nan, 0.5]),
    ],
)
def test_no_answer_where_levels_cannot_be_held_or_no_row_is_free(
    slopes: list[list[float]], levels: list[float]
) -> None:
    assert highest_vertex(slopes, [0.0] * len(slopes), levels) is None


@pytest.mark.parametrize("number", [nan, inf, -inf])
def test_numbers_that_are_none_have_no_answer(number: float) -> None:
    for place in range(2):
        slopes = [[1.0, 0.5], [0.0, 1.0]]
        slopes[0][place] = number
        assert highest_vertex(slopes, [0.0, 0.0], [nan, nan]) is None
    assert highest_vertex([[1.0, 0.5]], [number], [nan]) is None
    assert highest_vertex([[1.0, 0.5], [1.0, 1.0]], [0.0, number], [nan, 0.1]) is None


def test_a_level_without_end_is_no_number() -> None:
    assert highest_vertex([[1.0], [1.0]], [0.0, 0.0], [nan, -inf]) is None
    assert highest_vertex([[1.0], [1.0]], [0.0, 0.0], [nan, inf]) is None


def test_as_many_heights_and_levels_as_rows() -> None:
    for heights, levels in (([0.0, 0.0], [nan]), ([0.0], [nan, nan]), ([], [nan])):
        with pytest.raises(ValueError, match=f"1 rows of slopes, {len(heights)} heights and {len(levels)} levels"):
            highest_vertex([[1.0]], heights, levels)
    assert highest_vertex([], [], []) is None
