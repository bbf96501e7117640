"""The solvers behind the filter's programs: their workspaces, and when they are believed."""

from math import nan
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.safety.test_highest import least, reference

from safedpa.safety import QuadraticProgram, Solution
from safedpa.safety.solver.maximin_lp import MaxMinProgram, solve_by_dual_simplex
from safedpa.safety.solver.qp_scaling import solve_hard, solve_soft, violable_rows


def test_a_workspace_forgets_the_problem_before_and_padding_rows_say_nothing() -> None:
    random, used = np.random.default_rng(3), MaxMinProgram(2)
    for rows in (8, 5, 7, 1, 6, 2, 3, 4, 5):
        slopes, heights, levels = random.normal(size=(rows, 2)), 5.0 + random.normal(size=rows), np.full(rows, np.nan)
        one, other = (program._by_solver(slopes, heights, levels) for program in (used, MaxMinProgram(2)))
        assert one is not None
        assert other is not None
        np.testing.assert_allclose(one, other, atol=1e-6)
        assert least(slopes, heights, levels, np.array(one)) == pytest.approx(
            reference(slopes, heights, levels), abs=1e-7
        )


def test_one_workspace_of_the_linear_program_for_each_power_of_two() -> None:
    """Asked where several actions are as high."""
    program: Any = MaxMinProgram(3)
    for rows in range(1, 10):
        assert program.solve(np.zeros((rows, 3)), np.zeros(rows), np.full(rows, np.nan)) == pytest.approx([0.5] * 3)
    assert sorted(program._workspaces) == [1, 2, 4, 8, 16]


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_a_solver_that_says_solved_and_has_no_numbers_is_not_believed(number: float) -> None:
    program: Any = MaxMinProgram(3)
    slopes, free = np.array([[1.0, 0.0, 0.0]]), np.full(1, np.nan)  # the other actions are for the solver to choose
    program.solve(slopes, np.zeros(1), free)
    workspace = program._workspaces[1]

    class Solved:
        class result:  # noqa: N801 - as piqp has it
            x = np.array([0.5, number, 0.0, 0.0])

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
def test_nothing_is_as_high_and_nearer_to_the_middle(rows: list[tuple[float, float, float, bool]]) -> None:
    """Slopes of few sizes: parallel rows, the same row twice, rows of zeros, several optima."""
    table = np.array([row[:3] for row in rows])
    slopes, heights = table[:, :2], table[:, 2]
    levels = np.array([nan if index == 0 or free else height - 0.3 for index, (*_, height, free) in enumerate(rows)])
    found = solve_by_dual_simplex(slopes.tolist(), heights.tolist(), levels.tolist())
    if found is None:
        return
    best = reference(slopes, heights, levels)
    assert best is not None
    assert least(slopes, heights, levels, np.array(found)) == pytest.approx(best, abs=1e-9)
    by_solver = MaxMinProgram(2)._by_solver(slopes.tolist(), heights.tolist(), levels.tolist())
    assert by_solver is not None
    away = (np.linalg.norm(np.array(each) - 0.5) for each in (found, by_solver))
    assert next(away) <= next(away) + 1e-4


numbers = st.integers(-200, 200).map(lambda number: number / 100)
"""Slopes of 1e-7 are beyond what PIQP can tell."""


def by_solver(program: QuadraticProgram, A: np.ndarray, b: np.ndarray, nominal: np.ndarray) -> Solution:
    """The solution of PIQP, which one or two actions are asked for only where nothing else is certain."""
    return program._by_solver(violable_rows(A.tolist(), b.tolist(), program.sides)[1], nominal.tolist(), len(b))


def test_a_workspace_forgets_the_problem_before() -> None:
    """Sizes share workspaces: neither rows nor the nominal action of an earlier problem may linger."""
    random = np.random.default_rng(2)
    program = QuadraticProgram(np.full(2, -1.0), np.full(2, 1.0), np.ones(2))
    for rows in (8, 5, 7, 1, 6, 2, 3, 4, 5):
        A, nominal = random.normal(size=(rows, 2)), random.normal(size=2)
        b = A @ random.uniform(-1, 1, 2) + 0.2
        fresh = QuadraticProgram(np.full(2, -1.0), np.full(2, 1.0), np.ones(2))
        one, other = (by_solver(each, A, b, nominal).action for each in (program, fresh))
        np.testing.assert_allclose(one, other, atol=1e-7)


def test_one_workspace_for_each_power_of_two() -> None:
    program = QuadraticProgram(np.full(1, -1.0), np.full(1, 1.0), np.ones(1))
    for rows in range(1, 10):
        by_solver(program, np.full((rows, 1), 1.0), np.full(rows, 1.5), np.zeros(1))
    assert sorted(program._workspaces) == [(size, 1e-11) for size in (1, 2, 4, 8, 16)]


def gives_up(program: QuadraticProgram, accuracy: float) -> None:
    program._workspace(1, accuracy)._solver.settings.max_iter = 1


def test_a_solver_that_gives_up_is_replaced_by_a_less_exacting_one_and_two_are_not_believed() -> None:
    program = QuadraticProgram(np.full(1, -1.0), np.full(1, 1.0), np.ones(1))
    gives_up(program, 1e-11)
    solution = by_solver(program, np.array([[1.0]]), np.array([1.5]), np.zeros(1))
    assert (solution.solved, solution.status) == (True, "solved")
    assert solution.action[0] == pytest.approx(1.0, abs=1e-6)
    assert solution.slack[0] == pytest.approx(0.5, abs=1e-6)
    program = QuadraticProgram(np.full(1, -1.0), np.full(1, 1.0), np.ones(1))
    gives_up(program, 1e-11)
    gives_up(program, 1e-8)
    solution = by_solver(program, np.array([[1.0]]), np.array([1.5]), np.zeros(1))
    assert (solution.solved, solution.status) == (False, "max iter reached")


@settings(max_examples=300, deadline=None)
@given(
    conditions=st.lists(st.tuples(numbers, numbers, numbers), min_size=1, max_size=10),
    nominal=st.tuples(numbers, numbers),
    weights=st.tuples(st.floats(0.1, 3.0), st.floats(0.1, 3.0)),
)
def test_what_it_gives_is_what_piqp_gives(conditions, nominal, weights):
    program = QuadraticProgram(np.full(2, -1.0), np.full(2, 1.5), np.array(weights))
    table = np.array(conditions)
    quick = program.solve(table[:, :2].tolist(), table[:, 2].tolist(), nominal)
    finite, rows = violable_rows(table[:, :2].tolist(), table[:, 2].tolist(), program.sides)
    assert finite
    closed = solve_hard(rows, nominal, program.sides, program.weights.tolist()) if rows else None
    if closed is None:
        return  # no row can be broken, or slack is needed
    certain = program._by_solver(rows, nominal, len(table))
    np.testing.assert_array_equal(quick.action, closed)
    assert max(quick.slack) == 0.0
    if certain.solved and max(certain.slack) < 1e-9:
        np.testing.assert_allclose(closed, certain.action, atol=2e-5)  # its gap of 1e-11 leaves a square root
        assert program.distance(closed, nominal) <= program.distance(certain.action, nominal) + 1e-9
    kept = [index for _, _, index, _ in rows]
    assert (table[kept, :2] @ closed >= table[kept, 2] - 1e-10).all()
    assert (np.array(closed) >= program.low - 1e-11).all()
    assert (np.array(closed) <= program.high + 1e-11).all()


@pytest.mark.parametrize("actions", [1, 2])
def test_the_closed_form_gives_what_piqp_gives_with_slack_row_by_row(actions: int) -> None:
    random, reported = np.random.default_rng(actions), 0
    for _ in range(200):
        low = -random.uniform(0.2, 3.0, actions)
        high = low + random.uniform(0.5, 5.0, actions)
        program = QuadraticProgram(low, high, random.uniform(0.3, 3.0, actions))
        A = random.normal(size=(int(random.integers(2, 8)), actions))
        b, nominal = A @ random.uniform(low, high) + random.normal(0.2, 0.5, len(A)), random.uniform(low, high)
        _, rows = violable_rows(A.tolist(), b.tolist(), program.sides)
        slack = [0.0] * len(b)
        weights = program.weights.tolist()
        action = solve_soft(rows, nominal.tolist(), program.sides, weights, slack) if rows else None
        if action is None:
            continue
        reported += 1
        by_solver = program._by_solver(rows, nominal.tolist(), len(b))
        reach = np.abs(A) @ program.range
        np.testing.assert_allclose(action, by_solver.action, atol=2e-5)
        np.testing.assert_allclose(slack / reach, np.array(by_solver.slack) / reach, atol=1e-6)
    assert reported > 150
