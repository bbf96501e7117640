"""Slopes by differences whose steps have no unit."""

from __future__ import annotations

import numpy as np
import pytest

from safedpa.safety.differences import central_slopes


def curved(x: np.ndarray) -> np.ndarray:
    return np.array([np.sin(x[0]) + x[1] ** 2, np.exp(x[1]), x[0]])


def slopes_of(x: np.ndarray) -> np.ndarray:
    return np.array([[np.cos(x[0]), 2.0 * x[1]], [0.0, np.exp(x[1])], [1.0, 0.0]])


@pytest.mark.parametrize("unit", [1e-9, 1e-6, 1.0, 1e6, 1e9])
@pytest.mark.parametrize("state", [(0.7, -0.3), (0.0, 0.0), (0.7, 0.0), (1e-20, 0.3)])
@pytest.mark.parametrize("moved", [(1.0, 1.0), (0.0, 0.0), (1e-14, 0.3), (0.0, 1.0)])
def test_in_any_unit_at_any_place_whatever_moves(
    unit: float, state: tuple[float, ...], moved: tuple[float, ...]
) -> None:
    x = np.array(state)
    found = central_slopes(lambda y: curved(y / unit), unit * x, unit * np.array(moved), np.ones(3))
    np.testing.assert_allclose(found * unit, slopes_of(x), atol=2e-4 if 1e-14 in moved else 2e-6)


def test_a_place_far_from_where_it_is_counted_from() -> None:
    far = np.array([5e5, 4e6])
    found = central_slopes(lambda x: curved(x - far), far + 0.25, np.array([1.0, 1.0]), np.ones(3))
    np.testing.assert_allclose(found, slopes_of(np.array([0.25, 0.25])), atol=1e-5)


def test_what_answers_only_far_off_has_no_slope_here() -> None:
    """A flat stretch as wide as the entry moves; a large step would believe in the hill behind it."""
    found = central_slopes(
        lambda x: np.array([max(0.0, x[0] - 3.0) ** 2]), np.array([1.0]), np.array([1.5]), np.array([1.0])
    )
    np.testing.assert_array_equal(found, [[0.0]])


def test_an_extremum_has_no_slope_though_it_is_curved() -> None:
    found = central_slopes(lambda x: np.array([1.0 + x[0] ** 2 + 5.0 * x[0] ** 3]), np.zeros(1), np.ones(1), np.ones(1))
    np.testing.assert_allclose(found, [[0.0]], atol=1e-9)


@pytest.mark.parametrize("moved", [0.0, 1.0])
@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_a_step_so_large_that_only_curvature_answers_is_not_believed(moved: float, unit: float) -> None:
    found = central_slopes(
        lambda x: np.array([1.0 + (x[0] / unit) ** 3]), np.zeros(1), np.array([unit * moved]), np.ones(1)
    )
    np.testing.assert_allclose(found * unit, [[0.0]], atol=1e-7)


def test_one_value_that_answers_is_enough_for_all() -> None:
    """What is small beside its own size does not make the step grow for the others."""
    steps = []

    def function(x: np.ndarray) -> np.ndarray:
        steps.append(abs(float(x[0])))
        return np.array([x[0], 1e9 + 0.0 * x[0]])

    found = central_slopes(function, np.zeros(1), np.ones(1), np.array([1.0, 1e9]))
    np.testing.assert_allclose(found, [[1.0], [0.0]], atol=1e-9)
    assert len(steps) == 2
    assert steps[0] == pytest.approx(np.finfo(float).eps ** (1.0 / 3.0))


def test_steps_end_where_the_entry_has_moved_to() -> None:
    steps = []

    def function(x: np.ndarray) -> np.ndarray:
        steps.append(abs(float(x[0])))
        return np.array([1.0])

    central_slopes(function, np.zeros(1), np.array([2.0]), np.ones(1))
    assert 0.001 < max(steps) <= 2.0
    steps.clear()
    central_slopes(function, np.array([0.0, 3.0]), np.zeros(2), np.ones(1))
    assert 3e6 < max(steps) <= 3.1e9


def test_a_function_that_refuses_a_step_has_no_slope_there() -> None:
    def refusing(x: np.ndarray) -> np.ndarray:
        if x[0] != 2.0:
            raise ValueError("only here")
        return np.array([x[1]])

    for broken in (refusing, lambda x: np.array([np.nan if x[0] != 2.0 else x[1]])):
        found = central_slopes(broken, np.array([2.0, 1.0]), np.ones(2), np.ones(1))
        np.testing.assert_allclose(found, [[0.0, 1.0]], atol=1e-9)


def test_one_value_that_is_no_number_makes_the_step_none() -> None:
    found = central_slopes(
        lambda x: np.array([x[0], np.nan if abs(x[0] - 2.0) > 0.0 else 1.0]), np.array([2.0]), np.ones(1), np.ones(2)
    )
    np.testing.assert_array_equal(found, [[0.0], [0.0]])


@pytest.mark.parametrize("size", [1e-9, 1.0, 1e9])
def test_how_large_a_value_is_says_what_an_answer_is(size: float) -> None:
    """The same steps, whatever the unit of the value."""
    steps: list[float] = []

    def function(x: np.ndarray) -> np.ndarray:
        steps.append(abs(float(x[0])))
        return size * np.array([1.0 + x[0]])

    found = central_slopes(function, np.zeros(1), np.zeros(1), np.array([size]))
    np.testing.assert_allclose(found, [[size]], rtol=1e-5)
    assert steps[-1] == pytest.approx(1e-9)


def test_far_from_the_origin_the_step_grows_with_the_rounding() -> None:
    steps: list[float] = []

    def function(x: np.ndarray) -> np.ndarray:
        steps.append(abs(float(x[0]) - 1e6))
        return np.array([x[0] - 1e6])

    central_slopes(function, np.array([1e6]), np.ones(1), np.ones(1))
    assert steps[0] == pytest.approx(np.cbrt(np.finfo(float).eps * 1e6), rel=1e-3)
