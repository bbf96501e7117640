"""The same motion told of another point: the simulated car's own body, the bicycle's equations, and the networks."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from safedpa.dynamics import PhysicsModel, Setting, load_model
from safedpa.errors import InputError
from safedpa.robots.car.kinematic_bicycle import KinematicBicycle
from safedpa_sim.robots.car_parameters import CAR_PARAMETERS
from safedpa_sim.robots.world import CarWorld
from safedpa_sim.training.paper_tuning import lived_of
from safedpa_sim.training.predictors import NetworkPredictor
from safedpa_sim.training.reference_point import ReferencePoint, weights_told_of_axle
from safedpa_sim.training.tuning_data import Drive

AHEAD, WHEELBASE = 0.15, 0.31
angles = st.floats(-3.0, 3.0)
steers = st.floats(-0.34, 0.34)
speeds = st.floats(-0.6, 2.0)


def bicycle(tracked_point):
    numbers = {"wheelbase": WHEELBASE, "speed_gain": 4.0, "acceleration_limit": 50.0, "tracked_point": tracked_point}
    settings = {f"base.{name}": Setting(value) for name, value in numbers.items()}
    return PhysicsModel(KinematicBicycle(), (), settings, 0.05)


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


@given(yaw=angles, speed=speeds, steer=steers)
def test_there_and_back_is_the_same_state(yaw, speed, steer):
    point, state, action = ReferencePoint(AHEAD, WHEELBASE), tensor(1.0, -2.0, yaw, speed), tensor(0.5, steer)
    back = point.to_axle(point.of_axle(state, action), action)
    torch.testing.assert_close(back, state, rtol=0.0, atol=1e-12)


@given(yaw=angles, speed=speeds, steer=steers, target=speeds)
def test_the_bicycle_tracked_at_the_point_is_the_bicycle_tracked_at_the_axle(yaw, speed, steer, target):
    """The servo holds the speed of what is tracked: it is asked for target / cos(beta) there."""
    point, state, action = ReferencePoint(AHEAD, WHEELBASE), tensor(0.0, 0.0, yaw, speed), tensor(target, steer)
    stretch = np.hypot(1.0, AHEAD / WHEELBASE * np.tan(steer))
    axle, _ = bicycle(0.0).advance(state.numpy(), action.numpy(), ())
    told, _ = bicycle(AHEAD).advance(point.of_axle(state, action).numpy(), np.array([target * stretch, steer]), ())
    np.testing.assert_allclose(point.of_axle(torch.from_numpy(axle), action).numpy(), told, atol=2e-6)


def test_the_simulated_cars_centre_of_mass_is_the_point_ahead_of_its_axle():
    world = CarWorld((0.3, -0.2, 0.7), (-1e3, 1e3, -1e3, 1e3))
    point = ReferencePoint(CAR_PARAMETERS.centre_of_mass)
    for speed, steer in ((1.5, 0.3), (1.8, -0.34), (-0.5, 0.2)):
        for _ in range(15):
            world.advance(speed, steer, 0.05)
            told = point.of_axle(torch.tensor(world.state, dtype=torch.float64), tensor(speed, steer))
            np.testing.assert_allclose(told[:2].numpy(), tuple(world.body.position), atol=1e-9)


def test_weights_moved_to_the_axle_differ_from_the_exact_change_by_what_is_left_out():
    """Along by d (1 - cos u), across by d (u - sin u), u the turn in one period; nothing else."""
    weights = load_model("car_simulated").base.weights
    exact, linear = NetworkPredictor(weights).networks, NetworkPredictor(weights_told_of_axle(weights, AHEAD)).networks
    generator = torch.Generator().manual_seed(3)
    draw = torch.rand(200, 10, generator=generator)
    state = torch.stack((draw[:, 0], draw[:, 1], 6.0 * draw[:, 2] - 3.0, 2.6 * draw[:, 3] - 0.6), 1)
    action = torch.stack((2.6 * draw[:, 4] - 0.6, 0.68 * draw[:, 5] - 0.34), 1)
    latent = 2.0 * draw[:, 6:] - 1.0
    point = ReferencePoint(AHEAD)
    after = point.to_axle(exact.step(point.of_axle(state, action), action, latent), action)
    own, told = (
        exact.frame.own_increment(state, following).double()
        for following in (after, linear.step(state, action, latent))
    )
    turn = own[:, 2]
    left_out = torch.stack((AHEAD * (1.0 - torch.cos(turn)), AHEAD * (turn - torch.sin(turn))), 1)
    assert left_out.abs().amax(0)[0] > 1e-4
    torch.testing.assert_close(own[:, :2] - told[:, :2], left_out, rtol=0.0, atol=2e-6)
    torch.testing.assert_close(own[:, 2:], told[:, 2:], rtol=0.0, atol=1e-6)


def test_phi_moved_to_the_axle_gives_the_latent_of_the_point():
    """The rows of both drives differ by the equation that the first layer takes up, to the second order of the turn."""
    weights = load_model("car_simulated").base.weights
    asked, moved = (
        NetworkPredictor(weights, ReferencePoint(AHEAD)),
        NetworkPredictor(weights_told_of_axle(weights, AHEAD)),
    )
    generator = torch.Generator().manual_seed(5)
    yaw = torch.cumsum(0.02 * torch.randn(53, generator=generator), 0)
    states = torch.stack(
        (0.05 * torch.arange(53.0), 0.01 * torch.randn(53, generator=generator), yaw, 1.0 + 0.0 * yaw), 1
    )
    actions = torch.tensor([[1.0, 0.1]]).expand(52, 2)
    drive = Drive(states.numpy(), actions.numpy())
    latents = [
        model.latent(model.seen(lived_of(model.networks, [drive])).lived.rows[None])
        for model in (asked, moved, NetworkPredictor(weights))
    ]
    right, told, wrong = latents
    assert (right - told).abs().max() < 0.05 * (right - wrong).abs().max()


def test_what_is_no_wheelbase_is_refused():
    with pytest.raises(InputError, match="wheelbase: got -1"):
        ReferencePoint(0.1, -1.0)


def test_weights_of_another_robot_are_refused():
    weights = load_model("pendulum_learned").base.weights
    with pytest.raises(InputError, match="wanted x, y, yaw, speed"):
        weights_told_of_axle(weights, AHEAD)
