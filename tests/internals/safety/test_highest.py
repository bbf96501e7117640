"""The solver behind the max-min program of the least-violation action: its workspaces, and when it is believed."""

from __future__ import annotations

from math import nan
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.safety.test_highest import least, reference

from safedpa.safety.highest import HighestProgram, highest_vertex


def test_a_workspace_forgets_the_problem_before_and_padding_rows_say_nothing() -> None:
    random, used = np.random.default_rng(3), HighestProgram(2)
    for rows in (8, 5, 7, 1, 6, 2, 3, 4, 5):
        slopes, heights, levels = random.normal(size=(rows, 2)), 5.0 + random.normal(size=rows), np.full(rows, np.nan)
        one, other = (program._by_solver(slopes, heights, levels) for program in (used, HighestProgram(2)))
        assert one is not None
        assert other is not None
        np.testing.assert_allclose(one, other, atol=1e-6)
        assert least(slopes, heights, levels, np.array(one)) == pytest.approx(
            reference(slopes, heights, levels), abs=1e-7
        )


def test_one_workspace_for_each_power_of_two() -> None:
    """Asked where several actions are as high."""
    program: Any = HighestProgram(1)
    for rows in range(1, 10):
        assert program.solve(np.zeros((rows, 1)), np.zeros(rows), np.full(rows, np.nan)) == pytest.approx([0.5])
    assert sorted(program._workspaces) == [1, 2, 4, 8, 16]


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_a_solver_that_says_solved_and_has_no_numbers_is_not_believed(number: float) -> None:
    program: Any = HighestProgram(2)
    slopes, free = np.array([[1.0, 0.0]]), np.full(1, np.nan)  # the second action is for the solver to choose
    program.solve(slopes, np.zeros(1), free)
    workspace = program._workspaces[1]

    class Solved:
        class result:  # noqa: N801 - as piqp has it
            x = np.array([0.5, number, 0.0])

        def update(self, **_: Any) -> None: ...

        def solve(self) -> Any:
            return workspace._solved

    workspace._solver = Solved()
    found = program.solve(slopes, np.zeros(1), free)
    assert found is None or np.isfinite(found).all()


@settings(max_examples=200, deadline=None)
@given(
    rows=st.lists(
        st.tuples(*[st.integers(-4, 4).map(lambda number: number / 4)] * 3, st.booleans()), min_size=1, max_size=8
    )
)
def test_nothing_is_as_high_and_nearer_to_the_middle(
    rows: list[tuple[float, float, float, bool]],
) -> None:
    """Slopes of few sizes: parallel rows, the same row twice, rows of zeros, several optima."""
    table = np.array([row[:3] for row in rows])
    slopes, heights = table[:, :2], table[:, 2]
    levels = np.array([nan if index == 0 or free else height - 0.3 for index, (*_, height, free) in enumerate(rows)])
    found = highest_vertex(slopes.tolist(), heights.tolist(), levels.tolist())
    if found is None:
        return
    best = reference(slopes, heights, levels)
    assert best is not None
    assert least(slopes, heights, levels, np.array(found)) == pytest.approx(best, abs=1e-9)
    by_solver = HighestProgram(2)._by_solver(slopes.tolist(), heights.tolist(), levels.tolist())
    assert by_solver is not None
    away = (np.linalg.norm(np.array(each) - 0.5) for each in (found, by_solver))
    assert next(away) <= next(away) + 1e-4
