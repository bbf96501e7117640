"""Other projects' filters on linear problems: run by path, in whichever Python has them; needs nothing of this project.

Standard input holds ``{"peer": name, "eta": eta, "problems": [...]}`` with state, f, g, P, q and nominal action
of each problem, all of the same shapes, actions between -1 and 1. For each the answer on standard output is the action
(null: none) and the message: a warning, an exception, a status; empty where there was none.
"""

from __future__ import annotations

import importlib
import json
import sys
import warnings
from collections import OrderedDict
from collections.abc import Callable, Mapping
from contextlib import redirect_stdout
from functools import partial
from typing import Any

import numpy as np

Problem = Mapping[str, Any]
Decide = Callable[[Problem], tuple[Any, str]]


def main() -> None:
    """Answers all problems of one question."""
    question = json.loads(sys.stdin.read())
    with redirect_stdout(sys.stderr):  # peers print advice
        decide = PEERS[question["peer"]](question["problems"][0], question["eta"])
        answers = [_answer(decide, problem) for problem in question["problems"]]
    sys.stdout.write("\n" + json.dumps(answers) + "\n")


def _answer(decide: Decide, problem: Problem) -> dict[str, Any]:
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        try:
            action, notice = decide({name: np.array(value) for name, value in problem.items()})
        except Exception as error:  # noqa: BLE001 - whatever a peer raises is its answer
            return {"action": None, "notice": f"raises {type(error).__name__}"}
    reported = notice or next((str(item.message) for item in heard if "olver" in str(item.message)), "")
    return {"action": None if action is None else np.asarray(action, dtype=float).tolist(), "notice": reported}


def _cbfpy(example: Problem, eta: float, backend: str) -> Decide:
    """The problem's numbers travel behind the state, where nothing moves them: one compilation serves all."""
    cbfpy: Any = importlib.import_module("cbfpy")
    jnp: Any = importlib.import_module("jax.numpy")
    parts = _Parts(example)

    class Linear(cbfpy.CBFConfig):  # type: ignore[misc]
        def f(self, z: Any) -> Any:
            return jnp.concatenate([parts(z, "f") - parts(z, "state"), jnp.zeros(parts.size - parts.states)])

        def g(self, z: Any) -> Any:
            return jnp.vstack([parts(z, "g"), jnp.zeros((parts.size - parts.states, parts.actions))])

        def h_1(self, z: Any) -> Any:
            return parts(z, "P") @ parts(z, "state") + parts(z, "q")

        def alpha(self, h: Any) -> Any:
            return eta * h

    bounds = np.ones(parts.actions)
    cbf = cbfpy.CBF.from_config(Linear(n=parts.size, m=parts.actions, u_min=-bounds, u_max=bounds, backend=backend))
    return lambda problem: (cbf.safety_filter(parts.packed(problem), problem["nominal"]), "")


def _run_time_assurance(example: Problem, eta: float) -> Decide:
    rta: Any = importlib.import_module("run_time_assurance.rta")
    constraint: Any = importlib.import_module("run_time_assurance.constraint")
    jnp: Any = importlib.import_module("jax.numpy")
    parts = _Parts(example)

    class RowModule(constraint.ConstraintModule):  # type: ignore[misc]
        def __init__(self, index: int) -> None:
            self.index = index
            super().__init__(alpha=constraint.PolynomialConstraintStrengthener([0.0, eta]))

        def _compute(self, state: Any, params: Any) -> Any:
            return parts(state, "P")[self.index] @ parts(state, "state") + parts(state, "q")[self.index]

    class Linear(rta.ExplicitASIFModule):  # type: ignore[misc]
        def _setup_properties(self) -> None:
            """Nothing beyond the problem."""

        def _setup_constraints(self) -> Any:
            return OrderedDict((f"row {index}", RowModule(index)) for index in range(len(example["q"])))

        def state_transition_system(self, state: Any) -> Any:
            return jnp.concatenate([parts(state, "f") - parts(state, "state"), jnp.zeros(parts.size - parts.states)])

        def state_transition_input(self, state: Any) -> Any:
            return jnp.vstack([parts(state, "g"), jnp.zeros((parts.size - parts.states, parts.actions))])

        def _pred_state(self, state: Any, step_size: float, control: Any) -> Any:
            moved = self.state_transition_system(state) + self.state_transition_input(state) @ control
            return state + step_size * moved

    bounds = np.ones(parts.actions)
    module = Linear(control_dim=parts.actions, control_bounds_low=-bounds, control_bounds_high=bounds)
    return lambda problem: (module.filter_control(parts.packed(problem), 1.0, problem["nominal"]), "")


def _cvxpy(example: Problem, eta: float, solver: str) -> Decide:
    """As in many tutorials: hard constraints, and the value of the variable is the action."""
    cp: Any = importlib.import_module("cvxpy")
    rows, actions = len(example["q"]), len(example["nominal"])
    action, A = cp.Variable(actions), cp.Parameter((rows, actions))
    b, nominal = cp.Parameter(rows), cp.Parameter(actions)
    kept = [A @ action >= b, action >= -1.0, action <= 1.0]
    program = cp.Problem(cp.Minimize(cp.sum_squares(action - nominal)), kept)

    def decide(problem: Problem) -> tuple[Any, str]:
        now = problem["P"] @ problem["state"] + problem["q"]
        A.value = problem["P"] @ problem["g"]
        b.value = (1.0 - eta) * now - problem["P"] @ problem["f"] - problem["q"]
        nominal.value = problem["nominal"]
        program.solve(solver=solver, warm_start=False)
        return action.value, "" if program.status == "optimal" else program.status

    return decide


class _Parts:
    """Where the parts of a problem lie in one long vector; the state is the first of them."""

    def __init__(self, example: Problem) -> None:
        self.states, self.actions = len(example["state"]), len(example["nominal"])
        self._shapes = {name: np.shape(example[name]) for name in ("state", "f", "g", "P", "q")}
        self._starts = dict(zip(self._shapes, np.cumsum([0, *map(self._count, self._shapes)]), strict=False))
        self.size = sum(map(self._count, self._shapes))

    def __call__(self, z: Any, name: str) -> Any:
        start = int(self._starts[name])
        return z[start : start + self._count(name)].reshape(self._shapes[name])

    def packed(self, problem: Problem) -> Any:
        return np.concatenate([np.ravel(problem[name]) for name in self._shapes])

    def _count(self, name: str) -> int:
        return int(np.prod(self._shapes[name]))


PEERS: Mapping[str, Callable[[Problem, float], Decide]] = {
    "cbfpy, qpax": partial(_cbfpy, backend="qpax"),
    "run-time-assurance": _run_time_assurance,
    "cvxpy, OSQP": partial(_cvxpy, solver="OSQP"),
    "cvxpy, Clarabel": partial(_cvxpy, solver="CLARABEL"),
}
"""By name: ``make(example, eta)``; the example gives the shapes."""

if __name__ == "__main__":
    main()
