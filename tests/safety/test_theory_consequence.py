"""With the bound as margin the filter keeps the true system's set, against the worst errors; with less it does not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as some
from numpy.typing import NDArray

from safedpa.safety import FilterSettings, FunctionBarrier, SafetyFilter
from safedpa.safety.theory_bound import ErrorConstants, barrier_error_bound

Values = NDArray[np.float64]
ETA = 0.3
SLOPE = np.array([0.8, -0.5])
"""Of mixed signs: its sum, 0.3, is much less than its 1-norm, 1.3."""
CONSTANTS = ErrorConstants(f=0.004, g=0.006, remainder=0.002, latent=0.5, lipschitz_f=0.01, lipschitz_g=0.004)
G = np.diag([0.1, 0.1])


def h(x: Values) -> float:
    return float(1.0 - SLOPE @ x)


def learned(x: Values) -> tuple[Values, Values]:
    return 0.98 * x, G


def worst_truth(x: Values, a: Values) -> Values:
    """Every error at its bound, in the direction that lowers h most."""
    f, g = learned(x)
    return f + g @ a + np.sign(SLOPE) * CONSTANTS.of_step(np.abs(a).sum())


def least_residual(epsilon: float, seed: int, steps: int = 60) -> tuple[float, float]:
    """The least h(x[t+1]) - (1 - eta) h(x[t]) and the least h over a drive that wishes to leave the set."""
    chosen = FilterSettings(action_low=(-1.0, -1.0), action_high=(1.0, 1.0), eta=ETA, epsilon=epsilon)
    safe = SafetyFilter(learned, [FunctionBarrier(h, lambda x: -SLOPE)], chosen)
    random = np.random.default_rng(seed)
    x, residual, least = random.uniform(-0.5, 0.5, 2), np.inf, np.inf
    for _ in range(steps):
        wish = np.sign(SLOPE) + 0.3 * random.normal(size=2)
        verdict = safe.decide(x, np.clip(wish, -1.0, 1.0))
        following = worst_truth(x, verdict.action)
        residual = min(residual, h(following) - (1.0 - ETA) * h(x))
        x, least = following, min(least, h(following))
    return residual, least


def bound() -> float:
    return float(barrier_error_bound(SLOPE, CONSTANTS, np.ones(2)))


@given(some.integers(0, 10_000))
@settings(max_examples=15, deadline=None)
def test_the_condition_holds_for_the_truth_and_the_set_is_kept(seed: int) -> None:
    residual, least = least_residual(bound(), seed)
    assert residual >= -1e-4  # the settings' slack tolerance
    assert least >= 0.0


@pytest.mark.parametrize(
    "epsilon",
    [
        0.0,
        abs(SLOPE.sum()) * CONSTANTS.of_step(2.0),  # p'1 in place of |p|_1
        1.3 * (CONSTANTS.f + 2.0 * CONSTANTS.g + CONSTANTS.remainder),  # without the latent's error
        1.3 * (CONSTANTS.f + CONSTANTS.remainder + CONSTANTS.lipschitz_f * CONSTANTS.latent),  # without those of G
    ],
)
def test_with_less_margin_the_truth_breaks_the_condition(epsilon: float) -> None:
    """Epsilon taken away instead of added would be less still: settings refuse it."""
    assert min(least_residual(epsilon, seed)[0] for seed in range(3)) < -1e-3


def test_the_set_itself_is_left_without_a_margin() -> None:
    assert min(least_residual(0.0, seed)[1] for seed in range(3)) < 0.0
