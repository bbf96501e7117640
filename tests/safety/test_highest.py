"""The linear program behind the least unsafe action, beside scipy's."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import linprog

from safedpa.safety.highest import HighestProgram

Values = NDArray[np.float64]


def reference(slopes: Values, heights: Values, levels: Values) -> float | None:
    """The largest attainable t; None where the levels cannot be held."""
    free = np.isnan(levels)
    actions = slopes.shape[1]
    A = np.hstack([-slopes, np.where(free, 1.0, 0.0)[:, np.newaxis]])
    b = heights - np.where(free, 0.0, levels)
    bounds = [*[(0.0, 1.0)] * actions, (None, None)]
    found = linprog([*[0.0] * actions, -1.0], A_ub=A, b_ub=b, bounds=bounds)
    return None if found.status != 0 else float(found.x[-1])


def least(slopes: Values, heights: Values, levels: Values, u: Values) -> float:
    return float((heights + slopes @ u)[np.isnan(levels)].min())


@pytest.mark.parametrize("actions", [1, 2, 3, 4])
def test_the_least_is_as_high_as_scipy_can_make_it(actions: int) -> None:
    random, program, held = np.random.default_rng(actions), HighestProgram(actions), 0
    for _ in range(200):
        rows = int(random.integers(1, 12))
        slopes, heights = random.normal(size=(rows, actions)), random.normal(size=rows)
        levels = np.full(rows, np.nan)
        if rows > 1:
            inside = heights + slopes @ random.uniform(0.0, 1.0, actions)
            some = random.random(rows) < 0.4
            some[0] = False
            levels[some] = inside[some] - random.uniform(0.0, 0.2, rows)[some]
        found = program.solve(slopes, heights, levels)
        assert found is not None
        u = np.array(found)
        assert (u >= 0.0).all()
        assert (u <= 1.0).all()
        best = reference(slopes, heights, levels)
        assert best is not None
        assert least(slopes, heights, levels, u) == pytest.approx(best, abs=1e-7)
        held += int((~np.isnan(levels)).sum())
        assert ((heights + slopes @ u >= levels - 1e-7) | np.isnan(levels)).all()
    assert held > 100


def test_levels_that_no_action_holds_have_no_answer() -> None:
    program = HighestProgram(1)
    assert program.solve(np.array([[1.0], [1.0]]), np.zeros(2), np.array([np.nan, 1.5])) is None
    assert program.solve(np.array([[1.0], [-1.0]]), np.zeros(2), np.array([0.75, -0.25])) is None
    found = program.solve(np.array([[1.0], [-1.0], [1.0]]), np.zeros(3), np.array([0.25, -0.75, np.nan]))
    assert found == pytest.approx([0.75], abs=1e-7)


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_numbers_that_are_none_have_no_answer(number: float) -> None:
    program = HighestProgram(2)
    for place in range(2):
        slopes = np.array([[1.0, 0.5], [0.0, 1.0]])
        slopes[0, place] = number
        assert program.solve(slopes.tolist(), [0.0] * 2, [np.nan] * 2) is None


def test_of_several_optima_the_one_in_the_middle_is_taken() -> None:
    """The second action changes nothing: it is not thrown about."""
    found = HighestProgram(2).solve(np.array([[1.0, 0.0]]), np.zeros(1), np.full(1, np.nan))
    assert found == pytest.approx([1.0, 0.5], abs=1e-3)


def test_the_answer_is_its_callers_own() -> None:
    program = HighestProgram(1)
    first = program.solve(np.array([[1.0]]), np.zeros(1), np.full(1, np.nan))
    assert first is not None
    program.solve(np.array([[-1.0]]), np.zeros(1), np.full(1, np.nan))
    assert first == pytest.approx([1.0], abs=1e-7)
