"""What is predicted over a horizon, its error worked out by hand, and the naive predictors in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from safedpa.compare.naive import constant_velocity, measured_rates, no_change
from safedpa.compare.rollout import rollout, rollout_at
from safedpa.compare.rollout_error import change_scale, error_of, rollout_error, trimmed_rms
from safedpa.compare.windows import windows_of
from safedpa.dynamics import PhysicsModel, load_model
from safedpa.errors import InputError
from safedpa.records.run import Run, Stretch
from safedpa.robots.car.system import CAR_THROTTLE
from safedpa.robots.pendulum.system import PENDULUM


def _pendulum_run(angle, rate, period=0.1):
    t = period * np.arange(len(angle))
    states = np.stack([angle, rate], axis=1).astype(float)
    return Run("by hand", PENDULUM, t, states, np.zeros((len(t), 1)), (Stretch(0, len(t)),))


def test_the_error_of_five_rows_is_that_worked_out_by_hand():
    """Five rows 0.1 s apart, horizon 0.2 s, every row a start: windows from rows 0, 1, 2."""
    run = _pendulum_run([0.0, 0.1, 0.4, 0.3, 0.2], [1.0, 2.0, 3.0, 5.0, 4.0])
    windows = windows_of([run], 0.2, stride=1)
    assert windows.end.tolist() == [2, 3, 4]
    # changes of angle 0.4, 0.2, -0.2: mean 0.4/3, of rate 2, 3, 1: mean 2
    scale = change_scale(windows, windows.end)
    assert scale[0] == pytest.approx(np.sqrt((0.16 + 0.04 + 0.04) / 3 - (0.4 / 3) ** 2))
    assert scale[1] == pytest.approx(np.sqrt(2 / 3))
    # predictions off by 0.1, 0.2, 0.3 in angle and 1, -1, 2 in rate; three windows are too few to trim one
    off = np.array([[0.1, 1.0], [0.2, -1.0], [0.3, 2.0]])
    error = error_of(windows, windows.end, run.states[windows.end] + off)
    assert error.per_state[0] == pytest.approx(np.sqrt(0.14 / 3) / scale[0])
    assert error.per_state[1] == pytest.approx(np.sqrt(6 / 3) / scale[1])
    assert error.value == pytest.approx(error.per_state.mean())


def test_the_largest_twentieth_is_left_out():
    errors = np.full((40, 1), 2.0)
    errors[[3, 17]] = 1e6
    assert trimmed_rms(errors)[0] == 2.0
    errors[5] = 100.0
    assert trimmed_rms(errors)[0] == pytest.approx(np.sqrt((37 * 4.0 + 1e4) / 38))
    errors[[3, 17]] = np.nan
    assert np.isfinite(trimmed_rms(errors)[0])
    errors[7] = np.inf
    assert trimmed_rms(errors)[0] == np.inf


@pytest.mark.parametrize("count", [1, 2, 19, 20, 21, 39, 40, 100, 1400, 1800, 2550, 2750])
def test_as_many_are_left_out_as_a_twentieth_holds_whole(count):
    """By sorting: floor(0.05 n) of n. Of many, since what is left unsorted by one place is seldom out of place."""
    for seed in range(40):
        errors = np.random.default_rng(seed).normal(size=(count, 3)) * [1.0, 10.0, 0.1]
        kept = np.sort(errors**2, axis=0)[: count - count // 20]
        np.testing.assert_allclose(trimmed_rms(errors), np.sqrt(kept.mean(axis=0)), rtol=1e-12)


def test_angles_go_by_the_short_way_round():
    run = _pendulum_run(np.array([3.0, 3.1, 3.2, 3.3, 3.5]), np.arange(5.0) ** 2)
    windows = windows_of([run], 0.2, stride=1)
    exact = run.states[windows.end]
    turned = exact + np.array([2 * np.pi, 0.0])
    assert error_of(windows, windows.end, turned).per_state[0] == pytest.approx(0.0, abs=1e-9)
    wrapped = _pendulum_run((run.states[:, 0] + np.pi) % (2 * np.pi) - np.pi, run.states[:, 1])
    other = windows_of([wrapped], 0.2, stride=1)
    np.testing.assert_allclose(change_scale(other, other.end), change_scale(windows, windows.end))


def test_a_state_that_never_changes_is_left_out():
    run = _pendulum_run(np.linspace(0, 1, 30) ** 2, np.full(30, 2.0))
    windows = windows_of([run], 0.5, stride=1)
    error = error_of(windows, windows.end, run.states[windows.end] + 0.1)
    assert np.isnan(error.per_state[1])
    assert error.value == error.per_state[0]


def test_rollout_error_is_the_error_at_the_end_of_the_horizon(drive, plain):
    run = drive(plain, 20.0)
    model = plain.with_settings({"base.drive_gain": load_model("dart_car").settings["base.drive_gain"]})
    windows = windows_of([run], 1.0, stride=1)
    # d(speed)/dt = drive_gain throttle, throttle held over 8 rows: speed is off by 1.48 x the integral of throttle
    integral = np.array([run.actions[s:e, 0].sum() * 0.05 for s, e in zip(windows.start, windows.end, strict=True)])
    expected = trimmed_rms((1.48 * integral)[:, None])[0] / change_scale(windows, windows.end)[3]
    assert rollout_error(model, windows).per_state[3] == pytest.approx(expected, rel=1e-9)


def test_naive_predictors_in_closed_form():
    t = np.concatenate([[0.0], np.cumsum(np.random.default_rng(0).uniform(0.01, 0.04, 199))])
    velocity = np.array([0.5, -0.2, 4.0, 1.5])
    start = np.array([1.0, 2.0, 3.0, 0.1])
    states = start + velocity * t[:, None]
    wrapped = states.copy()
    wrapped[:, 2] = (states[:, 2] + np.pi) % (2 * np.pi) - np.pi
    run = Run("straight", CAR_THROTTLE, t, wrapped, np.zeros((200, 2)), (Stretch(0, 200),))
    windows = windows_of([run], 1.0)
    # at the first row of the stretch there is no past: nothing is assumed to move
    np.testing.assert_array_equal(measured_rates(windows)[0], 0.0)
    np.testing.assert_allclose(measured_rates(windows)[1:], np.tile(velocity, (len(windows) - 1, 1)), rtol=1e-9)
    moved = windows.system.difference(constant_velocity(windows, windows.end), wrapped[windows.end])
    np.testing.assert_allclose(moved[1:], 0.0, atol=1e-9)
    still = no_change(windows, windows.end)
    np.testing.assert_array_equal(still, wrapped[windows.start])


def test_rates_look_back_a_tenth_of_a_second_and_never_ahead(drive, plain):
    run = drive(plain, 10.0, period=0.02)
    windows = windows_of([run], 0.5)
    expected = (run.states[windows.start[1:]] - run.states[windows.start[1:] - 5]) / 0.1
    np.testing.assert_allclose(measured_rates(windows)[1:], expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("period", [0.1, 0.15, 0.25, 1.0])
def test_rates_of_rows_that_lie_farther_apart_are_those_of_the_last_two(period):
    """Rows of a slow log lie more than a tenth of a second apart: the row before is the newest past that there is."""
    random = np.random.default_rng(5)
    t, states = period * np.arange(40), np.cumsum(random.uniform(0.0, 0.2, (40, 4)), axis=0)
    windows = windows_of([Run("slow", CAR_THROTTLE, t, states, np.zeros((40, 2)), (Stretch(0, 40),))], 4 * period)
    expected = (states[windows.start[1:]] - states[windows.start[1:] - 1]) / period
    np.testing.assert_allclose(measured_rates(windows)[1:], expected, rtol=1e-9)
    assert np.abs(expected).min() > 0.0


def test_rates_do_not_look_into_another_stretch(drive, plain):
    run = drive(plain, 10.0, stretches=[(0, 100), (110, 200)])
    windows = windows_of([run], 0.5, stride=100)
    assert windows.start.tolist() == [0, 100]
    np.testing.assert_array_equal(measured_rates(windows), 0.0)


def _one_by_one(model, run, horizon, stride):
    """The definition, in scalars: memory from the first row of the stretch on, then the window step by step."""
    model = PhysicsModel(model.base, model.effects, model.settings, model.period, holds=True)
    found = {}
    used = 0
    for part in run.stretches:
        for start in range(part.start, part.stop):
            used += 1
            if (used - 1) % stride:
                continue
            memory = model.initial_memory(run.actions[part.start])
            state = run.states[part.start]
            for row in range(part.start, start):
                _, memory = model.advance(state, run.actions[row], memory, period=float(run.t[row + 1] - run.t[row]))
            state, row = run.states[start], start
            path = [state]
            while row + 1 < part.stop and run.t[row + 1] <= run.t[start] + horizon + 0.5 * run.period:
                time = float(run.t[row] - run.t[run.stretches[0].start])
                period = float(run.t[row + 1] - run.t[row])
                state, memory = model.advance(state, run.actions[row], memory, period=period, time=time)
                path.append(state)
                row += 1
            if len(path) > 1:
                found[start] = np.array(path)
    return found


@pytest.mark.parametrize("jitter", [0.0, 0.3])
@pytest.mark.parametrize(
    "effects",
    [
        {},
        {"steering_lag": {"time_constant": 0.15}},
        {"actuator_delay": {"seconds": 0.13}, "drive_lag": {"time_constant": 0.2}, "steering_offset": {"angle": 0.05}},
        {
            "quadratic_drag": {"coefficient": 0.1},
            "battery_sag": {"rate": 0.01},
            "rolling_resistance": {"deceleration": 0.4},
        },
    ],
    ids=lambda value: "+".join(value) or "none",
)
def test_batch_equals_the_scalar_loop(plain, with_effect, drive, effects, jitter):
    model = plain
    for name, parameters in effects.items():
        model = with_effect(model, name, **parameters)
    run = drive(plain, 12.0, seed=3, jitter=jitter, stretches=[(0, 90), (93, 96), (100, 240)])
    windows = windows_of([run], 0.6, stride=7, partial=True)
    predicted = rollout(model, windows)
    reference = _one_by_one(model, run, 0.6, 7)
    assert len(reference) == len(windows)
    rows = np.concatenate([np.arange(part.start, part.stop) for part in run.stretches])
    for number, start in enumerate(rows[windows.start]):
        path = reference[int(start)]
        assert windows.steps[number] == len(path) - 1
        np.testing.assert_allclose(predicted[: len(path), number], path, atol=1e-10)
        assert np.isnan(predicted[len(path) :, number]).all()


@pytest.mark.parametrize(
    "effects",
    [
        {},
        {
            "steering_lag": {"time_constant": 0.2},
            "drive_delay": {"seconds": 0.12},
            "viscous_drag": {"coefficient": 0.4},
        },
    ],
    ids=lambda value: "+".join(value) or "none",
)
def test_exact_model_has_no_error_on_its_own_data(plain, with_effect, drive, effects):
    model = plain
    for name, parameters in effects.items():
        model = with_effect(model, name, **parameters)
    run = drive(model, 20.0, seed=1, jitter=0.1)
    assert rollout_error(model, windows_of([run], 1.0)).value < 1e-9


def test_memory_is_warm_at_the_starts(plain, with_effect, drive):
    """A lag that began settled at every start would be wrong; one that knows the stretch's past is exact."""
    model = with_effect(plain, "steering_lag", time_constant=0.5)
    run = drive(model, 20.0, seed=5)
    windows = windows_of([run], 0.2)
    assert rollout_error(model, windows).value < 1e-9
    cold = replace(run, stretches=tuple(Stretch(row, row + 6) for row in range(0, 390, 10)))
    assert rollout_error(model, windows_of([cold], 0.2)).per_state[2] > 0.1


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(step=st.integers(1, 20), start=st.integers(0, 7), seed=st.integers(0, 1000))
def test_nothing_later_is_looked_at(plain, with_effect, drive, step, start, seed):
    """Later measurements, and actions from t on, change nothing in the prediction for t."""
    model = with_effect(with_effect(plain, "steering_lag", time_constant=0.2), "drive_delay", seconds=0.1)
    run = drive(plain, 6.0, seed=2)
    windows = windows_of([run], 1.0).select(np.array([start]))
    row = int(windows.start[0]) + step
    random = np.random.default_rng(seed)
    states, actions = run.states.copy(), run.actions.copy()
    states[int(windows.start[0]) + 1 :] += random.normal(size=states[int(windows.start[0]) + 1 :].shape)
    states[: int(windows.start[0])] += random.normal(size=states[: int(windows.start[0])].shape)
    actions[row:] = random.uniform(-0.5, 0.5, size=actions[row:].shape)
    other = windows_of([replace(run, states=states, actions=actions)], 1.0).select(np.array([start]))
    before, after = rollout(model, windows), rollout(model, other)
    np.testing.assert_array_equal(before[: step + 1], after[: step + 1])


def test_earlier_actions_of_another_stretch_are_not_remembered(plain, with_effect, drive):
    model = with_effect(plain, "actuator_delay", seconds=0.4)
    run = drive(plain, 10.0, seed=4, stretches=[(0, 100), (100, 200)])
    actions = run.actions.copy()
    actions[:100] = 0.3
    windows = windows_of([run], 0.5, stride=100)
    other = windows_of([replace(run, actions=actions)], 0.5, stride=100)
    np.testing.assert_array_equal(rollout(model, windows)[:, 1], rollout(model, other)[:, 1])
    assert not np.array_equal(rollout(model, windows)[-1, 0], rollout(model, other)[-1, 0])


def test_rollout_at_reads_the_full_rollout(plain, drive):
    run = drive(plain, 10.0, jitter=0.4)
    windows = windows_of([run], 1.0)
    rows = [windows.rows_after(0.3), windows.end]
    predicted, whole = rollout_at(plain, windows, rows), rollout(plain, windows)
    for index, at in enumerate(rows):
        expected = whole[at - windows.start, np.arange(len(windows))]
        np.testing.assert_array_equal(predicted[index], expected)


def test_model_of_another_robot_is_refused(plain, drive):
    windows = windows_of([drive(plain, 5.0)], 1.0)
    with pytest.raises(InputError, match=r"robot 'car' with actions throttle, steer; the model is of robot 'pendulum'"):
        rollout(load_model("dfki_pendulum"), windows)
    with pytest.raises(InputError, match="target_speed"):
        rollout(load_model("car"), windows)


def test_predictions_without_bound_are_infinite_errors_not_warnings(plain, with_effect, drive):
    model = plain.with_settings({"base.drive_gain": replace(plain.settings["base.drive_gain"], value=100.0)})
    model = with_effect(model, "quadratic_drag", coefficient=2.0)
    run = drive(plain, 10.0)
    error = rollout_error(model, windows_of([run], 3.0))
    assert not np.isfinite(error.value) or error.value > 1.0


def test_remembered_commands_are_those_of_the_same_parameters(plain, with_effect, drive):
    """The same windows under many models, in turn and more than are kept, give what fresh windows give."""
    run = drive(plain, 8.0)
    windows = windows_of([run], 0.5)
    delays = [0.02 * index for index in range(20)]
    for delay in (*delays, *delays[:5], 0.0):
        model = with_effect(with_effect(plain, "actuator_delay", seconds=delay), "steering_lag", time_constant=0.1)
        fresh = windows_of([run], 0.5)
        np.testing.assert_array_equal(rollout(model, windows.select(np.arange(4))), rollout(model, fresh)[:, :4])
        np.testing.assert_array_equal(rollout(model, windows), rollout(model, fresh))
    assert len(windows.memo) <= 16
