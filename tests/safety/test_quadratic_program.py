"""The filter's program, anyone who solves it, against quadprog and against the optimality conditions."""

from typing import Any

import numpy as np
import pytest
import quadprog

from safedpa.safety import QuadraticProgram, Solution
from safedpa.safety.solver.active_set_2d import LINEAR_PRICE, QUADRATIC_PRICE


def reaches(program: QuadraticProgram, A: np.ndarray) -> np.ndarray:
    """(m,) what the actions can change in each condition."""
    return np.asarray(np.abs(A) @ program.range)


def reference(program: QuadraticProgram, A: np.ndarray, b: np.ndarray, nominal: np.ndarray) -> np.ndarray:
    """(a, s) by quadprog, in the unscaled actions and with every row: min x'Gx/2 - c'x, C'x >= d; s in shares of reach.

    A limit beyond what any action reaches by more than the reach counts as one by just that.
    """
    rows, actions = A.shape
    reach = reaches(program, A)
    limit = np.minimum(b / reach, A @ program.low / reach + 2.0)
    weights = program.weights / program.range**2
    G = np.diag(2.0 * np.concatenate([weights, np.full(rows, QUADRATIC_PRICE)]))
    c = np.concatenate([2.0 * weights * nominal, np.full(rows, -LINEAR_PRICE)])
    eye = np.eye(actions + rows)
    C = np.vstack([np.hstack([A / reach[:, np.newaxis], np.eye(rows)]), eye[:actions], -eye[:actions], eye[actions:]])
    d = np.concatenate([limit, program.low, -program.high, np.zeros(rows)])
    return quadprog.solve_qp(G, c, C.T, d)[0]


def problem(random: np.random.Generator) -> tuple[QuadraticProgram, np.ndarray, np.ndarray, np.ndarray]:
    actions, rows = int(random.integers(1, 4)), int(random.integers(1, 14))
    low = -random.uniform(0.2, 3.0, actions)
    program = QuadraticProgram(low, low + random.uniform(0.5, 5.0, actions), random.uniform(0.3, 3.0, actions))
    A = random.normal(0.0, 0.3, (rows, actions)) * random.uniform(0.1, 1.0, (rows, 1))
    b = A @ random.uniform(program.low, program.high) + random.normal(0.0, 0.1, rows)
    return program, A, b, random.uniform(program.low - 1.0, program.high + 1.0)


def solved(program: QuadraticProgram, A: np.ndarray, b: np.ndarray, nominal: np.ndarray) -> Solution:
    found = program.solve(A.tolist(), b.tolist(), nominal.tolist())
    return Solution(np.array(found.action), np.array(found.slack), found.solved, found.status)


def objective(program: QuadraticProgram, A: np.ndarray, action: np.ndarray, slack: np.ndarray, nominal: Any) -> float:
    shares = slack / reaches(program, A)
    return (
        program.distance(action, nominal)
        + QUADRATIC_PRICE * float(shares @ shares)
        + LINEAR_PRICE * float(shares.sum())
    )


def test_agrees_with_quadprog_on_thousands_of_random_problems() -> None:
    random, relaxed = np.random.default_rng(0), 0
    for _ in range(1500):
        program, A, b, nominal = problem(random)
        solution = solved(program, A, b, nominal)
        assert solution.solved
        expected, actions, reach = reference(program, A, b, nominal), len(program.low), reaches(program, A)
        shares = expected[actions:]
        np.testing.assert_allclose(solution.action, expected[:actions], atol=2e-5 if shares.max() > 1e-6 else 1e-6)
        np.testing.assert_allclose(solution.slack / reach, shares, atol=1e-6)
        best = objective(program, A, expected[:actions], shares * reach, nominal)
        assert objective(program, A, solution.action, solution.slack, nominal) == pytest.approx(
            best, rel=1e-6, abs=1e-6
        )
        relaxed += shares.max() > 1e-6
    assert 150 < relaxed < 1350  # both kinds of problems were there


@pytest.mark.parametrize("actions", [1, 2, 3])
def test_no_unit_of_a_row_or_an_action_matters(actions: int) -> None:
    """The same problem with every row in another unit, and with every action in another one."""
    random = np.random.default_rng(actions)
    for _ in range(100):
        rows = int(random.integers(1, 8))
        low = -random.uniform(0.2, 3.0, actions)
        high, weights = low + random.uniform(0.5, 5.0, actions), random.uniform(0.3, 3.0, actions)
        A, nominal = random.normal(size=(rows, actions)), random.uniform(low - 1.0, high + 1.0)
        b = A @ random.uniform(low, high) + random.normal(0.0, 0.3, rows)
        units, scales = 10.0 ** random.uniform(-12, 12, rows), 10.0 ** random.uniform(-6, 6, actions)
        one = solved(QuadraticProgram(low, high, weights), A, b, nominal)
        scaled = QuadraticProgram(low * scales, high * scales, 7.0 * weights)
        other = solved(scaled, A * units[:, np.newaxis] / scales, b * units, nominal * scales)
        assert one.solved == other.solved
        np.testing.assert_allclose(other.action / scales, one.action, atol=2e-5)
        np.testing.assert_allclose(other.slack / units, one.slack, atol=1e-6 * np.abs(A).sum() * 5.0)


def test_rows_that_no_action_can_break_need_no_solver() -> None:
    program = QuadraticProgram(np.array([-1.0, -2.0]), np.array([1.0, 2.0]), np.ones(2))
    solution = solved(program, np.array([[1.0, 1.0]]), np.array([-3.0]), np.array([5.0, -0.5]))
    assert (solution.solved, solution.status) == (True, "not needed")
    np.testing.assert_array_equal(solution.action, [1.0, -0.5])
    np.testing.assert_array_equal(solution.slack, [0.0])
    needed = solved(program, np.array([[1.0, 1.0]]), np.array([-2.9]), np.array([-5.0, -5.0]))
    assert needed.status == "solved"
    assert needed.action.sum() == pytest.approx(-2.9, abs=1e-7)


def test_a_corner_is_the_minimiser_to_the_last_bit_and_only_where_quadprog_says_so() -> None:
    """Two actions, limits out of reach among the rows: the solver alone would end a billionth next to the corner."""
    random, corners, others = np.random.default_rng(3), 0, 0
    for _ in range(400):
        low = -random.uniform(0.2, 3.0, 2)
        program = QuadraticProgram(low, low + random.uniform(0.5, 5.0, 2), random.uniform(0.3, 3.0, 2))
        rows = int(random.integers(1, 4))
        A, nominal = random.normal(size=(rows, 2)), random.uniform(program.low - 1.0, program.high + 1.0)
        middle = A @ (program.low + 0.5 * program.range)
        b = middle + random.uniform(-0.2, 1.2, rows) * reaches(program, A)
        b[0] = middle[0] + random.uniform(0.51, 1.2) * reaches(program, A)[0]
        solution, expected = solved(program, A, b, nominal), reference(program, A, b, nominal)
        np.testing.assert_allclose(solution.action, expected[:2], atol=2e-5)
        np.testing.assert_allclose(solution.slack / reaches(program, A), expected[2:], atol=1e-6)
        at_end = np.minimum(expected[:2] - program.low, program.high - expected[:2]) / program.range
        exact = ((solution.action == program.low) | (solution.action == program.high)).all()
        corners += bool(exact)
        others += bool(at_end.max() > 1e-3)
        assert exact == bool(at_end.max() < 1e-7)
    assert corners > 100
    assert others > 50


@pytest.mark.parametrize("place", [0, 1])
def test_a_bound_is_met_to_the_last_bit_where_range_and_lowest_do_not_add_up_to_it(place: int) -> None:
    low, high, slopes, nominal = np.array([-3.0, -3.0]), np.array([0.1, 0.1]), np.zeros(2), np.array([-1.0, -1.0])
    assert low[0] + (high[0] - low[0]) != high[0]
    slopes[place] = 1.0
    solution = solved(QuadraticProgram(low, high, np.ones(2)), slopes[np.newaxis], np.array([0.5]), nominal)
    assert solution.action[place] == 0.1
    assert solution.action[1 - place] == pytest.approx(-1.0, abs=1e-12)


def test_how_far_a_limit_lies_beyond_all_actions_does_not_matter() -> None:
    """Else a hopeless row would outweigh all others: 3 is the most of interest, 2 reaches above the lowest value."""
    program = QuadraticProgram(np.full(1, -1.0), np.full(1, 1.0), np.ones(1))
    near, far = (
        solved(program, np.array([[1.0], [-1.0]]), np.array([limit, 0.0]), np.zeros(1)) for limit in (3.0, 3e9)
    )
    np.testing.assert_allclose(far.action, near.action, atol=1e-9)
    nearer = solved(program, np.array([[1.0], [-1.0]]), np.array([1.5, 0.0]), np.zeros(1))
    assert nearer.action[0] == pytest.approx(0.75, abs=1e-4)
    assert near.action[0] == pytest.approx(1.0, abs=1e-6)


def test_a_row_that_no_action_changes_is_left_out() -> None:
    program = QuadraticProgram(np.full(2, -1.0), np.full(2, 1.0), np.ones(2))
    solution = solved(program, np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([5.0, 0.5]), np.zeros(2))
    assert (solution.solved, solution.status) == (True, "solved")
    np.testing.assert_allclose(solution.action, [0.5, 0.0])
    np.testing.assert_array_equal(solution.slack, [0.0, 0.0])
    tiny = solved(program, np.array([[5e-324, 0.0], [1.0, 0.0]]), np.array([5.0, 0.5]), np.zeros(2))
    np.testing.assert_allclose(tiny.action, [0.5, 0.0])
    alone = solved(program, np.array([[0.0, 0.0]]), np.array([5.0]), np.array([2.0, 0.1]))
    assert alone.status == "not needed"
    np.testing.assert_array_equal(alone.action, [1.0, 0.1])


def test_slack_goes_to_the_row_that_it_belongs_to() -> None:
    """Rows that are left out stand between; the slack has each row's own unit."""
    program = QuadraticProgram(np.full(1, -1.0), np.full(1, 1.0), np.ones(1))
    A, b = np.array([[1.0], [0.0], [1.0], [-50.0]]), np.array([-3.0, 4.0, 1.0, 0.0])
    solution = solved(program, A, b, np.zeros(1))
    assert solution.slack[[0, 1]].tolist() == [0.0, 0.0]
    np.testing.assert_allclose(A[2:] @ solution.action + solution.slack[2:], b[2:], atol=1e-6)
    assert solution.slack[3] == pytest.approx(50.0 * solution.slack[2], rel=1e-4)  # each gives up the same share


def test_distance_is_weighted_by_range_and_slopes_and_limits_have_to_fit() -> None:
    program = QuadraticProgram(np.full(2, -1.0), np.full(2, 1.0), np.ones(2))
    with pytest.raises(ValueError, match="the program has 1 rows and 2 limits"):
        program.solve([[1.0, 0.0]], [0.0, 0.0], [0.0, 0.0])
    with pytest.raises(ValueError, match="row 1 has 1 entries for 2 actions"):
        program.solve([[1.0, 0.0], [1.0]], [0.0, 0.0], [0.0, 0.0])
    program = QuadraticProgram(np.array([0.0, 0.0]), np.array([2.0, 4.0]), np.array([1.0, 4.0]))
    assert program.distance(np.array([1.0, 2.0]), np.array([0.0, 0.0])) == pytest.approx(0.25 / 4.0 + 0.25)
    assert program.distance(np.array([1.0, 2.0]), np.array([2.0, 3.0])) == pytest.approx(0.25 / 4.0 + 1.0 / 16.0)


def test_a_condition_that_is_no_number_is_never_left_out() -> None:
    program = QuadraticProgram(np.full(2, -1.0), np.full(2, 1.0), np.ones(2))
    for A, b in (([np.nan, 0.0], 0.5), ([1.0, 0.0], np.nan), ([np.inf, 0.0], 0.5), ([1.0, -np.inf], 0.5)):
        solution = solved(program, np.array([A, [0.0, 1.0]]), np.array([b, 0.1]), np.zeros(2))
        assert not (solution.solved and np.isfinite(solution.action).all())


@pytest.mark.parametrize("slopes", [(1e308, 0.0), (-1e308, 0.0), (0.0, 1e308), (8e307, -8e307)])
def test_a_row_that_reaches_further_than_numbers_do_is_not_reported_as_solved(slopes: tuple[float, float]) -> None:
    """Each slope is a number, and so is its limit; over ranges that are two wide the row is none."""
    program = QuadraticProgram(np.full(2, -1.0), np.full(2, 1.0), np.ones(2))
    solution = solved(program, np.array([slopes, [0.0, 1.0]]), np.array([0.5, 0.1]), np.zeros(2))
    assert (solution.solved, solution.status) == (False, "numbers not finite")
    assert solution.action.tolist() == [-1.0, -1.0]
    assert solution.slack.tolist() == [0.0, 0.0]


def test_numbers_that_are_none_are_not_reported_as_solved() -> None:
    program = QuadraticProgram(np.full(1, -1.0), np.full(1, 1.0), np.ones(1))
    solution = solved(program, np.array([[np.inf]]), np.array([0.5]), np.zeros(1))
    assert not (solution.solved and np.isfinite(solution.action).all())
