"""Effects against equations worked out by hand, closed forms and conservation laws; and effects with a law."""

import copy
import math
import pickle
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.dynamics import PhysicsModel, Setting, load_model, parse_model, write_model
from safedpa.effects import Varies, Where, conditioned, effect, effects_of
from safedpa.effects.channel_effects import delayed, follow, settled
from safedpa.effects.law import law_of, may_have_law
from safedpa.errors import ModelFileError
from safedpa.operations import FLOATS, NUMPY
from safedpa.robots.car.dynamics.kinematic_bicycle import KinematicBicycle
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
    plain = throttle_car(INSTANT)
    state, action = np.array([0.0, 0.0, YAW, SPEED]), np.array([0.5, STEER])
    found = (added(plain, name, **values).step(state, action) - plain.step(state, action)) / INSTANT
    np.testing.assert_allclose(found, [change.get(entry, 0.0) for entry in ("x", "y", "yaw", "speed")], atol=1e-4)


@pytest.mark.parametrize(("name", "values", "change"), PENDULUM_CASES, ids=[case[0] for case in PENDULUM_CASES])
def test_pendulum(name: str, values: dict[str, float], change: float) -> None:
    plain, state, action = pendulum().with_period(INSTANT), np.array([ANGLE, RATE]), np.array([TORQUE])
    found = (added(plain, name, **values).step(state, action) - plain.step(state, action)) / INSTANT
    np.testing.assert_allclose(found, [0.0, change], atol=1e-3)


def test_speed_command_gain_moves_the_settled_speed() -> None:
    model = added(servo_car(), "speed_command_gain", gain=0.8)
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
        assert mean == pytest.approx((target + (start - target) * fall * time_constant / period), abs=1e-9)


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
    assert 0.0 <= late[3] < 0.5 * model.step(np.zeros(4), np.array([0.5, 0.0]))[3]


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


def test_dead_zone_is_dead_inside_and_shifted_outside() -> None:
    model = added(throttle_car(), "drive_dead_zone", width=0.164)
    assert model.step(np.zeros(4), np.array([0.16, 0.0]))[3] == 0.0
    for throttle in (0.5, -0.5):
        expected = 8.0 * 0.05 * (throttle - math.copysign(0.164, throttle))
        assert model.step(np.zeros(4), np.array([throttle, 0.0]))[3] == pytest.approx(expected)


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


CAR = """
format = 1
robot = "car"
[base]
kind = "kinematic_bicycle"
drive = "speed_servo"
wheelbase = 0.32
speed_gain = 3.0
acceleration_limit = 6.0
"""
FLOOR = """
[[effects]]
name = "rolling_resistance"
where = "x above"
edge = 0.05
deceleration = 0.9
x_above = 1.0
"""
SAG = """
[[effects]]
name = "speed_command_gain"
varies = "gain with time"
gain = 1.0
gain_per_time = -0.004
"""
LAWS = (
    ("rolling_resistance", Where("above", "x", 0.05), {"deceleration": 0.9, "x_above": 1.0}),
    ("rolling_resistance", Where("circle", "", 0.05), {"deceleration": 0.9, "at_x": 1.0, "at_y": 0.0, "radius": 1.0}),
    ("rolling_resistance", Where("strip", "", 0.05), {"deceleration": 0.9, "angle": 0.3, "offset": 1.0,
                                                      "half_width": 0.5}),
    ("steering_gain", Where("between", "abs_speed", 0.05), {"gain": 0.8, "abs_speed_from": 0.5, "abs_speed_to": 1.5}),
    ("steering_gain", Varies("gain", "abs_speed"), {"gain": 1.0, "gain_per_abs_speed": -0.08}),
    ("speed_command_gain", Varies("gain", "time"), {"gain": 1.0, "gain_per_time": -0.004}),
    ("quadratic_drag", Where("below", "time", 0.5), {"coefficient": 0.2, "time_below": 20.0}),
)  # fmt: skip


def car(name=None, law=None, numbers=None, free=False) -> PhysicsModel:
    plain = parse_model(CAR)
    if name is None:
        return plain
    made = conditioned(effect("car", name), law, plain.system)
    return plain.with_effect(made, {key: Setting(value, free) for key, value in numbers.items()})


def step(model, state, action, time=0.0):
    action = np.array(action)
    return model.advance(np.array(state), action, model.initial_memory(action), model.latent, time=time)[0]


@pytest.mark.parametrize(
    ("law", "numbers", "outside", "inside"),
    [
        (Where("above", "x", 0.05), {"x_above": 1.0}, (0.0, 0.0), (2.0, 0.0)),
        (Where("below", "y", 0.05), {"y_below": 1.0}, (0.0, 2.0), (0.0, 0.0)),
        (Where("circle", "", 0.05), {"at_x": 5.0, "at_y": 1.0, "radius": 1.0}, (0.0, 0.0), (5.0, 1.2)),
        (Where("strip", "", 0.05), {"angle": 0.0, "offset": 3.0, "half_width": 0.5}, (0.0, 7.0), (3.0, -7.0)),
    ],
)
def test_a_region_has_the_plain_effect_inside_and_none_outside(law, numbers, outside, inside):
    model = car("rolling_resistance", law, {"deceleration": 0.9, **numbers})
    plain = car().with_effect(effect("car", "rolling_resistance"), {"deceleration": Setting(0.9)})
    for place, same in ((outside, car()), (inside, plain)):
        state = [*place, 0.3, 1.0]
        np.testing.assert_allclose(step(model, state, [1.0, 0.1]), step(same, state, [1.0, 0.1]), atol=1e-9)


def test_a_number_varies_in_proportion_and_stays_within_its_bounds():
    model = car("speed_command_gain", Varies("gain", "time"), {"gain": 1.0, "gain_per_time": -0.004})
    for time, gain in ((0.0, 1.0), (100.0, 0.6), (1e6, 0.1)):
        same = car().with_effect(effect("car", "speed_command_gain"), {"gain": Setting(gain)})
        at, alike = step(model, [0, 0, 0, 1.0], [1.5, 0.0], time), step(same, [0, 0, 0, 1.0], [1.5, 0.0])
        np.testing.assert_allclose(at, alike, atol=5e-5 if time < 1e6 else 1e-9)


def test_a_gain_with_a_law_acts_after_the_lag():
    lag = car().with_effect(effect("car", "steering_lag"), {"time_constant": Setting(0.2)})
    law = Where("above", "abs_speed", 0.01)
    made = conditioned(effect("car", "steering_gain"), law, lag.system)
    model = lag.with_effect(made, {"gain": Setting(0.5), "abs_speed_above": Setting(1.0)})
    state, action = np.array([0.0, 0.0, 0.0, 2.0]), np.array([2.0, 0.2])
    memory = model.initial_memory(np.array([2.0, 0.0]))
    turned, whole = (one.advance(state, action, memory)[0][2] for one in (model, lag))
    assert turned == pytest.approx(0.5 * whole, rel=0.01)


@pytest.mark.parametrize(("name", "law", "numbers"), LAWS)
def test_all_implementations_of_a_law_agree_and_have_slopes(name, law, numbers):
    model = car(name, law, numbers, free=True)
    slow = copy.deepcopy(model)  # uses the reference implementation for its first two hundred steps
    random = np.random.default_rng(4)
    for _ in range(250):
        step(model, [0, 0, 0, 1.0], [1.0, 0.1])
    assert model.scalar_step(model.period) is not None
    states = random.uniform([-1, -1, -3, -2], [3, 1, 3, 2], (40, 4))
    actions = random.uniform([-2, -0.5], [2, 0.5], (40, 2))
    batch = model.advance(states, actions, (), model.latent, time=15.0)[0]
    for state, action, many in zip(states, actions, batch, strict=True):
        one = step(model, state, action, 15.0)
        np.testing.assert_array_equal(one, step(slow, state, action, 15.0))
        np.testing.assert_allclose(one, many, rtol=0, atol=1e-12)
        g = model.affine(state, model.latent, around=action, time=15.0)[1]
        nudge = 1e-6 * np.eye(2)
        columns = [(step(model, state, action + e, 15.0) - step(model, state, action - e, 15.0)) / 2e-6 for e in nudge]
        np.testing.assert_allclose(g, np.stack(columns, axis=1), atol=1e-6)


def test_torch_has_gradients_in_border_and_rate():
    torch = pytest.importorskip("torch")
    model = car(*LAWS[0], free=True)
    latent = torch.tensor(model.latent, requires_grad=True)
    state = torch.tensor([[1.0, 0.0, 0.0, 1.5]], dtype=torch.float64)
    model.step(state, torch.tensor([[1.5, 0.0]], dtype=torch.float64), latent)[0, 3].backward()
    assert (latent.grad.abs() > 1e-6).all()


@pytest.mark.parametrize(("name", "law", "numbers"), LAWS)
def test_a_law_in_a_model_file_round_trips(name, law, numbers):
    model = car(name, law, numbers)
    text = write_model(model)
    again = parse_model(text)
    assert again.effects == model.effects
    assert hash(again.effects) == hash(model.effects)
    assert (again.settings, write_model(again)) == (model.settings, text)
    assert pickle.loads(pickle.dumps(model)).effects == model.effects


@pytest.mark.parametrize(
    ("text", "notice"),
    [
        (
            FLOOR.replace("x above", "x abvoe"),
            "rolling_resistance.where: got 'x abvoe', wanted 'VARIABLE above|below|between', say 'x above', or one of circle, strip",  # noqa: E501 - as the page has it, whole
        ),
        (FLOOR.replace("x above", "z above"), "where: got 'z'; known: abs_speed"),
        (FLOOR.replace("x above", "yaw above"), "got 'yaw'"),
        (FLOOR.replace("edge = 0.05\n", ""), "edge: missing; give the width over which it sets in"),
        (FLOOR.replace("edge = 0.05", "edge = 0.0"), "edge: got 0, wanted a width above 0 m"),
        (FLOOR.replace("x_above = 1.0\n", ""), "x_above: missing; give a number, -10000 to 10000 m"),
        (FLOOR.replace('where = "x above"', "where = 3"), "where: got 3, wanted 'VARIABLE"),
        (FLOOR + 'varies = "deceleration with time"\n', "got 'where' and 'varies'"),
        (FLOOR.replace('where = "x above"\n', ""), "edge: got it without 'where'"),
        (SAG.replace("gain with time", "gain with tide"), "varies: got 'tide'"),
        (SAG.replace("gain with time", "grain with time"), "varies: got 'grain'; did you mean 'gain'?"),
        (SAG.replace("gain with time", "gain"), "varies: got 'gain', wanted 'PARAMETER with VARIABLE'"),
        ('[[effects]]\nname = "steering_lag"\nwhere = "x above"\nedge = 0.1\n', "cannot depend on where and when"),
        ('[[effects]]\nname = "speed_sensor_scale"\nvaries = "scale with time"\n', "cannot depend on where and when"),
    ],
)
def test_a_mistake_is_reported_in_one_line(text, notice):
    with pytest.raises(ModelFileError) as error:
        parse_model(CAR + text)
    assert notice in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("robot", ["car", "pendulum", "point"])
def test_every_effect_that_may_have_a_law_steps_with_one(robot):
    model = load_model(robot)
    bare = PhysicsModel(model.base, (), {k: v for k, v in model.settings.items() if k.startswith("base.")})
    state, action = np.full(len(bare.system.state), 0.3), np.full(len(bare.system.action), 0.1)
    for item in effects_of(robot).values():
        if not may_have_law(item, bare.system) or not set(item.needs) <= set(bare.system.action_names):
            continue
        for law in (Where("above", "time", 0.5), law_of("varies", f"{item.parameters[0].name} with time", None, "")):
            made = conditioned(item, law, bare.system)
            assert np.isfinite(bare.with_effect(made, {}).step(state, action)).all()


@pytest.mark.parametrize(
    ("name", "law", "numbers", "notice"),
    [
        (*LAWS[0], "beyond x = 1.00 m"), (*LAWS[1], "inside the circle of 1.00 m about x = 1.00, y = 0.00 m"),
        (*LAWS[3], "where |speed| is between 0.5 and 1.5 m/s"), (*LAWS[4], "falls by 8 % with each m/s of |speed|"),
        (*LAWS[5], "falls by 0.4 % a second"), (*LAWS[6], "until 20 s"),
    ],
)  # fmt: skip
def test_a_law_has_a_description(name, law, numbers, notice):
    model = car(name, law, numbers)
    item = model.effects[0]
    assert item.law.sentence(numbers, item.inner, model.system) == notice
