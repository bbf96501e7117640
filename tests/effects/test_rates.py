"""Each effect's equation, worked out by hand at one state: what it adds to the rates."""

from __future__ import annotations

import math

import numpy as np
import pytest

from safedpa.dynamics import PhysicsModel, Setting
from safedpa.effects import effect
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
