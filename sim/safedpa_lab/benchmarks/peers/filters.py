"""The filter's problem as its peers get it: a kinematic car, round obstacles, one quadratic program a step.

    x = (x, y, yaw, speed),  u = (target speed, steer)
    x' = (v cos yaw, v sin yaw, v / wheelbase steer, gain (target - v)) = f(x) + g(x) u
    h_i(x) as ``ObstacleBarrier``: distance of obstacle i to the body, which is stretched by its stopping distance
    minimise (u - nominal)' W (u - nominal) + rho |s|^2   over u within the limits and s >= 0
    subject to dt p_i'(f + g u) + s_i >= -eta h_i + epsilon,   p_i the gradient of h_i

Steering is linear here, and nothing saturates: every program that is compared can state it.

A function for each peer answers the questions about it.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import sys
import warnings
from collections import OrderedDict
from collections.abc import Callable, Mapping
from functools import partial
from math import cos, sin
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safedpa_lab.benchmarks.timing import timed

_QUIET = {"print_time": False, "error_on_fail": False}
FloatArray = NDArray[np.float64]  # a peer runs where safedpa is not installed


class Problem:
    """One scene with the states and nominal actions to decide about."""

    def __init__(self, question: Mapping[str, Any]) -> None:
        self.question = question
        self.states, self.nominal_actions = np.array(question["states"]), np.array(question["nominal_actions"])
        self.obstacles = np.array(question["obstacles"]).reshape(-1, 3)
        self.rear, self.front, radius = question["footprint"]
        self.reach = self.obstacles[:, 2] + radius + question["clearance"]
        self.deceleration, self.gain = question["braking"]
        self.wheelbase, self.speed_gain = question["wheelbase"], question["speed_gain"]
        self.low, self.high = np.array(question["low"]), np.array(question["high"])
        self.weights = np.array(question["weights"]) / (self.high - self.low) ** 2
        self.eta, self.epsilon, self.period = (question[name] for name in ("eta", "epsilon", "period"))
        self.penalty = question["penalty"]

    def barrier(self, state: Any, xp: Any = np) -> Any:
        """h (m,), in numpy or in whatever has its functions: what derives gradients by itself."""
        x, y, yaw, speed = state[0], state[1], state[2], state[3]
        c, s = xp.cos(yaw), xp.sin(yaw)
        dx, dy = self.obstacles[:, 0] - x, self.obstacles[:, 1] - y
        along, across = c * dx + s * dy, c * dy - s * dx
        corner = self.deceleration / self.gain
        far = corner / self.gain + (speed * speed - corner * corner) / (2.0 * self.deceleration)
        stop = xp.where(xp.abs(speed) <= corner, speed / self.gain, xp.sign(speed) * far)
        nearest = xp.clip(along, -self.rear + xp.minimum(stop, 0.0), self.front + xp.maximum(stop, 0.0))
        return xp.sqrt((along - nearest) ** 2 + across**2) - self.reach

    def gradient(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """h (m,) and p (m, 4), by hand."""
        x, y, yaw, speed = state.tolist()
        c, s = cos(yaw), sin(yaw)
        corner = self.deceleration / self.gain
        size = abs(speed)
        far = corner / self.gain + (size * size - corner * corner) / (2.0 * self.deceleration)
        stop = speed / self.gain if size <= corner else (far if speed > 0.0 else -far)
        low, high = -self.rear + min(stop, 0.0), self.front + max(stop, 0.0)
        dx, dy = self.obstacles[:, 0] - x, self.obstacles[:, 1] - y
        along, across = c * dx + s * dy, c * dy - s * dx
        nearest = np.minimum(np.maximum(along, low), high)
        offset = along - nearest
        distance = np.maximum(np.sqrt(offset * offset + across * across), 1e-9)
        u, w = offset / distance, across / distance
        stretched = nearest == (high if speed >= 0.0 else low)
        slope = max(1.0 / self.gain, size / self.deceleration)
        p = np.stack([-(c * u - s * w), -(s * u + c * w), -nearest * w, -slope * u * stretched], axis=1)
        return distance - self.reach, p

    def f(self, state: Any, xp: Any = np) -> Any:
        """(4,)"""
        yaw, speed = state[2], state[3]
        return xp.array([speed * xp.cos(yaw), speed * xp.sin(yaw), 0.0 * speed, -self.speed_gain * speed])

    def g(self, state: Any, xp: Any = np) -> Any:
        """(4, 2)"""
        turn = state[3] / self.wheelbase
        nothing = 0.0 * turn
        return xp.array([[nothing, nothing], [nothing, nothing], [nothing, turn], [nothing + self.speed_gain, nothing]])

    def conditions(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """A (m, 2), b (m,) of A u >= b."""
        h, p = self.gradient(state)
        A = self.period * (p @ self.g(state))
        return A, -self.eta * h + self.epsilon - self.period * (p @ self.f(state))


def compared(
    problem: Problem, decide: Callable[[FloatArray, FloatArray], FloatArray], **reported: Any
) -> dict[str, Any]:
    """Times of ``decide(state, nominal action)``, and its actions; with no calls asked for, what it does in words."""
    question = problem.question
    if question["calls"] == 0:
        return {"reports": _message(problem, decide), **reported}
    pairs = list(zip(problem.states, problem.nominal_actions, strict=True))
    times = timed(lambda pair: decide(*pair), pairs, question["calls"], question["seconds"])
    actions = [np.asarray(decide(*pair), dtype=np.float64).tolist() for pair in pairs]
    return {**times, "actions": actions, **reported}


def _answered(compare: Callable[[Problem], dict[str, Any]]) -> None:
    """Reads one question a line from standard input and writes all answers as one list."""
    questions = json.loads(sys.stdin.read())["problems"]
    sys.stdout.write("\n" + json.dumps({"answers": [compare(Problem(question)) for question in questions]}) + "\n")


def _message(problem: Problem, decide: Callable[[FloatArray, FloatArray], FloatArray]) -> str:
    """In words, for the first state."""
    state, nominal = problem.states[0], problem.nominal_actions[0]
    try:
        action = np.asarray(decide(state, nominal), dtype=np.float64)
    except Exception as error:  # noqa: BLE001 - whatever a peer raises is its answer
        return f"raises {type(error).__name__}"
    shown = ", ".join(f"{value:.3g}" for value in action)
    if not np.isfinite(action).all():
        return f"returns ({shown}) and says nothing"
    tolerance = 1e-3 * (problem.high - problem.low)
    outside = (action < problem.low - tolerance).any() or (action > problem.high + tolerance).any()
    same = np.abs(action - nominal).max() < 1e-3
    what = "beyond the limits" if outside else "the unsafe nominal action" if same else "within the limits"
    return f"returns ({shown}), {what}, and says nothing"


def casadi() -> None:
    """IPOPT as the authors of SafeDPA's code had it: built again every step, nearest obstacle, no status."""

    def compare(problem: Problem) -> dict[str, Any]:
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

    _answered(compare)


def cbfpy() -> None:
    """Dynamics and barrier in jax, gradients and quadratic program by its own backends, named in the question."""

    def compare(problem: Problem) -> dict[str, Any]:
        with contextlib.redirect_stdout(sys.stderr):  # it prints advice
            cbfpy: Any = importlib.import_module("cbfpy")
            jnp: Any = importlib.import_module("jax.numpy")

        class Car(cbfpy.CBFConfig):  # type: ignore[misc]
            def f(self, z: Any) -> Any:
                return problem.f(z, jnp)

            def g(self, z: Any) -> Any:
                return problem.g(z, jnp)

            def h_1(self, z: Any) -> Any:
                return problem.barrier(z, jnp)

            def alpha(self, h: Any) -> Any:
                return problem.eta / problem.period * h

            def P(self, z: Any, u_des: Any) -> Any:  # noqa: N802 - the peer's name
                return jnp.diag(2.0 * problem.weights)

            def q(self, z: Any, u_des: Any) -> Any:
                return -2.0 * problem.weights * u_des

        backend, penalty = problem.question["backend"], problem.penalty
        make = partial(Car, n=4, m=2, u_min=problem.low, u_max=problem.high, backend=backend)
        with contextlib.redirect_stdout(sys.stderr):
            car = make(cbf_relaxation_penalty=penalty, control_relaxation_penalty=10.0 * penalty)
            cbf = cbfpy.CBF.from_config(car)
            return compared(problem, lambda *pair: np.asarray(cbf.safety_filter(*pair)), version=_version("cbfpy"))

    _answered(compare)


def cvxpy() -> None:
    """The program stated once with parameters, solved for every decision by the solver named in the question."""

    def compare(problem: Problem) -> dict[str, Any]:
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

    _answered(compare)


def run_time_assurance() -> None:
    """Its explicit active set invariance filter (quadprog), one constraint module an obstacle."""
    warnings.simplefilter("ignore")  # it warns where it finds no solution, and hands the nominal action on

    def compare(problem: Problem) -> dict[str, Any]:
        rta: Any = importlib.import_module("run_time_assurance.rta")
        constraint: Any = importlib.import_module("run_time_assurance.constraint")
        jnp: Any = importlib.import_module("jax.numpy")

        def constraint_of(index: int) -> Any:
            one = Problem({**problem.question, "obstacles": [problem.obstacles[index].tolist()]})

            class Obstacle(constraint.ConstraintModule):  # type: ignore[misc]
                def _compute(self, state: Any, params: Any) -> Any:
                    return one.barrier(state, jnp)[0]

            rate = problem.eta / problem.period
            return Obstacle(alpha=constraint.PolynomialConstraintStrengthener([0.0, rate]))

        class Car(rta.ExplicitASIFModule):  # type: ignore[misc]
            def _setup_properties(self) -> None:
                """Nothing beyond the problem."""

            def _setup_constraints(self) -> Any:
                return OrderedDict((f"obstacle {i}", constraint_of(i)) for i in range(len(problem.obstacles)))

            def state_transition_system(self, state: Any) -> Any:
                return problem.f(state, jnp)

            def state_transition_input(self, state: Any) -> Any:
                return problem.g(state, jnp)

            def _pred_state(self, state: Any, step_size: float, control: Any) -> Any:
                return state + step_size * (problem.f(state, jnp) + problem.g(state, jnp) @ control)

        car = Car(control_dim=2, control_bounds_low=np.array(problem.low), control_bounds_high=np.array(problem.high))

        def decide(state: Any, nominal: Any) -> Any:
            return car.filter_control(state, problem.period, nominal)

        return compared(problem, decide, version=_version("run-time-assurance"))

    _answered(compare)


def _version(package: str) -> str:
    return str(importlib.import_module("importlib.metadata").version(package))
