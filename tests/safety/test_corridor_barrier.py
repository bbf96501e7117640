"""Barriers of limits: exact gradients, the angle follows what is kept, odd limits are refused."""

from __future__ import annotations

from math import inf, nan, nextafter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safedpa.errors import InputError
from safedpa.safety import CorridorBarrier, SpeedBarrier

finite = st.floats(-20.0, 20.0)


@given(finite, finite, st.floats(-3.0, 3.0), st.floats(0.01, 5.0), st.floats(0.01, 2.0))
def test_gradient_is_exact(angle: float, rate: float, low: float, width: float, time: float) -> None:
    barrier = CorridorBarrier(low, low + width, time)
    state, move = np.array([angle, rate]), np.array([0.3, -0.7])
    h, gradient = barrier.evaluate(state)
    np.testing.assert_allclose(barrier.values(state + move), h + gradient @ move, atol=1e-9)
    np.testing.assert_allclose(h, barrier.values(state))


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=60), st.floats(0.0, 1.0), st.floats(0.05, 1.0))
def test_the_angle_stays_where_the_barrier_is_kept(ahead: list[float], start: float, time: float) -> None:
    """Whatever s does within the corridor, the angle that moves at the rate (s - angle) / time stays within it."""
    barrier, angle, period = CorridorBarrier(0.0, 1.0, time), start, 0.01
    for s in ahead:
        rate = (s - angle) / time
        assert barrier.values(np.array([angle, rate])).min() >= -1e-12
        angle += period * rate
        assert -1e-12 <= angle <= 1.0 + 1e-12


def test_other_entries_of_the_state_and_names() -> None:
    barrier = CorridorBarrier(-1.0, 2.0, 0.5, angle=2, rate=0, name="elbow")
    assert barrier.names == ("elbow lower edge", "elbow upper edge")
    np.testing.assert_allclose(barrier.values(np.array([1.0, 9.0, 0.5])), [2.0, 1.0])
    np.testing.assert_allclose(barrier.evaluate(np.zeros(3))[1], [[0.5, 0.0, 1.0], [-0.5, 0.0, -1.0]])


@pytest.mark.parametrize(("low", "high"), [(1.0, 1.0), (2.0, 1.0), (nan, 1.0), (0.0, nan), (-inf, 1.0), (0.0, inf)])
def test_empty_and_endless_limits_are_refused(low: float, high: float) -> None:
    with pytest.raises(InputError, match=f"corridor: got {low} to {high}, wanted finite low < high"):
        CorridorBarrier(low, high, 0.2)
    with pytest.raises(InputError, match=f"speed limits: got {low} to {high}, wanted finite numbers, low < high"):
        SpeedBarrier(low, high)


@given(st.floats(-1e9, 1e9))
def test_the_narrowest_limits_are_taken(low: float) -> None:
    high = nextafter(low, inf)
    assert CorridorBarrier(low, high, 1e-300).values(np.array([low, 0.0])).min() == 0.0
    assert SpeedBarrier(low, high, 0).values(np.array([high])).tolist() == [0.0, high - low]


@pytest.mark.parametrize("time", [0.0, -1.0, nan, inf])
def test_a_time_that_is_none_is_refused(time: float) -> None:
    with pytest.raises(InputError, match="wanted a finite time > 0"):
        CorridorBarrier(0.0, 1.0, time)


def test_without_named_entries_it_reads_a_pendulums_state() -> None:
    assert CorridorBarrier(-1.0, 1.0, 0.2).reads == ("angle", "rate")
    for named in ({"angle": 0}, {"rate": 1}, {"angle": 2, "rate": 3}):
        assert CorridorBarrier(-1.0, 1.0, 0.2, **named).reads == ()
