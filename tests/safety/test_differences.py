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


def test_a_function_that_refuses_a_step_has_no_slope_there() -> None:
    def refusing(x: np.ndarray) -> np.ndarray:
        if x[0] != 2.0:
            raise ValueError("only here")
        return np.array([x[1]])

    for broken in (refusing, lambda x: np.array([np.nan if x[0] != 2.0 else x[1]])):
        found = central_slopes(broken, np.array([2.0, 1.0]), np.ones(2), np.ones(1))
        np.testing.assert_allclose(found, [[0.0, 1.0]], atol=1e-9)
