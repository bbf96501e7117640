"""run-time-assurance: its explicit active set invariance filter, one constraint module an obstacle."""

from __future__ import annotations

import importlib
import warnings
from collections import OrderedDict
from typing import Any

import numpy as np

from safedpa_lab.benchmarks.peers.problem import Problem, answered, compared


def main() -> None:
    """Answers with its quadprog filter."""
    warnings.simplefilter("ignore")  # it warns where it finds no solution, and hands the nominal action on
    answered(_compare)


def _compare(problem: Problem) -> dict[str, Any]:
    module = _module(problem)

    def decide(state: Any, nominal: Any) -> Any:
        return module.filter_control(state, problem.period, nominal)

    version = importlib.import_module("importlib.metadata").version("run-time-assurance")
    return compared(problem, decide, version=version)


def _constraint(problem: Problem, index: int) -> Any:
    constraint: Any = importlib.import_module("run_time_assurance.constraint")
    jnp: Any = importlib.import_module("jax.numpy")
    one = Problem({**problem.question, "obstacles": [problem.obstacles[index].tolist()]})

    class Obstacle(constraint.ConstraintModule):  # type: ignore[misc]
        def _compute(self, state: Any, params: Any) -> Any:
            return one.barrier(state, jnp)[0]

    rate = problem.eta / problem.period
    return Obstacle(alpha=constraint.PolynomialConstraintStrengthener([0.0, rate]))


def _module(problem: Problem) -> Any:
    rta: Any = importlib.import_module("run_time_assurance.rta")
    jnp: Any = importlib.import_module("jax.numpy")

    class Car(rta.ExplicitASIFModule):  # type: ignore[misc]
        def _setup_properties(self) -> None:
            """Nothing beyond the problem."""

        def _setup_constraints(self) -> Any:
            return OrderedDict((f"obstacle {i}", _constraint(problem, i)) for i in range(len(problem.obstacles)))

        def state_transition_system(self, state: Any) -> Any:
            return problem.f(state, jnp)

        def state_transition_input(self, state: Any) -> Any:
            return problem.g(state, jnp)

        def _pred_state(self, state: Any, step_size: float, control: Any) -> Any:
            return state + step_size * (problem.f(state, jnp) + problem.g(state, jnp) @ control)

    return Car(control_dim=2, control_bounds_low=np.array(problem.low), control_bounds_high=np.array(problem.high))
