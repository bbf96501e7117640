"""The slopes of recorded equations beside those of complex steps, which are the reference."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.dynamics import load_model
from safedpa.dynamics.straight import Equations, straight_step
from safedpa.dynamics.tangent import complex_step
from safedpa.operations import COMPLEX, FLOATS, Operations

BOTH = ("a", "b")


def everything(state: Sequence[Any], action: Sequence[Any], latent: Sequence[Any], time: Any, use: Operations) -> Any:
    """Every function and operator, with and without an entry of the action on either side."""
    x, y = state
    a, b = action
    near, steep = use.clip(a, -0.5, y), use.clip(x, a, a + 2.0)
    return [
        use.sin(x * a) + use.cos(a - b) * b - use.tan(0.3 * b) + a / (2.0 + b * b) - 1.0 / (3.0 + a),
        use.tanh(4.0 * a) + use.exp(a * b) + use.sqrt(2.0 + a * b) + (-a) ** 2 + (+b) * x + (3.0 + a) ** 3,
        use.minimum(a, b) + use.maximum(y, a * a) + use.absolute(a - 0.1) * use.sign(b) + near * steep + x / y,
        use.where(x < y, a * b, b) + use.cos(b) * use.sin(b) + time * use.tanh(900.0 * (2.0 + a)),
        2.0 * x,
    ]


def bent(state: Sequence[Any], action: Sequence[Any], latent: Sequence[Any], time: Any, use: Operations) -> Any:
    """Where ``atan`` is in it, cmath and math differ in the last bit."""
    return [use.atan(action[0] * state[0]) * action[1]]


def both_roads(
    equations: Equations, state: list[float], action: list[float]
) -> tuple[list[float], np.ndarray, np.ndarray]:
    made = straight_step(equations, BOTH, BOTH, ())
    assert made is not None
    step, _, tangent = made
    value, slopes = tangent(state, action, [], 0.5)
    assert value == step(state, action, [], 0.5) == equations(state, action, [], 0.5, FLOATS)

    def nudged(entries: Sequence[Any]) -> Sequence[Any]:
        return [complex(entry) for entry in equations(state, entries, [], 0.5, COMPLEX)]

    return value, np.array(slopes), complex_step(nudged, action)[1]


numbers = st.floats(-0.9, 0.9)


@settings(max_examples=200, deadline=None)
@given(st.tuples(numbers, st.floats(0.1, 0.9)), st.tuples(numbers, numbers))
def test_every_rule_gives_the_slopes_of_complex_steps(state: tuple[float, ...], action: tuple[float, ...]) -> None:
    _, slopes, reference = both_roads(everything, list(state), list(action))
    np.testing.assert_allclose(slopes, reference, rtol=1e-12, atol=1e-12)
    _, slopes, reference = both_roads(bent, list(state), list(action))
    np.testing.assert_allclose(slopes, reference, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize(("a", "slope"), [(-0.5, 0.0), (-0.6, 0.0), (-0.4, 1.0), (0.5, 0.0), (0.4, 1.0), (0.6, 0.0)])
def test_on_a_bound_the_slope_is_that_of_the_bound(a: float, slope: float) -> None:
    def bounded(state: Any, action: Any, latent: Any, time: Any, use: Operations) -> Any:
        return [use.clip(action[0], -0.5, state[1])]

    _, slopes, reference = both_roads(bounded, [0.0, 0.5], [a, 0.0])
    assert slopes.tolist() == reference.tolist() == [[slope, 0.0]]


@pytest.mark.parametrize("name", ["car", "car_learned", "pendulum", "point", "point_wind", "point_learned"])
def test_the_same_bits_for_models_of_the_project(name: str) -> None:
    model, draw = load_model(name), np.random.default_rng(0)
    slow = copy.deepcopy(model)  # takes the road of dictionaries for its first two hundred steps
    model.write_straight()
    tangent = model.straight_tangent()
    assert tangent is not None
    for _ in range(100):
        state = draw.normal(size=len(model.system.state_names)).tolist()
        action = draw.uniform(-2.0, 2.0, len(model.system.action_names)).tolist()
        reference = slow.slopes(np.array(state), model.latent, np.array(action), ())
        # the reference's complex step leaves its square in a slope of zero, which the recorded tangent does not
        np.testing.assert_allclose(
            tangent(state, action, model.latent.tolist(), 0.0)[1], reference, rtol=0.0, atol=1e-60
        )
