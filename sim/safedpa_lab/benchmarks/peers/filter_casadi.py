"""IPOPT through casadi as the authors of SafeDPA's code had it: built again every step, nearest obstacle, no status."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np

from safedpa_lab.benchmarks.peers.problem import Problem, answered, compared

_QUIET = {"print_time": False, "error_on_fail": False}


def main() -> None:
    """Answers with IPOPT."""
    answered(_compare)


def _compare(problem: Problem) -> dict[str, Any]:
    casadi: Any = importlib.import_module("casadi")

    def decide(state: Any, nominal: Any) -> Any:
        h, p = problem.gradient(state)
        nearest = int(np.argmin(h))
        program = casadi.Opti()
        action = program.variable(2)
        change = action - nominal
        program.minimize(problem.weights[0] * change[0] ** 2 + problem.weights[1] * change[1] ** 2)
        moved = problem.f(state) + casadi.mtimes(casadi.DM(problem.g(state)), action)
        gain = problem.period * casadi.dot(p[nearest], moved)
        program.subject_to(gain >= -problem.eta * h[nearest] + problem.epsilon)
        program.subject_to(program.bounded(problem.low, action, problem.high))
        program.solver("ipopt", _QUIET, {"print_level": 0, "sb": "yes"})
        program.solve_limited()
        return np.asarray(program.debug.value(action)).ravel()

    return compared(problem, decide, version=casadi.__version__)
