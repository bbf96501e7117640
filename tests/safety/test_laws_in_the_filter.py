"""A model whose effects say where and when they act, in the filter: it brakes as the floor there asks."""

from __future__ import annotations

import numpy as np
import pytest

from safedpa.dynamics import parse_model
from safedpa.errors import InputError
from safedpa.safety import FilterSettings, FunctionBarrier, SafetyFilter, Status
from safedpa.safety.batch import BatchFilter

CAR = """
format = 1
robot = "car"
period = 0.05
[base]
kind = "kinematic_bicycle"
drive = "speed_servo"
wheelbase = 0.32
speed_gain = 3.0
acceleration_limit = 6.0
"""
SLICK = """
[[effects]]
name = "speed_command_gain"
where = "x above"
edge = 0.05
gain = 0.5
x_above = 1.0
"""
FRESH = """
[[effects]]
name = "speed_command_gain"
varies = "gain with time"
gain = 1.0
gain_per_time = 0.01
"""
LOW, HIGH = (-3.0, -0.4), (3.0, 0.4)


def filter_of(text):
    settings = FilterSettings(
        system="car", action_low=LOW, action_high=HIGH, backup_action=(0.0, 0.0), eta=0.3, epsilon={"default": 0.0}
    )
    return SafetyFilter.for_model(parse_model(CAR + text), settings, [FunctionBarrier(lambda x: 1.0 - x[3])])


def decided(text, x, **known):
    return filter_of(text).decide(np.array([x, 0.0, 0.0, 0.95]), wish=(3.0, 0.0), **known)


def test_the_filter_asks_for_as_much_as_the_floor_there_takes():
    plain, outside, inside = (decided(text, x) for text, x in (("", 0.0), (SLICK, 0.0), (SLICK, 3.0)))
    assert {plain.status, outside.status, inside.status} == {Status.corrected}
    np.testing.assert_allclose(outside.action, plain.action, atol=1e-6)
    assert inside.action[0] == pytest.approx(2.0 * plain.action[0], rel=1e-3)
    for verdict in (plain, outside, inside):
        assert verdict.h_next >= 0.0


def test_the_filter_knows_how_late_it_is():
    fresh, late = (decided(FRESH, 0.0, time=seconds) for seconds in (0.0, 50.0))
    assert fresh.status is late.status is Status.corrected
    assert late.action[0] == pytest.approx(fresh.action[0] / 1.5, rel=2e-3)


@pytest.mark.parametrize("time", [None, float("nan"), -1.0, float("inf"), "late"])
def test_a_model_that_depends_on_the_time_is_not_trusted_without_it(time):
    verdict = decided(FRESH, 0.0, time=time)
    assert verdict.status is Status.fallback
    assert "seconds since the start of the run" in verdict.reason
    np.testing.assert_array_equal(verdict.action, (0.0, 0.0))
    ordered = filter_of(FRESH).stop("asked", np.array([0.0, 0.0, 0.0, 0.9]), time=time)
    np.testing.assert_array_equal(ordered.action, (0.0, 0.0))


def test_to_other_models_the_time_says_nothing():
    np.testing.assert_array_equal(decided("", 0.0, time=50.0).action, decided("", 0.0).action)


def test_a_batch_has_no_time_and_says_so():
    with pytest.raises(InputError, match="filter one by one"):
        BatchFilter(parse_model(CAR + FRESH))


def test_the_slopes_follow_the_border():
    """About the border the tangent of the filter's model is that of differences, on the recorded road as before it."""
    model = parse_model(CAR + SLICK)
    for _ in range(300):
        model.step(np.zeros(4), np.zeros(2))
    for x in np.linspace(0.85, 1.05, 9):
        state, action = np.array([x, 0.0, 0.0, 1.0]), np.array([1.2, 0.1])
        g = model.slopes(state, None, action, ())
        nudge = 1e-6 * np.eye(2)
        columns = [(model.step(state, action + e) - model.step(state, action - e)) / 2e-6 for e in nudge]
        np.testing.assert_allclose(g, np.stack(columns, axis=1), atol=1e-6)
