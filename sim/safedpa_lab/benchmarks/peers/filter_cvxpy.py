"""cvxpy: the program stated once with parameters, solved by OSQP or Clarabel for every decision."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np

from safedpa_lab.benchmarks.peers.problem import Problem, answered, compared


def main() -> None:
    """Answers about the solver named in the question."""
    answered(_compare)


def _compare(problem: Problem) -> dict[str, Any]:
    cp: Any = importlib.import_module("cvxpy")
    rows = len(problem.obstacles)
    action, slack = cp.Variable(2), cp.Variable(rows)
    A, b, nominal = cp.Parameter((rows, 2)), cp.Parameter(rows), cp.Parameter(2)
    cost = cp.sum_squares(cp.multiply(np.sqrt(problem.weights), action - nominal)) + problem.penalty * cp.sum(slack)
    retained = [A @ action + slack >= b, action >= problem.low, action <= problem.high, slack >= 0]
    program, solver = cp.Problem(cp.Minimize(cost), retained), problem.question["backend"]

    def decide(state: Any, wanted: Any) -> Any:
        A.value, b.value = problem.conditions(state)
        nominal.value = wanted
        program.solve(solver=solver, warm_start=True)
        return action.value

    return compared(problem, decide, version=cp.__version__)
