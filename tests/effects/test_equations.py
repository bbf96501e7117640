"""Effects against equations worked out by hand, closed forms and conservation laws."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.dynamics import PhysicsModel, Setting
from safedpa.effects import effect
from safedpa.effects.memory import delayed, follow, settled
from safedpa.operations import FLOATS, NUMPY
from safedpa.robots.car.kinematic_bicycle import KinematicBicycle
from safedpa.robots.pendulum.rigid_pendulum import RigidPendulum

INSTANT = 1e-6  # s

SPEED, STEER, YAW = 2.0, 0.2, 0.6
CAR_CASES = [
    ("quadratic_drag", {"coefficient": 0.1}, {"speed": -0.1 * 4.0}),
    ("viscous_drag", {"coefficient": 0.3}, {"speed": -0.3 * 2.0}),
    ("rolling_resistance", {"deceleration": 0.4}, {"speed": -0.4}),
    ("constant_force", {"ax": 0.5, "ay": 0.2}, {"speed": 0.5 * math.cos(YAW) + 0.2 * math.sin(YAW)}),
    ("payload", {"mass_ratio": 0.25}, {"speed": 4.0 / 1.25 - 4.0}),
    ("towed_load", {"mass_ratio": 0.25, "deceleration": 2.0}, {"speed": (4.0 - 0.5) / 1.25 - 4.0}),
    ("turning_drag", {"coefficient": 3.0}, {"speed": -3.0 * 4.0 * 0.04}),
    ("back_emf", {"coefficient": 1.5}, {"speed": -1.5 * 0.5 * 2.0}),
    ("crosswind_drift", {"vx": 0.3, "vy": -0.2}, {"x": 0.3, "y": -0.2}),
    ("understeer", {"gradient": 0.03}, {"yaw": 2 * math.tan(STEER) * (1 / (0.32 + 0.12) - 1 / 0.32)}),
    ("steering_offset", {"angle": 0.05}, {"yaw": 2 * (math.tan(0.25) - math.tan(STEER)) / 0.32}),
    ("steering_gain", {"gain": 0.8}, {"yaw": 2 * (math.tan(0.16) - math.tan(STEER)) / 0.32}),
    ("steering_asymmetry", {"difference": 0.2}, {"yaw": 2 * (math.tan(0.22) - math.tan(STEER)) / 0.32}),
    ("steering_saturation", {"limit": 0.15}, {"yaw": 2 * (math.tan(0.15) - math.tan(STEER)) / 0.32}),
    ("drive_dead_zone", {"width": 0.2}, {"speed": -8.0 * 0.2}),
]

ANGLE, RATE, TORQUE, INERTIA = 0.5, -1.5, 0.8, 0.6 * 0.25
PENDULUM_CASES = [
    ("viscous_friction", {"coefficient": 0.2}, 0.2 * 1.5 / INERTIA),
    ("coulomb_friction", {"torque": 0.3}, 0.3 / INERTIA),
    ("stribeck_friction", {"torque": 0.3, "fading_rate": 1.5}, 0.3 * math.exp(-1.0) / INERTIA),
    ("torque_offset", {"offset": 0.1}, 0.1 / INERTIA),
    ("torque_gain", {"gain": 0.7}, -0.3 * TORQUE / INERTIA),
    ("spring", {"stiffness": 2.0, "rest_angle": 0.1}, -2.0 * 0.4 / INERTIA),
    ("angle_offset", {"offset": 0.1}, 9.81 / 0.5 * (math.sin(0.4) - math.sin(0.5))),
    ("tip_mass", {"mass": 0.2}, TORQUE * (1 / 0.2 - 1 / INERTIA)),
]


@pytest.mark.parametrize(("name", "values", "change"), CAR_CASES, ids=[case[0] for case in CAR_CASES])
def test_car(name: str, values: dict[str, float], change: dict[str, float]) -> None:
    base = {"base.wheelbase": Setting(0.32), "base.drive_gain": Setting(8.0)}
    plain = PhysicsModel(KinematicBicycle("throttle"), (), base, INSTANT)
    model = plain.with_effect(effect("car", name), {key: Setting(value) for key, value in values.items()})
    state, action = np.array([0.0, 0.0, YAW, SPEED]), np.array([0.5, STEER])
    added = (model.step(state, action) - plain.step(state, action)) / INSTANT
    expected = [change.get(entry, 0.0) for entry in ("x", "y", "yaw", "speed")]
    np.testing.assert_allclose(added, expected, atol=1e-4)


@pytest.mark.parametrize(("name", "values", "change"), PENDULUM_CASES, ids=[case[0] for case in PENDULUM_CASES])
def test_pendulum(name: str, values: dict[str, float], change: float) -> None:
    base = {"base.length": Setting(0.5), "base.mass": Setting(0.6), "base.gravity": Setting(9.81)}
    plain = PhysicsModel(RigidPendulum(), (), base, INSTANT)
    model = plain.with_effect(effect("pendulum", name), {key: Setting(value) for key, value in values.items()})
    state, action = np.array([ANGLE, RATE]), np.array([TORQUE])
    added = (model.step(state, action) - plain.step(state, action)) / INSTANT
    np.testing.assert_allclose(added, [0.0, change], atol=1e-3)


def test_speed_command_gain_moves_the_settled_speed() -> None:
    base = {"base.wheelbase": Setting(0.32), "base.speed_gain": Setting(4.0), "base.acceleration_limit": Setting(5.0)}
    model = PhysicsModel(KinematicBicycle(), (), base).with_effect(
        effect("car", "speed_command_gain"), {"gain": Setting(0.8)}
    )
    state = np.zeros(4)
    for _ in range(200):
        state = model.step(state, np.array([1.5, 0.0]))
    assert state[3] == pytest.approx(1.2)


SOME = settings(max_examples=100, deadline=None)


def pendulum(**values: float) -> PhysicsModel:
    values = {"length": 0.5, "mass": 0.6, "gravity": 9.81, **values}
    return PhysicsModel(RigidPendulum(), (), {f"base.{n}": Setting(v) for n, v in values.items()}, 0.01)


def throttle_car(period: float = 0.05) -> PhysicsModel:
    values = {"base.wheelbase": Setting(0.32), "base.drive_gain": Setting(8.0)}
    return PhysicsModel(KinematicBicycle("throttle"), (), values, period)


def servo_car() -> PhysicsModel:
    values = {"wheelbase": 0.32, "speed_gain": 4.0, "acceleration_limit": 5.0}
    return PhysicsModel(KinematicBicycle(), (), {f"base.{n}": Setting(v) for n, v in values.items()})


def added(model: PhysicsModel, name: str, **values: float) -> PhysicsModel:
    item = effect(model.system.name, name)
    return model.with_effect(item, {name: Setting(value) for name, value in values.items()})


@SOME
@given(time_constant=st.floats(1e-3, 2.0), period=st.floats(1e-3, 0.5), start=st.floats(-3, 3), target=st.floats(-3, 3))
def test_lag_is_the_exact_step_response(time_constant: float, period: float, start: float, target: float) -> None:
    felt = start
    for tick in range(1, 6):
        mean, felt = follow(target, felt, time_constant, period, FLOATS)
        exact = target + (start - target) * math.exp(-tick * period / time_constant)
        assert felt == pytest.approx(exact, abs=1e-9)
        fall = math.exp(-(tick - 1) * period / time_constant) - math.exp(-tick * period / time_constant)
        exact_mean = target + (start - target) * fall * time_constant / period
        assert mean == pytest.approx(exact_mean, abs=1e-9)


def test_lag_of_zero_is_none_and_has_a_slope() -> None:
    torch = pytest.importorskip("torch")
    from safedpa.operations import torch_operations

    time_constant = torch.zeros((), dtype=torch.float64, requires_grad=True)
    mean, felt = follow(2.0, 0.5, time_constant, 0.1, torch_operations())
    assert mean.item() == felt.item() == 2.0
    mean.backward()
    assert time_constant.grad.item() == pytest.approx((0.5 - 2.0) / 0.1)


def mean_of_delayed(commands: list[float], durations: list[float], first: float, delay: float, tick: int) -> float:
    """Mean of command(t - delay) over period ``tick``, by cutting it at every change of command."""
    edges = np.concatenate([[0.0], np.cumsum(durations)])
    low, high = edges[tick] - delay, edges[tick + 1] - delay
    cuts = np.unique(np.concatenate([[low, high], edges[(edges > low) & (edges < high)]]))
    total = 0.0
    for begin, end in pairwise(cuts):
        middle = 0.5 * (begin + end)
        index = int(np.searchsorted(edges, middle, side="right")) - 1
        total += (end - begin) * (first if index < 0 else commands[index])
    return total / durations[tick]


@SOME
@given(
    pairs=st.lists(st.tuples(st.floats(-3, 3), st.floats(0.01, 0.2)), min_size=1, max_size=12),
    first=st.floats(-3, 3),
    delay=st.floats(0.0, 0.5),
)
def test_delay_is_exact_for_periods_of_any_length(pairs: list[tuple[float, float]], first: float, delay: float) -> None:
    commands, durations = [list(column) for column in zip(*pairs, strict=True)]
    history = many_history = settled(first)
    for tick, (command, duration) in enumerate(pairs):
        felt, history = delayed(command, history, delay, 0.5, duration, FLOATS)
        delays = np.array([delay, 0.0])
        many, many_history = delayed(command, many_history, delays, 0.5, duration, NUMPY)
        exact = mean_of_delayed(commands, durations, first, delay, tick)
        assert felt == pytest.approx(exact, abs=1e-9)
        np.testing.assert_allclose(many, [exact, command], atol=1e-9)
        assert sum(seconds for _, seconds in history[:-1]) <= 0.5 + 0.2


def test_steering_delay_moves_the_yaw_rate_by_its_seconds() -> None:
    model = added(servo_car(), "steering_delay", seconds=0.1)
    state, memory = np.array([0.0, 0.0, 0.0, 1.0]), model.initial_memory(np.array([1.0, 0.0]))
    yaws = []
    for _ in range(5):
        state, memory = model.advance(state, np.array([1.0, 0.3]), memory)
        yaws.append(state[2])
    assert yaws[:2] == [0.0, 0.0]
    rate = math.tan(0.3) / 0.32
    np.testing.assert_allclose(np.diff(yaws)[1:], 0.05 * rate, rtol=1e-9)


@pytest.mark.parametrize("name", ["drive_lag", "drive_delay", "actuator_delay"])
@pytest.mark.parametrize("model", [servo_car(), throttle_car()], ids=["servo", "throttle"])
def test_drive_channel_effects_work_for_either_drive(name: str, model: PhysicsModel) -> None:
    slow = added(model, name, **{effect("car", name).parameters[0].name: 0.2})
    memory = slow.initial_memory(np.array([0.0, 0.0]))
    late = slow.advance(np.zeros(4), np.array([0.5, 0.0]), memory)[0]
    prompt = model.step(np.zeros(4), np.array([0.5, 0.0]))
    assert 0.0 <= late[3] < 0.5 * prompt[3]


def energy(state: np.ndarray, length: float = 0.5, mass: float = 0.6, gravity: float = 9.81) -> float:
    return float(0.5 * mass * (length * state[1]) ** 2 + mass * gravity * length * math.cos(state[0]))


@pytest.mark.parametrize("name", ["viscous_friction", "coulomb_friction", "stribeck_friction", "wind"])
@settings(max_examples=15, deadline=None)
@given(angle=st.floats(-3, 3), rate=st.floats(-10, 10), share=st.floats(0.01, 1.0))
def test_energy_never_grows_under_friction(name: str, angle: float, rate: float, share: float) -> None:
    item = effect("pendulum", name)
    values = {p.name: share * p.high for p in item.parameters}
    if name == "wind":
        values["speed"] = values["upward"] = 0.0  # still air only brakes
    model = added(pendulum(), name, **values)
    state, torque = np.array([angle, rate]), np.zeros(1)
    before = energy(state)
    for _ in range(60):
        state = model.step(state, torque)
        assert energy(state) <= before + 1e-6
        before = energy(state)


@pytest.mark.parametrize(
    "name", ["quadratic_drag", "viscous_drag", "rolling_resistance", "towed_load", "turning_drag", "back_emf"]
)
@settings(max_examples=15, deadline=None)
@given(speed=st.floats(-6, 6), share=st.floats(0.01, 1.0), steer=st.floats(-0.6, 0.6))
def test_coasting_car_never_speeds_up_nor_turns_back(name: str, speed: float, share: float, steer: float) -> None:
    values = {p.name: share * p.high for p in effect("car", name).parameters}
    model = added(throttle_car(), name, **values)
    state = np.array([0.0, 0.0, 0.0, speed])
    for _ in range(30):
        after = model.step(state, np.array([0.0, steer]))
        assert abs(after[3]) <= abs(state[3])
        assert after[3] * state[3] >= 0.0
        state = after


def test_rolling_resistance_brings_a_car_to_rest_as_fast_as_it_says() -> None:
    model = added(throttle_car(), "rolling_resistance", deceleration=0.5)
    state = np.array([0.0, 0.0, 0.0, 2.0])
    for _ in range(40):
        state = model.step(state, np.zeros(2))
    assert state[3] == pytest.approx(2.0 - 0.5 * 40 * 0.05, abs=1e-9)
    for _ in range(100):
        state = model.step(state, np.zeros(2))
    assert abs(state[3]) < 1e-3


def test_quadratic_drag_has_its_closed_form() -> None:
    model = added(throttle_car(), "quadratic_drag", coefficient=0.3)
    state = np.array([0.0, 0.0, 0.0, 3.0])
    for _ in range(20):
        state = model.step(state, np.zeros(2))
    assert state[3] == pytest.approx(3.0 / (1.0 + 0.3 * 3.0 * 1.0), rel=1e-6)
    assert state[0] == pytest.approx(math.log(1.0 + 0.3 * 3.0) / 0.3, rel=1e-6)


def test_back_emf_settles_where_voltage_and_motor_balance() -> None:
    model = added(throttle_car(), "back_emf", coefficient=2.0)
    state = np.zeros(4)
    for _ in range(400):
        state = model.step(state, np.array([0.6, 0.0]))
    assert state[3] == pytest.approx(8.0 / 2.0, rel=1e-6)


def test_dead_zone_is_dead_inside_and_shifted_outside() -> None:
    model = added(throttle_car(), "drive_dead_zone", width=0.164)
    assert model.step(np.zeros(4), np.array([0.16, 0.0]))[3] == 0.0
    for throttle in (0.5, -0.5):
        expected = 8.0 * 0.05 * (throttle - math.copysign(0.164, throttle))
        assert model.step(np.zeros(4), np.array([throttle, 0.0]))[3] == pytest.approx(expected)


def test_understeer_is_the_steady_state_formula() -> None:
    model = added(throttle_car(), "understeer", gradient=0.03)
    state = model.step(np.array([0.0, 0.0, 0.0, 2.0]), np.array([0.0, 0.2]))
    assert state[2] == pytest.approx(0.05 * 2.0 * math.tan(0.2) / (0.32 + 0.03 * 4.0))


def test_tyre_slip_carries_the_car_to_the_outside_and_keeps_its_heading() -> None:
    state, action = np.array([0.0, 0.0, 0.0, 3.0]), np.array([0.0, 0.2])
    plain = throttle_car().step(state, action)
    slipping = added(throttle_car(), "tyre_slip", compliance=0.02).step(state, action)
    assert slipping[1] < plain[1]
    assert slipping[2] == plain[2]


def test_payload_leaves_the_deceleration_of_rolling_alone() -> None:
    light = added(throttle_car(), "rolling_resistance", deceleration=0.5)
    heavy = added(light, "payload", mass_ratio=1.0)
    state = np.array([0.0, 0.0, 0.0, 2.0])
    coast = [model.step(state, np.zeros(2))[3] for model in (light, heavy)]
    drive = [model.step(state, np.array([1.0, 0.0]))[3] for model in (light, heavy)]
    assert coast[0] == pytest.approx(coast[1])
    assert drive[1] - coast[1] == pytest.approx(0.5 * (drive[0] - coast[0]))


def test_battery_sag_weakens_the_drive_with_time() -> None:
    model = added(throttle_car(), "battery_sag", rate=0.01)
    action = np.array([1.0, 0.0])
    late, _ = model.advance(np.zeros(4), action, model.initial_memory(action), time=100.0)
    assert late[3] == pytest.approx(8.0 * 0.05 * math.exp(-0.01 * 100.025), rel=1e-6)
    f, g = model.affine(np.zeros(4), time=100.0)
    assert (f + g @ action)[3] == pytest.approx(late[3])


def test_sensor_scale_leaves_the_path_to_the_true_speed() -> None:
    model = added(throttle_car(), "speed_sensor_scale", scale=1.25)
    state = model.step(np.array([0.0, 0.0, 0.0, 2.5]), np.zeros(2))
    np.testing.assert_allclose(state, [2.0 * 0.05, 0.0, 0.0, 2.5], atol=1e-12)


def test_tip_mass_is_the_pendulum_with_that_mass() -> None:
    state, torque = np.array([0.7, -1.0]), np.array([0.8])
    heavier = added(pendulum(mass=0.6), "tip_mass", mass=0.4).step(state, torque)
    np.testing.assert_allclose(heavier, pendulum(mass=1.0).step(state, torque), rtol=1e-12)


def test_wind_pushes_as_much_as_its_source_says() -> None:
    model = added(pendulum(gravity=0.0, mass=1.0), "wind", speed=4.0, drag=0.5)
    model = PhysicsModel(model.base, model.effects, model.settings, 1e-4)
    rate = model.step(np.zeros(2), np.zeros(1))[1]
    assert rate / 1e-4 * 1.0 * 0.25 == pytest.approx(0.5 * 0.5 * 16.0, rel=1e-3)  # length C_d w^2 = 4.0 N m


def test_wind_of_any_direction_pushes_across_the_rod() -> None:
    for angle in (0.3, 2.0, 4.0):
        model = added(pendulum(gravity=0.0, mass=1.0), "wind", speed=0.0, upward=4.0, drag=0.5)
        model = PhysicsModel(model.base, model.effects, model.settings, 1e-4)
        rate = model.step(np.array([angle, 0.0]), np.zeros(1))[1]
        assert rate / 1e-4 * 0.25 == pytest.approx(-0.5 * 0.5 * 16.0 * math.sin(angle), rel=1e-3)


def test_backlash_is_a_loop() -> None:
    item = effect("pendulum", "backlash")
    felt, memory = [], 0.0
    for torque in (1.0, 2.0, 1.8, 1.4, -1.0):
        action, memory = item.transform({"torque": torque}, memory, {"width": 0.6}, 0.01, FLOATS)  # type: ignore[attr-defined]
        felt.append(action["torque"])
    assert felt == pytest.approx([0.7, 1.7, 1.7, 1.7, -0.7])


def test_spring_swings_at_its_own_frequency() -> None:
    model = added(pendulum(gravity=0.0), "spring", stiffness=6.0, rest_angle=0.3)
    state = np.array([0.5, 0.0])
    for _ in range(100):
        state = model.step(state, np.zeros(1))
    assert state[0] == pytest.approx(0.3 + 0.2 * math.cos(math.sqrt(6.0 / 0.15)), abs=1e-5)
