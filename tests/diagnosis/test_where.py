"""A planted effect shows where it acts."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.compare.bins import merged, round_edges
from safedpa.compare.comparison import compare_model
from safedpa.compare.summary import decisive, state_sentence, where_sentence, worst_bins
from safedpa.compare.where import factors, window_squares
from safedpa.compare.windows import windows_of
from safedpa.records.run import Run, Stretch
from safedpa.robots.car.system import CAR_THROTTLE


def _compared(plain, drive, truth, seconds=120.0):
    return compare_model(plain, [drive(truth, seconds, seed=7), drive(truth, seconds, seed=8)])


def _factor(comparison, name):
    return next(item for item in comparison.factors if item.variable == name)


def test_hidden_drag_is_worst_at_the_fastest_speed(plain, with_effect, drive):
    comparison = _compared(plain, drive, with_effect(plain, "quadratic_drag", coefficient=0.3))
    factor = decisive(comparison)
    assert factor.variable == "speed"
    fastest = max((item for item in factor.bins), key=lambda item: abs(item.low + item.high))
    assert max(factor.bins, key=lambda item: item.error) == fastest
    assert fastest.ratio > 2.0
    # drag slows down what the model thinks runs on
    assert fastest.bias["speed"] * (fastest.low + fastest.high) > 0
    assert "The state predicted worst is speed" in state_sentence(comparison)
    assert f"speed {fastest.low:.3g} to {fastest.high:.3g} m/s" in where_sentence(comparison)


def test_hidden_steering_asymmetry_turns_both_sides_one_way_and_spares_straight_on(plain, with_effect, drive):
    comparison = _compared(plain, drive, with_effect(plain, "steering_asymmetry", difference=0.5))
    bins = _factor(comparison, "steer").bins
    straight = min(bins, key=lambda item: abs(item.low + item.high))
    for outer in (bins[0], bins[-1]):
        assert outer.bias["yaw"] < -0.3
        assert outer.error > 1.3 * straight.error
        assert abs(outer.bias["yaw"]) > 1.3 * abs(straight.bias["yaw"])
    physical = {item.variable: item.explained for item in comparison.factors if item.kind in ("state", "action")}
    assert max(physical, key=physical.__getitem__) in ("steer", "speed")


def test_hidden_steering_gain_is_worst_at_full_steer_and_fine_straight_on(plain, with_effect, drive):
    comparison = _compared(plain, drive, with_effect(plain, "steering_gain", gain=0.6))
    steer = _factor(comparison, "steer")
    straight = min(steer.bins, key=lambda item: abs(item.low + item.high))
    outer = [steer.bins[0], steer.bins[-1]]
    assert min(item.error for item in outer) > 1.5 * straight.error


def test_hidden_steering_offset_turns_every_bin_of_steer_to_one_side(plain, with_effect, drive):
    comparison = _compared(plain, drive, with_effect(plain, "steering_offset", angle=0.1))
    assert "The state predicted worst is yaw" in state_sentence(comparison)
    assert "rad too low)" in state_sentence(comparison)
    for item in _factor(comparison, "steer").bins:
        assert item.bias["yaw"] < -0.1
    assert max(abs(item.bias["speed"]) for item in _factor(comparison, "steer").bins) < 1e-9


def test_a_fault_in_time_is_named_as_time(plain, with_effect, drive):
    """Something that happened once: for ten seconds the throttle did nothing."""
    run = drive(plain, 120.0, seed=1)
    actions = run.actions.copy()
    actions[1000:1200, 0] = np.random.default_rng(0).uniform(-1, 1, 200)
    actions[1000:1200, 1] += 0.3
    comparison = compare_model(plain, [type(run)("faulty", run.system, run.t, run.states, actions, run.stretches)])
    assert decisive(comparison).variable == "time"
    assert "of faulty" in where_sentence(comparison)
    worst = max(decisive(comparison).bins, key=lambda item: item.error)
    assert worst.low <= 60.0 and worst.high >= 50.0  # noqa: PT018


def test_an_exact_model_is_called_exact(plain, drive):
    comparison = _compared(plain, drive, plain, 20.0)
    assert comparison.error.value < 1e-9
    assert where_sentence(comparison) == "The model predicts these runs exactly."


def test_noise_alone_is_nowhere_in_particular(plain, drive):
    run = drive(plain, 200.0, seed=3)
    noise = np.random.default_rng(0).normal(size=run.states.shape) * 0.3
    noisy = type(run)("noisy", run.system, run.t, run.states + noise, run.actions, run.stretches)
    assert "nowhere in particular" in where_sentence(compare_model(plain, [noisy]))


def test_bins_hold_every_window_once_and_shares_add_up(plain, with_effect, drive):
    comparison = _compared(plain, drive, with_effect(plain, "rolling_resistance", deceleration=0.5), 60.0)
    for factor in comparison.factors:
        assert sum(item.samples for item in factor.bins) == len(comparison.windows)
        assert sum(item.share for item in factor.bins) == pytest.approx(1.0)
        assert all(item.samples >= 10 for item in factor.bins)
    errors = [item.error for item in worst_bins(comparison)]
    assert errors == sorted(errors, reverse=True)


def test_explained_is_the_adjusted_share_of_variance():
    """Windows at rest without error and windows on the move with error 1 or 3: worked out by hand."""
    t = 0.1 * np.arange(44)
    moving = np.arange(44) >= 22
    speed = np.where(moving, 2.0, 0.0)
    states = np.stack([t, t, t, speed], axis=1)
    run = Run("two", CAR_THROTTLE, t, states, np.zeros((44, 2)), (Stretch(0, 22), Stretch(22, 44)))
    windows = windows_of([run], 0.2, stride=1)
    assert len(windows) == 40
    errors = np.zeros((40, 4))
    errors[20:, 0] = np.tile([2.0, 6.0], 10)
    found = {item.variable: item for item in factors(windows, errors, np.array([1.0, 1.0, 1.0, 1.0]))}
    # roots of the mean squares: 0 (20 times), 1 and 3 (10 times each); mean 1, variance of all 1.5, within bins 0.5
    assert found["speed"].explained == pytest.approx(1 - 39 / 38 * 0.5 / 1.5)
    assert found["throttle"].explained == pytest.approx(0.0)


def test_one_glitch_does_not_own_the_squared_error():
    errors = np.full((100, 2), 0.1)
    errors[4] = 1e9
    squares = window_squares(errors, np.array([1.0, 1.0]))
    assert squares[4] / squares.sum() < 0.02


@settings(max_examples=100, deadline=None)
@given(
    st.lists(st.floats(-1e3, 1e3, allow_nan=False), min_size=1, max_size=200),
    st.integers(1, 12),
    st.integers(1, 30),
)
def test_edges_are_round_ordered_and_hold_all_values(numbers, most, smallest):
    values = np.array(numbers)
    edges = round_edges(values, most)
    assert (np.diff(edges) > 0).all()
    assert edges[0] <= values.min()
    assert values.max() <= edges[-1] or np.isclose(values.max(), edges[-1])
    assert len(edges) <= most + 2
    joined = merged(values, edges, smallest)
    counts = np.histogram(values, joined)[0]
    assert len(joined) == 2 or (counts >= smallest).all()
