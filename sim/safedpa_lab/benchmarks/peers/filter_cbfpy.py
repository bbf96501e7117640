"""cbfpy: dynamics and barrier in jax, gradients and quadratic program by its own backends."""

from __future__ import annotations

import contextlib
import importlib
import sys
from functools import partial
from typing import Any

import numpy as np

from safedpa_lab.benchmarks.peers.problem import Problem, answered, compared


def main() -> None:
    """Answers about the backend named in the question."""
    answered(_compare)


def _compare(problem: Problem) -> dict[str, Any]:
    with contextlib.redirect_stdout(sys.stderr):  # it prints advice
        cbfpy: Any = importlib.import_module("cbfpy")
        backend = problem.question["backend"]
        cbf = cbfpy.CBF.from_config(_config(problem, backend))

        def decide(state: Any, nominal: Any) -> Any:
            return np.asarray(cbf.safety_filter(state, nominal))

        return compared(problem, decide, version=importlib.import_module("importlib.metadata").version("cbfpy"))


def _config(problem: Problem, backend: str) -> Any:
    cbfpy: Any = importlib.import_module("cbfpy")
    jnp: Any = importlib.import_module("jax.numpy")
    rate = 1.0 / problem.period

    class Car(cbfpy.CBFConfig):  # type: ignore[misc]
        def f(self, z: Any) -> Any:
            return problem.f(z, jnp)

        def g(self, z: Any) -> Any:
            return problem.g(z, jnp)

        def h_1(self, z: Any) -> Any:
            return problem.barrier(z, jnp)

        def alpha(self, h: Any) -> Any:
            return rate * problem.eta * h

        def P(self, z: Any, u_des: Any) -> Any:  # noqa: N802 - the peer's name
            return jnp.diag(2.0 * problem.weights)

        def q(self, z: Any, u_des: Any) -> Any:
            return -2.0 * problem.weights * u_des

    make = partial(Car, n=4, m=2, u_min=problem.low, u_max=problem.high, backend=backend)
    return make(cbf_relaxation_penalty=problem.penalty, control_relaxation_penalty=10.0 * problem.penalty)
