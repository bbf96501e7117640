"""The conditions linearised about one outcome, with barriers that count what they are asked."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from safedpa.equations.chain_rule import chain_rule
from safedpa.errors import InputError
from safedpa.safety.tangent import MARK, Tangent

WIDTHS = [2.0, 0.5]
G = [[1.0, 0.0], [0.0, -4.0]]


class Slopes:
    """Of h: one row of (states,) each."""

    def __init__(self, *rows: list[float], steepest: list[float] | None = None) -> None:
        self.rows, self._steepest = rows, steepest
        self.asked: list[list[int]] = []

    def steepest(self, state: Sequence[float]) -> list[float] | None:
        return self._steepest

    def along(
        self, state: Sequence[float], g: list[list[float]], widths: list[float], rows: Sequence[int]
    ) -> list[list[float]]:
        self.asked.append(list(rows))
        assert widths == WIDTHS
        return chain_rule([self.rows[row] for row in rows], g)


def drawn(barriers: Slopes, known: float = 0.0) -> tuple[Tangent, list[float]]:
    scales = [known] * len(barriers.rows)
    return Tangent(barriers, G, [7.0, 8.0], WIDTHS, scales), scales


def test_a_row_keeps_the_condition_where_the_tangent_says_that_it_does() -> None:
    """A a >= b just where residual + p'g (a - about) >= the mark."""
    tangent, _ = drawn(Slopes([3.0, 1.0], [0.0, 0.5]))
    A, b = tangent.at([0.3, -0.2], [0.5, 0.1], 0.0)
    assert A == [[3.0, -4.0], [0.0, -2.0]]
    reach = [3.0 * 2.0 + 4.0 * 0.5, 2.0 * 0.5]
    np.testing.assert_allclose(b, [1.5 - 0.4 - 0.3 + MARK * reach[0], -0.2 + 0.2 + MARK * reach[1]], atol=1e-15)


@pytest.mark.parametrize("overshoot", [0.25, 0.5, 2.0])
def test_of_what_is_missing_a_share_is_asked_for_on_top(overshoot: float) -> None:
    """Of what is kept by some distance nothing is."""
    tangent, _ = drawn(Slopes([3.0, 1.0], [0.0, 0.5], [0.0, 0.5]))
    residual = [0.3, -0.2, 0.0]
    plain, more = (np.array(tangent.at(residual, [0.5, 0.1], share)[1]) for share in (0.0, overshoot))
    np.testing.assert_allclose(more - plain, [0.0, 0.2 * overshoot, 0.0], atol=1e-15)


def test_the_mark_is_above_the_rounding_of_a_solution_and_far_below_what_matters() -> None:
    assert 1e-11 < MARK < 1e-8


def test_what_actions_change_is_learned_and_never_less_than_known() -> None:
    barriers = Slopes([3.0, 1.0], [0.0, 0.5])
    tangent, scales = drawn(barriers)
    tangent.at([0.0, 0.0], [0.0, 0.0], 0.0)
    assert scales == [8.0, 1.0]
    tangent, scales = drawn(barriers, known=4.0)
    tangent.at([0.0, 0.0], [0.0, 0.0], 0.0)
    assert scales == [8.0, 4.0]


def test_a_row_is_asked_for_once() -> None:
    barriers = Slopes([3.0, 1.0], [0.0, 0.5])
    tangent, _ = drawn(barriers)
    tangent.at([0.0, 0.0], [0.0, 0.0], 0.0)
    tangent.at([0.0, 1.0], [0.0, 0.0], 0.0)
    assert tangent.all(2) == [[3.0, -4.0], [0.0, -2.0]]
    assert barriers.asked == [[0, 1]]


def test_rows_that_no_action_breaks_are_not_even_asked_for() -> None:
    """No slope is steeper than (3, 1): 3 * 2 + 4 * 0.5 = 8, and a little for rounding."""
    barriers = Slopes([3.0, 1.0], [0.0, 0.5], [3.0, 0.0], steepest=[3.0, 1.0])
    tangent, _ = drawn(barriers)
    A, b = tangent.at([8.0, 8.0 + 1e-6, 7.0], [0.0, 0.0], 0.0)
    assert A == [[3.0, -4.0], [3.0, 0.0]]
    np.testing.assert_allclose(b, [-8.0, -7.0], atol=1e-8)
    assert barriers.asked == [[0, 2]]
    tangent.at([8.0, 0.0, 7.0], [0.0, 0.0], 0.0)
    assert barriers.asked == [[0, 2], [1]]
    assert len(tangent.all(3)) == 3
    assert barriers.asked == [[0, 2], [1]]


@pytest.mark.parametrize(
    ("residual", "near"), [(8.0, True), (8.0 * (1.0 + 0.9e-9), True), (8.0 * (1.0 + 1.1e-9), False)]
)
def test_rounding_leaves_no_row_out(residual: float, near: bool) -> None:
    tangent, _ = drawn(Slopes([3.0, 1.0], steepest=[3.0, 1.0]))
    assert bool(tangent.at([residual], [0.0, 0.0], 0.0)[0]) is near


def test_all_asks_for_what_is_missing_only() -> None:
    barriers = Slopes([3.0, 1.0], [0.0, 0.5], [1.0, 0.0], steepest=[3.0, 1.0])
    tangent, _ = drawn(barriers)
    tangent.at([9.0, 0.0, 9.0], [0.0, 0.0], 0.0)
    assert tangent.all(3) == [[3.0, -4.0], [0.0, -2.0], [1.0, 0.0]]
    assert barriers.asked == [[1], [0, 2]]
    assert tangent.all(2) == [[3.0, -4.0], [0.0, -2.0]]


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_slopes_that_are_no_numbers_are_refused(number: float) -> None:
    for rows in ([number, 0.0], [0.0, number]):
        with np.errstate(invalid="ignore"), pytest.raises(InputError, match="gradient of h: got NaN or infinity"):
            drawn(Slopes([1.0, 0.0], rows))[0].at([0.0, 0.0], [0.0, 0.0], 0.0)


def test_one_slope_that_is_no_number_is_enough() -> None:
    barriers = Slopes([3.0, 1.0])
    barriers.along = lambda *_: [[float("nan"), 1.0]]  # type: ignore[method-assign]
    tangent, _ = drawn(barriers)
    with pytest.raises(InputError, match="gradient of h: got NaN or infinity"):
        tangent.at([-0.1], [0.0, 0.0], 0.0)


def test_slopes_as_large_as_a_float_can_be_are_numbers() -> None:
    """Their sum is infinite, they are not."""
    tangent, scales = drawn(Slopes([1.7e308, 0.0]))
    assert tangent.all(1) == [[1.7e308, 0.0]]
    assert scales == [np.inf]


def test_steepest_slopes_of_other_states_are_refused() -> None:
    with pytest.raises(ValueError, match="the model has slopes of 2 states, the barriers of 3"):
        drawn(Slopes([1.0, 0.0], steepest=[1.0, 1.0, 1.0]))
