"""A car tracked elsewhere than at its rear axle: the same motion, seen from another point of the same body."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safedpa.dynamics import PhysicsModel, Setting, fingerprint, load_model, parse_model, write_model
from safedpa.robots.car.kinematic_bicycle import KinematicBicycle

WHEELBASE, SPEED_GAIN = 0.31, 4.0


def car(tracked_point: float, free: bool = False) -> PhysicsModel:
    values = {"wheelbase": WHEELBASE, "speed_gain": SPEED_GAIN, "acceleration_limit": 6.0}
    settings = {f"base.{name}": Setting(value) for name, value in values.items()}
    return PhysicsModel(
        KinematicBicycle(), (), {**settings, "base.tracked_point": Setting(tracked_point, free)}, period=0.01
    )


def driven(model: PhysicsModel, state: np.ndarray, action: np.ndarray, steps: int) -> np.ndarray:
    for _ in range(steps):
        state = model.step(state, action)
    return state


@given(point=st.floats(-0.3, 0.5), steer=st.floats(-0.34, 0.34), yaw=st.floats(-3.0, 3.0), speed=st.floats(-0.6, 2.0))
def test_two_points_of_one_car_stay_a_rigid_distance_apart(
    point: float, steer: float, yaw: float, speed: float
) -> None:
    # at a steady speed; the point ahead is as fast as the rear axle over cos(beta)
    beta = math.atan(point / WHEELBASE * math.tan(steer))
    heading = np.array([math.cos(yaw), math.sin(yaw), 0.0, 0.0])
    rear = np.array([0.4, -1.0, yaw, speed])
    ahead = rear + point * heading
    ahead[3] = speed / math.cos(beta)
    rear = driven(car(0.0), rear, np.array([speed, steer]), 100)
    ahead = driven(car(point), ahead, np.array([ahead[3], steer]), 100)
    expected = rear[:3] + point * np.array([math.cos(rear[2]), math.sin(rear[2]), 0.0])
    np.testing.assert_allclose(ahead[:3], expected, atol=1e-7)


@pytest.mark.parametrize("steer", [-0.3, 0.2])
def test_the_point_drives_the_circle_of_its_own_radius(steer: float) -> None:
    radius = math.hypot(WHEELBASE / math.tan(steer), 0.15)
    after = car(0.15).step(np.array([0.0, 0.0, 0.0, 1.2]), np.array([1.2, steer]))
    assert after[2] == pytest.approx(math.copysign(1.2 / radius, steer) * 0.01, rel=1e-9)


def test_left_and_right_are_mirror_images() -> None:
    left = driven(car(0.15), np.array([0.0, 0.0, 0.0, 0.5]), np.array([1.0, 0.3]), 50)
    right = driven(car(0.15), np.array([0.0, 0.0, 0.0, 0.5]), np.array([1.0, -0.3]), 50)
    np.testing.assert_allclose(left, right * np.array([1.0, -1.0, -1.0, 1.0]), atol=1e-14)


@pytest.mark.parametrize("kind", ["numpy", "torch"])
def test_a_free_point_is_part_of_the_latent(kind: str) -> None:
    torch = pytest.importorskip("torch")
    model = car(0.1, free=True)
    assert model.latent_names == ("base.tracked_point",)
    make = np.asarray if kind == "numpy" else torch.tensor
    states = [[0.0, 0.0, 0.3, 1.0], [0.0, 0.0, 0.3, 1.0]]
    after = np.asarray(model.step(make(states), make([[1.0, 0.2]] * 2), make([[0.0], [0.15]])))
    for row, point in zip(after, (0.0, 0.15), strict=True):
        expected = car(point).step(np.array(states[0]), np.array([1.0, 0.2]))
        np.testing.assert_allclose(row, expected, atol=1e-6 if kind == "torch" else 1e-14)


def test_files_that_do_not_name_it_keep_their_fingerprint() -> None:
    # recorded before the parameter existed; calibrated margins name them
    known = {"car": "bc80428c2b0e", "dart_car": "001a81ce4ba1", "dfki_pendulum": "895d112df80b"}
    assert {name: fingerprint(load_model(name)) for name in known} == known


def test_it_is_written_where_it_says_something() -> None:
    assert "tracked_point" not in write_model(car(0.0))
    for model in (car(0.15), car(0.0, free=True)):
        again = parse_model(write_model(model))
        assert again.settings == model.settings
    assert parse_model(write_model(car(0.0))).settings["base.tracked_point"] == Setting(0.0)
    assert fingerprint(car(0.15)) != fingerprint(car(0.0))
