"""Windows, what is predicted over them, side by side and at rest, and its error worked out by hand."""

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from safedpa.comparison.actuators import effective_action_columns
from safedpa.comparison.rollout import effective_actions, rollout, rollout_at
from safedpa.comparison.rollout_error import (
    change_scale,
    constant_velocity,
    error_of,
    measured_rates,
    no_change,
    rollout_error,
    trimmed_rms,
)
from safedpa.comparison.side_by_side import StackedMechanics
from safedpa.comparison.windows import check_runs, windows_of
from safedpa.diagnosis.fit.multiple_shooting import VariableProjection, folds_of
from safedpa.dynamics import PhysicsModel, Setting, load_model
from safedpa.effects import CommandEffect, effect, effects_of, robots
from safedpa.effects.effect import Context
from safedpa.effects.friction import REST_RATE, resistance
from safedpa.effects.general import general_effects
from safedpa.errors import InputError, RunError
from safedpa.operations import FLOATS, NUMPY, half_angled
from safedpa.records.run import Run, Stretch
from safedpa.robots.car.dynamics.kinematic_bicycle import KinematicBicycle
from safedpa.robots.car.system import CAR_THROTTLE
from safedpa.robots.pendulum.rigid_pendulum import RigidPendulum
from safedpa.robots.pendulum.system import PENDULUM
from safedpa.systems.robots import robot_named


def _pendulum_run(angle, rate, period=0.1):
    t = period * np.arange(len(angle))
    states = np.stack([angle, rate], axis=1).astype(float)
    return Run("by hand", PENDULUM, t, states, np.zeros((len(t), 1)), (Stretch(0, len(t)),))


def test_the_error_of_five_rows_equals_a_hand_calculation():
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


def test_the_largest_5_percent_are_trimmed():
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
def test_the_number_of_trimmed_errors_is_rounded_down(count):
    """By sorting: floor(0.05 n) of n. Of many, since what is left unsorted by one place is seldom out of place."""
    for seed in range(40):
        errors = np.random.default_rng(seed).normal(size=(count, 3)) * [1.0, 10.0, 0.1]
        retained = np.sort(errors**2, axis=0)[: count - count // 20]
        np.testing.assert_allclose(trimmed_rms(errors), np.sqrt(retained.mean(axis=0)), rtol=1e-12)


def test_angle_differences_are_wrapped():
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
    states = np.array([1.0, 2.0, 3.0, 0.1]) + velocity * t[:, None]
    wrapped = states.copy()
    wrapped[:, 2] = (states[:, 2] + np.pi) % (2 * np.pi) - np.pi
    run = Run("straight", CAR_THROTTLE, t, wrapped, np.zeros((200, 2)), (Stretch(0, 200),))
    windows = windows_of([run], 1.0)
    # at the first row of the stretch there is no past: nothing is assumed to move
    np.testing.assert_array_equal(measured_rates(windows)[0], 0.0)
    np.testing.assert_allclose(measured_rates(windows)[1:], np.tile(velocity, (len(windows) - 1, 1)), rtol=1e-9)
    moved = windows.system.difference(constant_velocity(windows, windows.end), wrapped[windows.end])
    np.testing.assert_allclose(moved[1:], 0.0, atol=1e-9)
    np.testing.assert_array_equal(no_change(windows, windows.end), wrapped[windows.start])


def test_measured_rates_use_the_past_tenth_of_a_second_only(drive, plain):
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
        {}, {"steering_lag": {"time_constant": 0.15}},
        {"actuator_delay": {"seconds": 0.13}, "drive_lag": {"time_constant": 0.2}, "steering_offset": {"angle": 0.05}},
        {"quadratic_drag": {"coefficient": 0.1}, "battery_sag": {"rate": 0.01},
         "rolling_resistance": {"deceleration": 0.4}},
    ],
    ids=lambda value: "+".join(value) or "none",
)  # fmt: skip
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
        {}, {"steering_lag": {"time_constant": 0.2}, "drive_delay": {"seconds": 0.12},
             "viscous_drag": {"coefficient": 0.4}},
    ],
    ids=lambda value: "+".join(value) or "none",
)  # fmt: skip
def test_exact_model_has_no_error_on_its_own_data(plain, with_effect, drive, effects):
    model = plain
    for name, parameters in effects.items():
        model = with_effect(model, name, **parameters)
    assert rollout_error(model, windows_of([drive(model, 20.0, seed=1, jitter=0.1)], 1.0)).value < 1e-9


def test_memory_is_warm_at_the_starts(plain, with_effect, drive):
    """A lag that began settled at every start would be wrong; one that knows the stretch's past is exact."""
    model = with_effect(plain, "steering_lag", time_constant=0.5)
    run = drive(model, 20.0, seed=5)
    assert rollout_error(model, windows_of([run], 0.2)).value < 1e-9
    cold = replace(run, stretches=tuple(Stretch(row, row + 6) for row in range(0, 390, 10)))
    assert rollout_error(model, windows_of([cold], 0.2)).per_state[2] > 0.1


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(step=st.integers(1, 20), start=st.integers(0, 7), seed=st.integers(0, 1000))
def test_predictions_do_not_use_later_measurements(plain, with_effect, drive, step, start, seed):
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


def test_actuator_memory_does_not_cross_stretches(plain, with_effect, drive):
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


SERVO = {"base.wheelbase": 0.32, "base.speed_gain": 5.0, "base.acceleration_limit": 5.0}
HELD = {"rolling_resistance": {"deceleration": 1.5}, "towed_load": {"mass_ratio": 0.8, "deceleration": 1.9}}


def _car(name, holds):
    settings = {path: Setting(value) for path, value in SERVO.items()}
    model = PhysicsModel(KinematicBicycle(), (), settings, 0.05, holds=holds)
    return model.with_effect(effect("car", name), {key: Setting(value) for key, value in HELD[name].items()})


def _speeds(model, target, start, rows):
    state, found = np.array([0.0, 0.0, 0.0, start]), []
    for _ in range(rows):
        state, _ = model.advance(state, np.array([target, 0.0]), ())
        found.append(state[3])
    return np.array(found)


@pytest.mark.parametrize("name", HELD)
def test_a_car_driven_by_less_than_its_friction_stays_at_rest(name):
    """5 (0.25 - 0) = 1.25 m/s2 against 1.5 m/s2 and more."""
    assert np.abs(_speeds(_car(name, holds=True), 0.25, 0.0, 40)).max() == 0.0
    assert _speeds(_car(name, holds=False), 0.25, 0.0, 40)[-1] > 0.05  # rounded off it creeps


@pytest.mark.parametrize("name", HELD)
def test_a_sliding_system_comes_to_rest_and_stays_at_rest(name):
    speeds = _speeds(_car(name, holds=True), 0.0, 1.0, 60)
    assert (np.diff(speeds) <= 0.0).all()
    assert (speeds >= 0.0).all()  # neither overshoots nor oscillates
    assert speeds[-1] < 1e-9


@pytest.mark.parametrize("name", HELD)
def test_both_frictions_are_equal_away_from_rest(name):
    held, rounded = (_speeds(_car(name, holds), 2.0, 0.5, 60) for holds in (True, False))
    np.testing.assert_allclose(held, rounded, atol=1e-9)


def test_copies_of_a_model_with_holding_friction_keep_it():
    model = _car("rolling_resistance", holds=True)
    again = model.with_period(0.02).with_settings({"rolling_resistance.deceleration": Setting(1.4)})
    assert again.holds
    assert again.with_effect(effect("car", "quadratic_drag"), {}).holds
    assert not _car("rolling_resistance", holds=False).holds


def test_a_pendulum_with_less_torque_than_its_friction_stays_at_rest():
    base = {"base.length": 0.5, "base.mass": 1.0, "base.gravity": 9.81}
    made = PhysicsModel(RigidPendulum(), (), {path: Setting(value) for path, value in base.items()}, 0.02, holds=True)
    model = made.with_effect(effect("pendulum", "coulomb_friction"), {"torque": Setting(0.3)})
    state = np.array([np.pi + 0.05, 0.0])  # 0.25 N m of weight
    for _ in range(50):
        state, _ = model.advance(state, np.array([0.0]), ())
    np.testing.assert_allclose(state, [np.pi + 0.05, 0.0], atol=1e-12)


def test_a_reversing_force_does_not_reverse_friction_before_the_motion_reverses():
    """A pendulum that climbs: friction works against it until it turns, however hard gravity pulls."""
    context = Context({}, {}, {}, 0.0, 0.02, FLOATS, True)
    assert resistance(-15.0, 0.2, 1.0, REST_RATE, context) == 1.0
    assert resistance(-15.0, -0.2, 1.0, REST_RATE, context) == -1.0
    assert resistance(-15.0, 0.0, 1.0, REST_RATE, context) == -1.0
    assert resistance(0.5, 0.0, 1.0, REST_RATE, context) == 0.5


_MODELS = {"car": "car", "throttle": "dart_car", "pendulum": "pendulum", "point": "point"}
_EFFECTS = [
    (robot, name)
    for robot in _MODELS
    for name, item in effects_of(robot).items()
    if not isinstance(item, CommandEffect)
]


def _variants(robot: str, name: str, shares: tuple[float, ...]) -> list[PhysicsModel]:
    """The robot's model with one effect, at several shares of what is ordinary."""
    item = effects_of(robot)[name]
    given = load_model(_MODELS["throttle" if "throttle" in item.needs else robot])
    own = {path: setting for path, setting in given.settings.items() if path[:5] == "base."}
    base = PhysicsModel(given.base, (), own, holds=True)  # as rollouts have it
    numbers = [
        {
            p.name: Setting(float(np.clip(p.start + share * (p.typical - p.start), p.low, p.high)))
            for p in item.parameters
        }
        for share in shares
    ]
    return [base.with_effect(item, own) for own in numbers]


def _drawn(model: PhysicsModel, count: int, seed: int) -> tuple[Any, Any]:
    """States within what is plausible, and actions within their bounds."""
    random = np.random.default_rng(seed)
    low, high = np.maximum(model.system.state_low, -9.0), np.minimum(model.system.state_high, 9.0)
    actions = random.uniform(model.system.action_low, model.system.action_high, (count, len(model.system.action)))
    return random.uniform(low, high, (count, len(low))), actions


@pytest.mark.parametrize(("robot", "name"), _EFFECTS)
def test_stacked_models_equal_single_ones(robot: str, name: str) -> None:
    models = _variants(robot, name, (0.0, 0.4, 1.0))
    states, actions = _drawn(models[0], 40, 3)
    found = StackedMechanics(models).ahead(list(states.T), list(actions.T), 0.05, np.full(40, 2.0))
    table = np.stack([np.broadcast_to(column, (3, 40)) for column in found], axis=-1)
    for model, own in zip(models, table, strict=True):
        wanted, _ = model.advance(states, actions, (), period=0.05, time=2.0)
        np.testing.assert_allclose(own, wanted, rtol=1e-12, atol=1e-12)


def test_rows_may_have_periods_of_their_own() -> None:
    (model,) = _variants("car", "rolling_resistance", (1.0,))
    states, actions = _drawn(model, 30, 4)
    periods = np.linspace(0.01, 0.1, 30)
    found = np.stack(StackedMechanics([model]).ahead(list(states.T), list(actions.T), periods, np.zeros(30)), axis=-1)
    rows = zip(states, actions, periods.tolist(), strict=True)
    each = [model.advance(*row, (), period=period)[0] for *row, period in rows]
    np.testing.assert_allclose(found, np.array(each), rtol=1e-12, atol=1e-12)


def test_networks_use_the_reference_implementation() -> None:
    """A learned base cannot be recorded: the reference answers, for models with different numbers too."""
    base = load_model("car_learned")
    item = effects_of("car")["quadratic_drag"]
    models = [base.with_effect(item, {"coefficient": Setting(value)}) for value in (0.0, 0.3)]
    states, actions = _drawn(base, 12, 5)
    found = StackedMechanics(models).ahead(list(states.T), list(actions.T), base.period, np.zeros(12))
    for index, model in enumerate(models):
        wanted, _ = model.advance(states, actions, ())
        own = np.stack([np.broadcast_to(column, (2, 12))[index] for column in found], axis=-1)
        np.testing.assert_allclose(own, wanted, rtol=1e-9, atol=1e-9)


@given(st.floats(-1e4, 1e4))
def test_sine_and_cosine_by_the_half_angle(angle: float) -> None:
    value, table = np.array([angle]), half_angled(NUMPY)
    assert abs(float((table.sin(value) - np.sin(value))[0])) < 1e-15
    assert abs(float((table.cos(value) - np.cos(value))[0])) < 1e-15


@pytest.mark.parametrize("tangent", [0.0, 1.0, -3.0, 1e16, 1e155, -1e200, np.inf, -np.inf])
def test_the_half_angle_formula_holds_for_any_ratio(tangent: float) -> None:
    """Of a robot that stands a ratio of speeds is infinite, and the angle is a right one."""
    table = half_angled(NUMPY)
    angle = table.atan(np.array([tangent]))
    assert abs(float((table.sin(angle) - np.sin(angle))[0])) < 1e-15
    assert abs(float((table.cos(angle) - np.cos(angle))[0])) < 1e-15


def _random_windows(seed: int) -> tuple[Any, ...]:
    random = np.random.default_rng(seed)
    counts = random.choice([0.0, 0.3, 1.0], size=(7, 9, 3), p=[0.1, 0.1, 0.8])
    tangent, residuals = random.normal(size=(7, 9, 3, 3)), random.normal(size=(4, 7, 9, 3))
    return counts, tangent, residuals


@given(arrays(np.float64, 3, elements=st.floats(1e-3, 10.0)), st.integers(0, 100))
def test_what_a_start_explains_is_eliminated(scale: Any, seed: int) -> None:
    counts, tangent, residuals = _random_windows(seed)
    taken = VariableProjection(counts, tangent)
    reduced = taken.reduced(np.moveaxis(residuals, 0, -1), scale)
    weight = np.sqrt(counts) / scale
    for window in range(7):
        basis = (tangent[window] * weight[window][..., None]).reshape(-1, 3)
        column = (residuals[0, window] * weight[window]).reshape(-1)
        wanted = column - basis @ np.linalg.lstsq(basis, column, rcond=None)[0]
        np.testing.assert_allclose(reduced[window, :, 0], wanted, atol=1e-6 * np.abs(column).max())


@pytest.mark.parametrize("count", [1, 63, 64, 65, 200])
def test_every_window_is_reduced_by_itself(count: int) -> None:
    random = np.random.default_rng(count)
    counts, tangent = random.uniform(size=(count, 9, 3)), random.normal(size=(count, 9, 3, 3))
    columns, scale = random.normal(size=(count, 9, 3, 4)), np.array([0.1, 1.0, 3.0])
    whole = VariableProjection(counts, tangent).reduced(columns, scale)
    for window in range(count):
        alone = VariableProjection(counts[window, None], tangent[window, None]).reduced(columns[window, None], scale)
        np.testing.assert_allclose(whole[window], alone[0], rtol=1e-9, atol=1e-9)


@given(arrays(np.float64, 3, elements=st.floats(1e-3, 10.0)), st.integers(0, 100))
def test_squares_need_no_reduced_column(scale: Any, seed: int) -> None:
    counts, tangent, residuals = _random_windows(seed)
    taken = VariableProjection(counts, tangent)
    reduced = taken.reduced(np.moveaxis(residuals, 0, -1), scale).reshape(7, 9, 3, 4)
    wanted = (reduced**2).sum(axis=(0, 1)) * scale[:, None] ** 2
    np.testing.assert_allclose(taken.squares(taken.products(residuals), scale), wanted, rtol=1e-9)


def test_rows_outside_the_stretches_do_not_count(plain, drive):
    run = drive(plain, 10.0, stretches=[(3, 50), (60, 200)])
    windows = windows_of([run], 0.5)
    used = np.concatenate([np.arange(3, 50), np.arange(60, 200)])
    np.testing.assert_array_equal(windows.t, run.t[used])
    # the window that would start at used row 40 has 6 rows left, of which 0.5 s takes 10
    assert windows.start.tolist() == [0, 10, 20, 30, *range(50, 177, 10)]
    assert windows_of([run], 0.5, partial=True).start.tolist() == list(range(0, 181, 10))


@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    cuts=st.lists(st.integers(1, 239), unique=True, max_size=5),
    horizon=st.floats(0.06, 1.0),
    stride=st.integers(1, 12),
    jitter=st.sampled_from([0.0, 0.2, 0.8]),
    partial=st.booleans(),
)
def test_no_window_crosses_a_cut(plain, drive, cuts, horizon, stride, jitter, partial):
    edges = [0, *sorted(cuts), 240]
    run = drive(plain, 12.0, jitter=jitter, stretches=list(pairwise(edges)))
    windows = windows_of([run], horizon, stride=stride, partial=partial)
    for start, end in zip(windows.start, windows.end, strict=True):
        assert start % stride == 0
        assert any(first <= start < end < stop for first, stop in pairwise(edges))
        assert run.t[end] <= run.t[start] + horizon + 0.5 * run.period + 1e-9


def test_several_runs_share_one_table(plain, drive):
    runs = [drive(plain, 5.0, seed=1, name="one"), drive(plain, 8.0, seed=2, name="two", period=0.02)]
    windows = windows_of(runs, 0.5, every=0.1)
    assert np.bincount(windows.run).tolist() == [45, 75]
    assert set(windows.steps[windows.run == 0]) == {10}
    assert set(windows.steps[windows.run == 1]) == {25}
    assert (windows.time[windows.start[windows.run == 1]] < 8.0).all()
    assert (np.diff(windows.clock) > 0).all()


def test_rows_after_takes_the_nearest_row_inside_the_window(plain, drive):
    windows = windows_of([drive(plain, 10.0, jitter=0.5)], 1.0)
    for seconds in (0.001, 0.3, 0.77, 5.0):
        rows = windows.rows_after(seconds)
        for start, end, row in zip(windows.start, windows.end, rows, strict=True):
            inside = np.arange(start + 1, end + 1)
            distance = np.abs(windows.t[inside] - windows.t[start] - seconds)
            assert abs(windows.t[row] - windows.t[start] - seconds) == pytest.approx(distance.min())


def recording(*parts: Any, name: str = "one") -> Run:
    """Stretches with these times; the angle counts the rows, the rate is half as much, the torque three times."""
    t = np.array([second for part in parts for second in part])
    ends = np.cumsum([0, *(len(part) for part in parts)]).tolist()
    rows = np.arange(len(t), dtype=float)
    stretches = tuple(Stretch(start, stop) for start, stop in pairwise(ends))
    return Run(name, PENDULUM, t, np.stack([rows, 0.5 * rows], axis=1), 3.0 * rows[:, None], stretches)


def quarters(count: int, start: float = 0.0) -> list[float]:
    return [start + 0.25 * row for row in range(count)]


def test_the_table_holds_every_trusted_row_of_every_run() -> None:
    one = recording([], [10.0, 10.25, 10.75, 11.0], [20.0, 20.25, 20.5])
    two = recording(quarters(4, 500.0), [], name="two")
    found = windows_of([one, two], 0.5, stride=1)
    assert (found.names, found.horizon, found.system, len(found)) == (("one", "two"), 0.5, PENDULUM, 5)
    assert found.time.tolist() == [0.0, 0.25, 0.75, 1.0, 10.0, 10.25, 10.5, 0.0, 0.25, 0.5, 0.75]
    assert found.period.tolist() == [0.25, 0.5, *[0.25] * 9]
    for name in ("t", "states", "actions"):
        assert getattr(found, name).tolist() == [*getattr(one, name).tolist(), *getattr(two, name).tolist()]
    assert found.bounds.tolist() == [[0, 0], [0, 4], [4, 7], [7, 11], [11, 11]]
    columns = (found.start, found.steps, found.end, found.begin, found.run)
    wanted = [[0, 1, 4, 7, 8], [1, 1, 2, 2, 2], [1, 2, 6, 9, 10], [0, 0, 4, 7, 7], [0, 0, 0, 1, 1]]
    assert [column.tolist() for column in columns] == wanted
    assert "memo" not in repr(found)


@pytest.mark.parametrize(("period", "horizon"), [(0.25, 0.25), (0.25, 4.0), (4.0, 2.0), (4.0, 8.0)])
def test_the_clock_gap_between_stretches_is_longer_than_a_window(period: float, horizon: float) -> None:
    times = period * np.arange(20)
    clock = windows_of([recording(100.0 + times, 300.0 + times), recording(7.0 + times, name="two")], horizon).clock
    assert clock[:20].tolist() == times.tolist()
    steps = np.diff(clock)
    assert (steps[[19, 39]] > horizon + 0.5 * period).all()
    assert (np.delete(steps, [19, 39]) == period).all()


@pytest.mark.parametrize(("jitter", "same"), [(0.0, True), (5e-7, True), (1e-5, False), (0.5, False)])
@pytest.mark.parametrize("period", [0.01, 4.0])
def test_rows_have_a_common_period_if_it_varies_by_a_millionth_at_most(period, jitter, same):
    steps = np.full(20, period)
    steps[7] *= 1.0 + jitter
    found = windows_of([recording(np.concatenate([[0.0], np.cumsum(steps)]).tolist())], 4.0 * period).common_period
    assert found == (pytest.approx(period, rel=1e-6) if same else None)


@pytest.mark.parametrize("index", [np.array([1, 4]), np.array([False, True, False, False, True])])
def test_a_selection_keeps_the_table_and_the_run_of_each_window(index: Any) -> None:
    found = windows_of([recording(quarters(9)), recording(quarters(4, 90.0), name="two")], 0.5, stride=2)
    assert (found.start.tolist(), found.run.tolist()) == ([0, 2, 4, 6, 9], [0, 0, 0, 0, 1])
    chosen = found.select(index)
    columns = (chosen.start, chosen.steps, chosen.begin, chosen.run)
    assert [column.tolist() for column in columns] == [[2, 9], [2, 2], [0, 9], [0, 1]]
    assert chosen.memo is found.memo
    assert chosen.clock is found.clock


@pytest.mark.parametrize(
    ("seconds", "rows"),
    [
        (0.0, [1, 2]), (0.01, [1, 2]), (0.25, [1, 2]), (0.37, [1, 2]), (0.375, [1, 2]), (0.38, [2, 3]), (0.5, [2, 3]),
        (0.6, [2, 3]), (0.65, [3, 4]), (0.75, [3, 4]), (9.0, [3, 4]), (-9.0, [1, 2]),
    ],
)  # fmt: skip
def test_of_two_equally_close_rows_the_earlier_one_is_chosen(seconds: float, rows: list[int]) -> None:
    assert windows_of([recording(quarters(5, 40.0))], 0.75, stride=1).rows_after(seconds).tolist() == rows
    one = windows_of([recording(quarters(3, 40.0))], 0.25, stride=1)
    assert one.rows_after(seconds).tolist() == [1, 2], "each window has one row"


@pytest.mark.parametrize(
    ("options", "starts"),
    [
        ({}, [0, 10, 20, 30]), ({"stride": 15}, [0, 15, 30]), ({"every": 0.01}, range(39)),
        ({"every": 0.25}, range(39)), ({"every": 0.5}, range(0, 39, 2)),
        ({"every": 0.7}, range(0, 39, 3)), ({"every": 1.5}, range(0, 39, 6)),
    ],
)  # fmt: skip
def test_a_stride_in_seconds_is_rounded_to_rows_one_at_least(options: Any, starts: Any) -> None:
    assert windows_of([recording(quarters(40))], 0.25, **options).start.tolist() == list(starts)


@pytest.mark.parametrize("partial", [True, False])
def test_the_stride_counts_on_over_stretches_and_begins_again_with_each_run(partial: bool) -> None:
    runs = [recording(quarters(4), quarters(8, 50.0)), recording(quarters(9), name="two")]
    assert windows_of(runs, 0.25, stride=3, partial=partial).start.tolist() == [0, 6, 9, 12, 15, 18]


@pytest.mark.parametrize(
    ("horizon", "steps"),
    [(0.13, [1, 1, 1, 1]), (0.37, [1, 1, 1, 1]), (0.375, [2, 2, 2, 1]), (0.38, [2, 2, 2]), (0.62, [2, 2, 2]),
     (0.625, [3, 3, 2]), (1.125, [4])],
)  # fmt: skip
def test_a_window_ends_within_half_a_period_of_the_horizon(horizon: float, steps: list[int]) -> None:
    found = windows_of([recording(quarters(5, 40.0))], horizon, stride=1)
    assert (found.steps.tolist(), found.start.tolist()) == (steps, list(range(len(steps))))


def test_windows_that_are_cut_short_are_kept_on_request_if_one_is_whole() -> None:
    run = recording(quarters(5, 40.0), quarters(2, 90.0))
    found = windows_of([run], 1.0, stride=1, partial=True)
    assert (found.start.tolist(), found.steps.tolist()) == ([0, 1, 2, 3, 5], [4, 3, 2, 1, 1])
    assert windows_of([run], 1.0, stride=1).start.tolist() == [0]
    with pytest.raises(InputError):
        windows_of([run], 1.2, stride=1, partial=True)


LONG = (recording([], quarters(3, 60.0), quarters(7, 70.0)), recording(quarters(2), name="two"))


@pytest.mark.parametrize(
    ("runs", "horizon", "message"),
    [
        *(([recording(quarters(9))], wrong, f"got {wrong} s, wanted a positive number of seconds, such as 1")
          for wrong in (0.0, -1.0, float("nan"), float("inf"), float("-inf"))),
        ([recording([0.0, 0.5, 1.0], []), recording(quarters(9), name="two")], 0.1,
         "got 0.1 s, the rows are 0.25 s apart; choose at least that"),
        (LONG, 2.0, "got 2.0 s, the longest stretch without a gap lasts 1.5 s; choose a shorter horizon"),
        *(([recording(quarters(3), quarters(7, 60.0))], horizon,
           f"got {horizon} s, but no window begins in a part without a gap of that length, although the longest "
           "stretch without a gap lasts 1.5 s; choose another horizon, or begin more windows")
          for horizon in (1.0, 1.5)),
        ([recording([0.0, 1.0, 1.25, 1.5])], 0.25,
         "got 0.25 s, but no window begins in a part without a gap of that length, although the longest stretch "
         "without a gap lasts 1.5 s; choose another horizon, or begin more windows"),
    ],
)  # fmt: skip
def test_an_impossible_horizon_is_rejected_with_the_possible_one(runs, horizon, message):
    with pytest.raises(InputError) as refused:
        windows_of(runs, horizon)
    assert str(refused.value) == f"horizon: {message}"


@pytest.mark.parametrize(
    "changes",
    [
        {"name": "crane"}, {"state": PENDULUM.state[::-1]}, {"action": (replace(PENDULUM.action[0], name="push"),)},
    ],
)  # fmt: skip
def test_runs_of_different_systems_are_refused(changes: Any) -> None:
    run, system = recording(quarters(9)), replace(PENDULUM, **changes)
    check_runs([run, replace(run, name="two", system=replace(PENDULUM))])
    with pytest.raises(RunError) as refused:
        check_runs([run, replace(run, name="two", system=system)])
    assert str(refused.value) == (
        f"two: a run of robot '{system.name}' with actions {system.action_names[0]} next to one of 'pendulum' with "
        "torque; compare them one at a time"
    )


@pytest.mark.parametrize("parts", [[], [[]], [[0.0], [5.0]]])
def test_a_run_without_two_consecutive_rows_is_refused(parts: Any) -> None:
    check_runs([recording([0.0], [5.0, 5.25], [])])
    with pytest.raises(RunError, match=r"^runs: got none, wanted at least one recording$"):
        check_runs([])
    with pytest.raises(RunError, match=r"^two: no two rows that can be used follow each other"):
        windows_of([recording(quarters(2)), recording(*parts, name="two")], 0.25)


@pytest.mark.parametrize("wrong", [float("nan"), float("inf")])
@pytest.mark.parametrize("field", ["states", "actions"])
def test_numbers_that_are_not_finite_are_refused_inside_a_stretch(field: str, wrong: float) -> None:
    run = recording(quarters(9), quarters(9, 50.0))
    values = getattr(run, field).copy()
    values[12, 0] = wrong
    changed: dict[str, Any] = {field: values}
    broken = replace(run, **changed)
    with pytest.raises(RunError, match=r"^one: got values that are not finite inside a stretch; cut those rows out$"):
        check_runs([broken])
    assert len(windows_of([replace(broken, stretches=(Stretch(0, 12), Stretch(13, 18)))], 0.25).t) == 17


def windows_of_runs(*runs: tuple[int, float]) -> Any:
    """Of each run so many windows of 1 s, one after the other, the first at so many s by its clock."""
    counts = [count for count, _ in runs]
    clock = np.concatenate([first + np.arange(count + 1) for count, first in runs])
    start = np.concatenate([np.arange(count) + sum(c + 1 for c in counts[:at]) for at, count in enumerate(counts)])
    own = {"names": "abcdef"[: len(runs)], "run": np.repeat(np.arange(len(runs)), counts), "clock": clock}
    return type("Windows", (), {**own, "start": start, "end": start + 1, "__len__": lambda _: sum(counts)})()


@pytest.mark.parametrize(
    ("runs", "folds", "found"),
    [
        (((3, 0.0), (2, 5.0), (4, 0.0)), 5, [0] * 3 + [1] * 2 + [2] * 4),  # three runs are held out whole
        (((1, 0.0), (1, 0.0), (1, 0.0), (2, 0.0)), 3, [0, 1, 2, 0, 0]), (((1, 0.0),) * 7, 2, [0, 1, 0, 1, 0, 1, 0]),
        (((10, 0.0),), 5, [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]),  # of fewer, stretches of time in each
        (((10, 100.0), (4, 7.0)), 2, [0] * 5 + [1] * 5 + [0, 0, 1, 1]),
        (((4, 0.0), (10, 50.0)), 2, [0, 0, 1, 1] + [0] * 5 + [1] * 5),
    ],
)  # fmt: skip
def test_folds_are_runs_or_equal_stretches_of_time(runs: Any, folds: int, found: list[int]) -> None:
    """A fit that has seen the other half of a run knows its day, load and battery: nothing of it is unseen then."""
    assert folds_of(windows_of_runs(*runs), folds).tolist() == found


def row_by_row(command, columns, own, windows):
    """The felt columns by the effect's own equations, one row after the other in each stretch."""
    felt = {name: np.zeros(len(column)) for name, column in columns.items()}
    for begin, stop in windows.bounds.tolist():
        memory = None
        for row in range(begin, stop):
            action = {name: float(column[row]) for name, column in columns.items()}
            memory = command.initial_memory(action) if row == begin else memory
            out, memory = command.transform(action, memory, own, float(windows.period[row]), FLOATS)
            for name, column in felt.items():
                column[row] = out[name]
    return felt


@pytest.mark.parametrize("jitter", [0.0, 0.6])
@pytest.mark.parametrize("value", [0.0, 0.013, 0.05, 0.17, 0.43])
@pytest.mark.parametrize("name", ["steering_delay", "drive_delay", "actuator_delay", "steering_lag", "drive_lag"])
def test_lags_and_delays_of_whole_stretches_are_exact(plain, drive, name, value, jitter):
    run = drive(plain, 12.0, jitter=jitter, stretches=[(0, 100), (100, 101), (130, 240)])
    windows = windows_of([run], 0.5)
    columns = {key: windows.actions[:, index] for index, key in enumerate(windows.system.action_names)}
    command = effect("car", name)
    own = {command.parameters[0].name: value}
    fast, slow = effective_action_columns(command, columns, own, windows), row_by_row(command, columns, own, windows)
    assert set(fast) == set(slow)
    for key, column in slow.items():
        np.testing.assert_allclose(fast[key], column, atol=1e-9)


def _remembering(robot):
    """The robot's own effects that remember commands, and those that every system has, by name."""
    system = robot_named(robot).system
    zero = dict.fromkeys(system.action_names, 0.0)
    every = {item.name: item for item in (*general_effects(system), *effects_of(robot).values())}
    commands = [item for item in every.values() if isinstance(item, CommandEffect)]
    return [item for item in commands if item.initial_memory(zero) is not None]


@pytest.mark.parametrize("robot", robots())
def test_the_actuators_of_every_robot_are_exact(robot):
    system = robot_named(robot).system
    random = np.random.default_rng(8)
    actions = np.cumsum(random.normal(0.0, 0.1, (200, len(system.action))), axis=0)
    run = Run("own", system, 0.05 * np.arange(200), np.zeros((200, len(system.state))), actions, (Stretch(0, 200),))
    windows = windows_of([run], 0.5)
    columns = {key: windows.actions[:, index] for index, key in enumerate(system.action_names)}
    assert _remembering(robot), "there is an effect to look at"
    for command in _remembering(robot):
        own = {parameter.name: 1.3 * parameter.typical for parameter in command.parameters}
        fast, slow = (
            effective_action_columns(command, columns, own, windows),
            row_by_row(command, columns, own, windows),
        )
        assert fast is not None, f"{command.name} is followed row by row"
        for key, column in slow.items():
            np.testing.assert_allclose(fast[key], column, atol=1e-9, err_msg=f"{robot} {command.name}: {key}")


@pytest.mark.parametrize("width", [0.0, 0.02, 0.4, 10.0])
def test_backlash_of_whole_stretches_is_exact(width):
    model = load_model("dfki_pendulum")
    random = np.random.default_rng(3)
    torque = np.cumsum(random.normal(0.0, 0.1, 400))
    states = np.column_stack([np.zeros(400), random.normal(0.0, 1.0, 400)])
    stretches = (Stretch(0, 150), Stretch(150, 160), Stretch(200, 400))
    run = Run("play", model.system, 0.01 * np.arange(400), states, torque[:, None], stretches)
    windows = windows_of([run], 0.05)
    columns = {"torque": windows.actions[:, 0]}
    command, own = effect("pendulum", "backlash"), {"width": width}
    fast, slow = effective_action_columns(command, columns, own, windows), row_by_row(command, columns, own, windows)
    np.testing.assert_array_equal(fast["torque"], slow["torque"])


def test_other_effects_are_left_to_their_own_equations(plain, drive):
    windows = windows_of([drive(plain, 5.0)], 0.5)
    columns = {"throttle": windows.actions[:, 0], "steer": windows.actions[:, 1]}
    assert effective_action_columns(effect("car", "drive_dead_zone"), columns, {"width": 0.1}, windows) is None


@pytest.mark.parametrize("name", ["steering_delay", "drive_lag"])
def test_an_effect_of_the_user_that_remembers_commands_acts_like_one_of_the_library(plain, drive, name):
    command = effect("car", name)
    own = object.__new__(type("Own", (type(command),), {"__module__": "users"}))
    own.__dict__.update(command.__dict__)
    windows = windows_of([drive(plain, 5.0, stretches=[(0, 40), (45, 100)])], 0.5)
    value = {command.parameters[0].name: Setting(0.17)}
    library, users = (effective_actions(plain.with_effect(item, value), windows) for item in (command, own))
    assert np.abs(library - windows.actions).max() > 0.1
    np.testing.assert_allclose(users, library, atol=1e-9)
