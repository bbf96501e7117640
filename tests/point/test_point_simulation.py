"""The batched point robot is MuJoCo's, the body is the benchmark's."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.errors import InputError
from safedpa_lab.point.world import MujocoPoint
from safedpa_sim.point.body import POINT_BODY
from safedpa_sim.point.simulation import PointSimulation


def test_the_body_has_the_published_numbers() -> None:
    model = MujocoPoint().model
    assert POINT_BODY.mass == pytest.approx(0.005189, abs=1e-6)
    assert POINT_BODY.centre_ahead == pytest.approx(0.0193, abs=5e-5)
    assert POINT_BODY.largest_thrust == pytest.approx(0.015)
    assert POINT_BODY.largest_turn == pytest.approx(3.0)
    assert model.body_mass[model.body("robot").id] == pytest.approx(POINT_BODY.mass)
    assert model.body_ipos[model.body("robot").id][0] == pytest.approx(POINT_BODY.centre_ahead)
    assert model.opt.timestep == pytest.approx(0.002)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from([0.05, 0.2, 1.0]))
def test_many_at_once_move_as_mujoco_says(seed: int, thrust_range: float) -> None:
    random = np.random.default_rng(seed)
    many, one = PointSimulation(3), MujocoPoint()
    many.pose[:], many.velocity[:] = random.normal(size=(3, 3)), random.normal(size=(3, 3))
    many.force[:] = random.uniform(-0.008, 0.008, (2, 3))
    pose, velocity = many.pose.copy(), many.velocity.copy()
    controls = random.uniform(-1.0, 1.0, (40, 2, 3)) * np.array([thrust_range, 1.2])[:, None]
    for control in controls:
        many.advance(control)
    for index in range(3):
        one.put(pose[:, index], velocity[:, index], (many.force[0, index], many.force[1, index]))
        for control in controls:
            one.advance(control[:, index])
        np.testing.assert_allclose(many.pose[:, index], one.pose, atol=1e-9)
        np.testing.assert_allclose(many.velocity[:, index], one.velocity, atol=1e-9)
        np.testing.assert_allclose(many.sensors(controls[-1])[:, index], one.sensors(), atol=1e-8)


def test_the_turning_servo_does_not_chatter_and_the_thrust_saturates() -> None:
    robots = PointSimulation(2)
    rates = []
    for _ in range(100):
        robots.advance(np.array([[0.05, 1.0], [1.0, 1.0]]))
        rates.append(robots.velocity[2].copy())
    assert np.abs(np.diff(np.array(rates)[20:], 2, axis=0)).max() < 1e-3
    assert rates[-1] == pytest.approx(POINT_BODY.largest_turn, abs=0.05)
    np.testing.assert_allclose(robots.pose[:, 0], robots.pose[:, 1], atol=1e-12)


@pytest.mark.parametrize("control", [[0.0], [np.nan, 0.0], [0.0, np.inf]])
def test_controls_that_are_not_finite_are_refused(control: list[float]) -> None:
    with pytest.raises(InputError, match="two finite numbers"):
        MujocoPoint().advance(np.array(control))
