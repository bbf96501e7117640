"""Batched rollouts against a loop that advances one robot at a time, and what they must not see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from safedpa.compare.rollout import rollout, rollout_at
from safedpa.compare.rollout_error import rollout_error
from safedpa.compare.windows import windows_of
from safedpa.dynamics import PhysicsModel, load_model
from safedpa.errors import InputError
from safedpa.records.run import Stretch


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
