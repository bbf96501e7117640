"""The attacks' reference is itself held against a second one, and against problems solved by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import quadprog

from safedpa_lab.experiments.adversary.linear_judge import LinearJudge
from safedpa_lab.experiments.adversary.linear_problem import LinearProblem
from safedpa_lab.experiments.adversary.linear_shapes import SHAPES, random_problem


def one_action(now: float, drift: float, epsilon: float = 0.0, wish: float = 1.0) -> LinearProblem:
    """h = x, x+ = now + drift - a, a in 0 to 1, eta 0.5: kept by a <= now / 2 + drift - epsilon."""
    return LinearProblem(
        shape="by hand",
        state=np.array([now]),
        f=np.array([now + drift]),
        g=np.array([[-1.0]]),
        P=np.eye(1),
        q=np.zeros(1),
        low=np.zeros(1),
        high=np.ones(1),
        wish=np.array([wish]),
        weights=np.ones(1),
        eta=0.5,
        epsilon=np.array([epsilon]),
        gradient=True,
    )


def test_the_nearest_action_just_keeps_the_condition():
    found = LinearJudge(one_action(1.0, -0.2, 0.1)).nearest()
    assert found is not None
    assert found.action[0] == pytest.approx(0.2)
    assert found.distance == pytest.approx(0.8)


def test_an_infeasible_problem_has_no_nearest_action_but_a_least_unsafe_one():
    judge = LinearJudge(one_action(0.5, -2.0))
    assert judge.nearest() is None
    best, action = judge.best_least_height()
    assert action[0] == pytest.approx(0.0)
    assert best == pytest.approx(-1.5 / 1.0)  # the scale is what the action can change: 1
    assert judge.best_least_residual()[0] == pytest.approx(-1.75)


def test_a_scale_is_the_largest_of_h_margin_and_reach():
    assert LinearJudge(one_action(3.0, 0.0)).scale[0] == 3.0
    assert LinearJudge(one_action(0.3, 0.0)).scale[0] == 1.0
    assert LinearJudge(one_action(0.3, 0.0, epsilon=7.0)).scale[0] == 7.0


def test_a_break_is_measured_in_scales_without_rounding():
    judge = LinearJudge(one_action(1.0, 0.0))
    assert judge.broken(np.array([0.5])) == 0.0
    assert judge.broken(np.array([0.5 + 1e-17])) == 0.0
    assert judge.broken(np.array([0.75])) == pytest.approx(0.25)


def by_quadprog(problem: LinearProblem) -> float | None:
    """Distance of the optimum; None where quadprog says that there is none."""
    judge, actions = LinearJudge(problem), len(problem.low)
    width = problem.high - problem.low
    slope = (problem.P @ problem.g) * width / judge.scale[:, None]
    limit = (judge.required - problem.heights(problem.after(problem.low))) / judge.scale
    wish = (problem.wish - problem.low) / width
    rows = np.vstack([slope, np.eye(actions), -np.eye(actions)])
    limits = np.concatenate([limit, np.zeros(actions), -np.ones(actions)])
    hessian = np.diag(2.0 * problem.weights)
    try:
        found = quadprog.solve_qp(hessian, hessian @ wish, rows.T.copy(), limits)[0]
    except ValueError:
        return None
    return float(np.sqrt((problem.weights / problem.weights.max() * (found - wish) ** 2).sum()))


@pytest.mark.parametrize("first", range(0, 1100, 275))
def test_two_references_agree_on_random_problems(first):
    compared = 0
    for number in range(first, first + 275):
        problem = random_problem(5, number)
        if problem.shape in ("costly", "feeble", "parallel"):
            continue  # where quadprog's own tolerance decides
        own, other = LinearJudge(problem).nearest(), by_quadprog(problem)
        room = LinearJudge(problem).best_least_residual()[0]
        if room > 1e-6:
            assert own is not None
            assert other is not None
            assert own.distance == pytest.approx(other, abs=1e-6)
            compared += 1
        elif room < -1e-6:
            assert own is None
    assert compared > 50


def test_no_random_action_is_better_than_what_the_linear_program_attains():
    random = np.random.default_rng(3)
    for number in range(110):
        problem = random_problem(6, number)
        judge = LinearJudge(problem)
        best = judge.best_least_height()[0]
        room = judge.best_least_residual()[0]
        for action in random.uniform(problem.low, problem.high, (50, len(problem.low))):
            assert judge.heights(action).min() <= best + 1e-7
            assert judge.residuals(action).min() <= room + 1e-7


def test_other_units_change_nothing_that_the_reference_says():
    random = np.random.default_rng(4)
    for number in range(len(SHAPES) * 4):
        problem = replace(random_problem(7, number), witness=None)
        rows, states, actions = len(problem.q), len(problem.f), len(problem.low)
        other = problem.scaled(*(10.0 ** random.uniform(-3, 3, count) for count in (rows, states, actions)))
        assert LinearJudge(other).best_least_height()[0] == pytest.approx(
            LinearJudge(problem).best_least_height()[0], abs=1e-4
        )


def test_a_witness_keeps_what_it_is_a_witness_of():
    found = [p for p in (random_problem(8, number) for number in range(2200)) if p.witness is not None]
    assert len(found) > 20
    for problem in found:
        assert LinearJudge(problem).broken(problem.witness) == 0.0
