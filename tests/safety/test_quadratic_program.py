"""PIQP, in the filter's form, against quadprog and against the optimality conditions."""

from dataclasses import replace

import numpy as np
import pytest
import quadprog

from safedpa.safety import QuadraticProgram, Solution


def reference(
    program: QuadraticProgram, A: np.ndarray, b: np.ndarray, wish: np.ndarray, quadratic: float, linear: float
) -> np.ndarray:
    """(a, s) by quadprog, in the unscaled variables and with every row: min x'Gx/2 - c'x, C'x >= d."""
    rows, actions = A.shape
    weights = program.weights / (program.high - program.low) ** 2
    G = np.diag(2.0 * np.concatenate([weights, np.full(rows, quadratic)]))
    c = np.concatenate([2.0 * weights * wish, np.full(rows, -linear)])
    eye = np.eye(actions + rows)
    C = np.vstack([np.hstack([A, np.eye(rows)]), eye[:actions], -eye[:actions], eye[actions:]])
    d = np.concatenate([b, program.low, -program.high, np.zeros(rows)])
    return quadprog.solve_qp(G, c, C.T, d)[0]


def problem(random: np.random.Generator) -> tuple[QuadraticProgram, np.ndarray, np.ndarray, np.ndarray]:
    actions, rows = int(random.integers(1, 4)), int(random.integers(1, 14))
    low = -random.uniform(0.2, 3.0, actions)
    program = QuadraticProgram(
        low, low + random.uniform(0.5, 5.0, actions), random.uniform(0.3, 3.0, actions), 1e3, 1e2
    )
    A = random.normal(0.0, 0.3, (rows, actions)) * random.uniform(0.1, 1.0, (rows, 1))
    b = A @ random.uniform(program.low, program.high) + random.normal(0.0, 0.1, rows)
    return program, A, b, random.uniform(program.low - 1.0, program.high + 1.0)


def solved(program: QuadraticProgram, A: np.ndarray, b: np.ndarray, wish: np.ndarray) -> Solution:
    """The solution for arrays, in arrays."""
    found = program.solve(A.tolist(), b.tolist(), wish.tolist())
    return replace(found, action=np.array(found.action), slack=np.array(found.slack))


def objective(program: QuadraticProgram, action: np.ndarray, slack: np.ndarray, wish: np.ndarray) -> float:
    return program.distance(action, wish) + 1e3 * float(slack @ slack) + 1e2 * float(slack.sum())


def test_agrees_with_quadprog_on_thousands_of_random_problems() -> None:
    random, relaxed = np.random.default_rng(0), 0
    for _ in range(3000):
        program, A, b, wish = problem(random)
        solution = solved(program, A, b, wish)
        assert solution.solved
        expected = reference(program, A, b, wish, 1e3, 1e2)
        actions = len(program.low)
        np.testing.assert_allclose(solution.action, expected[:actions], atol=1e-6)
        np.testing.assert_allclose(solution.slack, expected[actions:], atol=1e-6)
        best = objective(program, expected[:actions], expected[actions:], wish)
        assert objective(program, solution.action, solution.slack, wish) == pytest.approx(best, rel=1e-6, abs=1e-6)
        relaxed += expected[actions:].max() > 1e-6
    assert 300 < relaxed < 2700  # both kinds of problems were there


def test_optimality_conditions_hold() -> None:
    """No admissible direction lowers the objective: first-order conditions without the solver's multipliers."""
    random = np.random.default_rng(1)
    for _ in range(300):
        program, A, b, wish = problem(random)
        solution = solved(program, A, b, wish)
        assert (A @ solution.action + solution.slack >= b - 1e-7).all()
        assert (solution.action >= program.low - 1e-8).all()
        assert (solution.action <= program.high + 1e-8).all()
        assert (solution.slack >= -1e-9).all()
        here = objective(program, solution.action, solution.slack, wish)
        for _ in range(20):
            other = np.clip(solution.action + random.normal(0, 0.05, len(wish)), program.low, program.high)
            slack = np.maximum(0.0, b - A @ other)
            assert objective(program, other, slack, wish) >= here - 1e-6


def test_rows_that_no_action_can_break_need_no_solver() -> None:
    program = QuadraticProgram(np.array([-1.0, -2.0]), np.array([1.0, 2.0]), np.ones(2), 1e3, 1e2)
    solution = solved(program, np.array([[1.0, 1.0]]), np.array([-3.0]), np.array([5.0, -0.5]))
    assert (solution.solved, solution.status) == (True, "not needed")
    np.testing.assert_array_equal(solution.action, [1.0, -0.5])
    np.testing.assert_array_equal(solution.slack, [0.0])
    needed = solved(program, np.array([[1.0, 1.0]]), np.array([-2.9]), np.array([-5.0, -5.0]))
    assert needed.status == "solved"
    assert needed.action.sum() == pytest.approx(-2.9, abs=1e-7)


def test_a_workspace_forgets_the_problem_before() -> None:
    """Sizes share workspaces: neither rows nor the wish of an earlier problem may linger."""
    random = np.random.default_rng(2)
    program = QuadraticProgram(np.full(2, -1.0), np.full(2, 1.0), np.ones(2), 1e3, 1e2)
    for rows in (8, 5, 7, 1, 6, 2, 3, 4, 5):
        A, wish = random.normal(size=(rows, 2)), random.normal(size=2)
        b = A @ random.uniform(-1, 1, 2) + 0.2
        fresh = QuadraticProgram(np.full(2, -1.0), np.full(2, 1.0), np.ones(2), 1e3, 1e2)
        np.testing.assert_allclose(solved(program, A, b, wish).action, solved(fresh, A, b, wish).action, atol=1e-7)


def test_one_workspace_for_each_power_of_two() -> None:
    program = QuadraticProgram(np.full(1, -1.0), np.full(1, 1.0), np.ones(1), 1e3, 1e2)
    for rows in range(1, 10):
        solved(program, np.full((rows, 1), 1.0), np.full(rows, 1.5), np.zeros(1))  # not without slack
    assert sorted(program._workspaces) == [1, 2, 4, 8, 16]


def test_infeasible_conditions_cost_slack_only() -> None:
    program = QuadraticProgram(np.full(1, -1.0), np.full(1, 1.0), np.ones(1), 1e3, 1e2)
    solution = solved(program, np.array([[1.0], [-1.0]]), np.array([3.0, 0.0]), np.zeros(1))
    assert solution.solved
    assert solution.slack.sum() == pytest.approx(3.0, abs=1e-6)


def test_distance_is_weighted_by_range() -> None:
    program = QuadraticProgram(np.array([0.0, 0.0]), np.array([2.0, 4.0]), np.array([1.0, 3.0]), 1e3, 1e2)
    assert program.distance(np.array([1.0, 2.0]), np.array([0.0, 0.0])) == pytest.approx(0.25 + 0.75)
    assert program.distance(np.array([1.0, 2.0]), np.array([2.0, 3.0])) == pytest.approx(0.25 + 3.0 / 16.0)


def test_a_condition_that_is_no_number_is_never_left_out() -> None:
    program = QuadraticProgram(np.full(2, -1.0), np.full(2, 1.0), np.ones(2), 1e3, 1e2)
    for A, b in (([np.nan, 0.0], 0.5), ([1.0, 0.0], np.nan), ([np.inf, 0.0], 0.5), ([1.0, -np.inf], 0.5)):
        solution = solved(program, np.array([A, [0.0, 1.0]]), np.array([b, 0.1]), np.zeros(2))
        assert not (solution.solved and np.isfinite(solution.action).all())


def test_numbers_that_are_none_are_not_reported_as_solved() -> None:
    program = QuadraticProgram(np.full(1, -1.0), np.full(1, 1.0), np.ones(1), 1e3, 1e2)
    solution = solved(program, np.array([[np.inf]]), np.array([0.5]), np.zeros(1))
    assert not (solution.solved and np.isfinite(solution.action).all())


def test_a_solver_that_gives_up_is_not_believed() -> None:
    program = QuadraticProgram(np.full(1, -1.0), np.full(1, 1.0), np.ones(1), 1e3, 1e2)
    program._workspace(1)._solver.settings.max_iter = 1
    solution = solved(program, np.array([[1.0]]), np.array([1.5]), np.zeros(1))
    assert (solution.solved, solution.status) == (False, "max iter reached")
