"""The barrier for 45 degrees can always be kept, over the whole state space and every wind; and where that ends."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.safety import SafetyFilter
from safedpa_lab.pendulum.invariance import largest_wind, least_reserve, reserve
from safedpa_lab.pendulum.rollouts import blown, physics_in_any_wind
from safedpa_sim.pendulum.task import AHEAD, BALANCING, LONG_WAY_ROUND, TORQUE, WIND, corridor, filter_settings

EPSILON = 0.003
share = st.floats(0.0, 1.0)


def inside(edges: tuple[float, float], angle: float, ahead: float) -> np.ndarray:
    """The state of the set at these shares of angle and s."""
    low, high = edges
    first, then = (low + part * (high - low) for part in (angle, ahead))
    return np.array([first, (then - first) / AHEAD])


@pytest.mark.parametrize("edges", [BALANCING, LONG_WAY_ROUND], ids=["balancing", "long way round"])
def test_a_torque_is_always_left(edges: tuple[float, float]) -> None:
    least = least_reserve(WIND, edges, epsilon=EPSILON)
    assert least.torque > 0.5, least


@pytest.mark.long
@settings(max_examples=300, deadline=None)
@given(share, share, st.floats(0.0, 2 * np.pi), st.sampled_from([BALANCING, LONG_WAY_ROUND]))
def test_the_filter_that_knows_the_wind_keeps_every_state(
    angle: float, ahead: float, direction: float, edges: tuple[float, float]
) -> None:
    """From anywhere in the set, whatever is wished: the next state is in the set, and the filter did not give way.

    A state on the edge may lie outside by its last digit; then the filter says so, and the next state is in the set.
    """
    state = inside(edges, angle, ahead)
    wind = WIND * np.array([np.cos(direction), np.sin(direction)])
    item = SafetyFilter.for_model(physics_in_any_wind(), filter_settings(EPSILON), [corridor(edges)])
    h_now = corridor(edges).values(state).min()
    assert h_now > -1e-14
    for wish in (-TORQUE, TORQUE):
        verdict = item.decide(state, [wish], wind)
        assert verdict.status.value in (("passed", "corrected") if h_now >= 0.0 else ("violated",))
        following = blown(state[None], verdict.action[None], wind[None])[0]
        assert corridor(edges).values(following).min() >= -1e-4
        assert edges[0] - 1e-9 <= following[0] <= edges[1] + 1e-9


@pytest.mark.long
def test_the_largest_wind_is_where_static_torques_say() -> None:
    """At 45 degrees and standstill: gravity and the wind along the motion together are the motor's torque."""
    gravity, area = 9.81 * 0.5 * np.sin(np.pi / 4), 0.5 * 0.5
    assert largest_wind() == pytest.approx(np.sqrt((TORQUE - gravity) / area), abs=0.03)
    assert least_reserve(largest_wind() + 0.05).torque < 0.0
    assert largest_wind(epsilon=EPSILON) < largest_wind()


def test_the_reserve_is_that_of_the_true_dynamics() -> None:
    """With the whole reserve of torque taken away the condition still holds; with a little more it does not."""
    state, wind = inside(BALANCING, 1.0, 0.9), np.array([WIND, 0.0])
    left = reserve(state[None], wind[None], BALANCING, 0.5, 0.0)[0]
    low, high = BALANCING
    now = state[0] + AHEAD * state[1]
    for torque, holds in ((-TORQUE + 0.99 * left, True), (-TORQUE + 1.01 * left, False)):
        following = blown(state[None], np.array([[torque]]), wind[None])[0]
        after = following[0] + AHEAD * following[1]
        assert bool(high - after >= 0.5 * (high - now)) is holds
        assert after - low >= 0.5 * (now - low) or not holds
