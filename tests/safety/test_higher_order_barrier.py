"""A barrier of higher relative degree from derivatives."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from safedpa.errors import InputError
from safedpa.safety import AbstractBarrier, FilterSettings, FunctionBarrier, HigherOrderBarrier, SafetyFilter, Status

PERIOD = 0.05
A = np.eye(4) + PERIOD * np.eye(4, k=2)
B = np.vstack((0.5 * PERIOD**2 * np.eye(2), PERIOD * np.eye(2)))
CENTRE, RADIUS = np.array([1.5, 0.2]), 0.5
SETTINGS = FilterSettings(action_low=(-1.0, -1.0), action_high=(1.0, 1.0), eta=0.2, epsilon=0.002)


def room(x: np.ndarray) -> float:
    return float(np.hypot(*(x[:2] - CENTRE)) - RADIUS)


def closing(x: np.ndarray) -> float:
    """d(room)/dt, which no action changes at once."""
    apart = x[:2] - CENTRE
    return float(apart @ x[2:] / np.hypot(*apart))


def allowed(h: np.ndarray) -> np.ndarray:
    """Closing speed that a brake of 0.8 takes away over h, linear below 0.2 m: increasing, 0 at 0."""
    return np.where(h < 0.2, 2.0 * h, np.sqrt(1.6 * np.maximum(h, 0.2) - 0.16))


def drive(barrier: AbstractBarrier, seed: int) -> tuple[float, set[Status]]:
    random, x, least = np.random.default_rng(seed), np.zeros(4), np.inf
    x[:2] = random.uniform((-0.5, -0.8), (0.3, 1.2))
    safe, said = SafetyFilter(lambda x: (A @ x, B), [barrier], SETTINGS), set()
    for _ in range(100):
        wish = np.clip(3.0 * (CENTRE - x[:2]) + random.normal(size=2), -1.0, 1.0)
        verdict = safe.decide(x, wish)
        said.add(verdict.status)
        x = A @ x + B @ verdict.action
        least = min(least, room(x))
    return least, said


def test_a_double_integrator_hits_nothing() -> None:
    plain = [drive(FunctionBarrier(room), seed)[0] for seed in range(20)]
    assert sum(least < 0.0 for least in plain) >= 5, "distance less radius has relative degree two"
    higher = [drive(HigherOrderBarrier([room, closing], [allowed]), seed) for seed in range(80)]
    assert min(least for least, _ in higher) >= 0.0
    assert set.union(*(said for _, said in higher)) <= {Status.passed, Status.corrected}


def test_it_is_the_recursion_of_its_source() -> None:
    """h = x^3 + y in time: derivatives of polynomials are known, psi_2 = psi_1' + alpha_2 psi_1."""
    derivatives = [lambda t: t[0] ** 3, lambda t: 3.0 * t[0] ** 2, lambda t: 6.0 * t[0]]
    first, second = 0.7, 1.9
    barrier = HigherOrderBarrier(derivatives, [first, second])
    t = 1.3
    psi_1, psi_1_rate = 3 * t**2 + first * t**3, 6 * t + first * 3 * t**2
    assert barrier.values(np.array([t]))[0] == pytest.approx(psi_1_rate + second * psi_1, rel=1e-14)
    squared = HigherOrderBarrier(derivatives, [first, np.square])
    assert squared.values(np.array([t]))[0] == pytest.approx(psi_1_rate + psi_1**2, rel=1e-14)


def test_several_values_and_a_gradient_of_their_own() -> None:
    barrier = HigherOrderBarrier(
        [lambda x: np.array([x[0], 2.0 * x[0]]), lambda x: np.array([x[1], 2.0 * x[1]])],
        [3.0],
        gradient=lambda x: [[3.0, 1.0], [6.0, 2.0]],
        names=("one", "two"),
        kind="wall",
    )
    h, gradient = barrier.evaluate(np.array([0.5, -0.2]))
    np.testing.assert_allclose(h, [1.3, 2.6])
    np.testing.assert_array_equal(gradient, [[3.0, 1.0], [6.0, 2.0]])
    np.testing.assert_array_equal(barrier.along(np.array([0.5, -0.2]), np.array([[1.0], [2.0]])), [[5.0], [10.0]])
    assert (barrier.names, barrier.kind) == (("one", "two"), "wall")


@pytest.mark.parametrize(
    ("derivatives", "rates"),
    [([room], []), ([room, closing], []), ([room, closing], [1.0, 2.0]), ([room, closing], [0.0]),
     ([room, closing], [-1.0]), ([room, closing], [np.inf]),
     ([room, closing], [np.nan]), ([room, closing, closing], [allowed, 1.0])],
)  # fmt: skip
def test_what_does_not_fit_is_named(derivatives: list[Any], rates: list[Any]) -> None:
    with pytest.raises(InputError, match="rates: got"):
        HigherOrderBarrier(derivatives, rates)
