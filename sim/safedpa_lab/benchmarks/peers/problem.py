"""The filter's problem as its peers get it: a kinematic car, round obstacles, one quadratic program a step.

    x = (x, y, yaw, speed),  u = (target speed, steer)
    x' = (v cos yaw, v sin yaw, v / wheelbase steer, gain (target - v)) = f(x) + g(x) u
    h_i(x) as ``ObstacleBarrier``: distance of obstacle i to the body, which is stretched by its stopping distance
    minimise (u - nominal)' W (u - nominal) + rho |s|^2   over u within the limits and s >= 0
    subject to dt p_i'(f + g u) + s_i >= -eta h_i + epsilon,   p_i the gradient of h_i

Steering is linear here, and nothing saturates: every program that is compared can state it.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping
from math import cos, sin
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safedpa_lab.benchmarks.timing import timed

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


def answered(compare: Callable[[Problem], dict[str, Any]]) -> None:
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
