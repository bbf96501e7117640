"""What a service computes for one robot agrees with the arrays of many, and the policy with the one in torch."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as some
from tests.messages import state_of

from safedpa.dynamics import LearnedBase, load_model
from safedpa.errors import MessageError
from safedpa.networks import Weights
from safedpa.policy import LearnedPolicy
from safedpa.robots.car.controllers.goal_seeker import SpeedCompensation
from safedpa.robots.car.observation import observe, padded
from safedpa.robots.car.perception import observe_one


def shipped(name: str) -> Weights:
    base = load_model(name).base
    assert isinstance(base, LearnedBase)
    return base.weights


def scene(draw: np.random.Generator, obstacles: int) -> tuple[np.ndarray, ...]:
    """State, action in force, goal, obstacles, field, footprint, latent."""
    state = np.array([*draw.uniform(-4.0, 4.0, 2), draw.uniform(-9.0, 9.0), draw.uniform(-1.0, 2.0)])
    around = np.column_stack([draw.uniform(-5.0, 5.0, (obstacles, 2)), draw.uniform(0.0, 0.9, obstacles)])
    footprint = np.array([draw.uniform(0.0, 1.5), draw.uniform(0.0, 0.6), draw.uniform(0.05, 0.5)])
    field = np.array([-4.0, 4.0, -3.0, 3.5])
    return state, draw.uniform(-1.0, 1.0, 2), draw.uniform(-4.0, 4.0, 2), around, field, footprint, draw.normal(size=4)


@given(some.integers(0, 2**32 - 1), some.integers(0, 30))
@settings(max_examples=300)
def test_one_car_sees_what_many_see(seed, obstacles):
    parts = scene(np.random.default_rng(seed), obstacles)
    state, applied, goal, around, field, footprint, latent = parts
    expected = observe(state, applied, goal, padded(around.tolist()), field, footprint, latent)
    np.testing.assert_allclose(observe_one(*(part.tolist() for part in parts)), expected, rtol=1e-9, atol=1e-12)


@given(some.floats(-3.2, 3.2), some.floats(0.0, 0.2), some.floats(0.3, 0.9))
def test_rays_at_the_rim_of_an_obstacle(bearing, gap, radius):
    """Seen from right next to it, an obstacle covers half of all rays, and the rim decides."""
    footprint, reach = np.array([0.1, 0.1, 0.15]), radius + 0.15 + gap
    around = [[reach * np.cos(bearing), reach * np.sin(bearing), radius]]
    still, field = np.zeros(4), np.array([-4.0, 4.0, -4.0, 4.0])
    expected = observe(still, np.zeros(2), np.ones(2), padded(around), field, footprint, np.zeros(0))
    one = observe_one(still.tolist(), [0.0, 0.0], [1.0, 1.0], around, field.tolist(), footprint.tolist(), [])
    np.testing.assert_allclose(one, expected, rtol=1e-7, atol=1e-7)


@given(some.sampled_from(("car_learned", "pendulum_learned", "car_rma_p")), some.integers(0, 2**32 - 1))
@settings(max_examples=40)
def test_the_policy_agrees_with_torch(name, seed):
    """In single precision: to 1e-6 of the action's range."""
    pytest.importorskip("torch")
    from safedpa.networks.reference import reference_action

    weights = shipped(name)
    policy, draw = LearnedPolicy(weights), np.random.default_rng(seed)
    middle, spread = weights["observation_middle"], weights["observation_scale"]
    seen = middle + spread * draw.normal(size=(20, len(middle))) * draw.choice([0.3, 1.0, 5.0])
    expected, reach = reference_action(weights, seen), weights["action_scale"]
    assert (np.abs(policy.act(seen) - expected) / reach).max() < 1e-6


@given(some.sampled_from(("car_learned", "car_simulated")), some.integers(0, 2**32 - 1), some.integers(0, 8))
@settings(max_examples=60)
def test_the_nominal_action_of_one_car_is_what_the_policy_does_at_its_observation(name, seed, count):
    weights, parts = shipped(name), scene(np.random.default_rng(seed), count)
    state, applied, goal, obstacles, field, footprint, latent = (tuple(part.tolist()) for part in parts)
    around = tuple(tuple(row) for row in obstacles)
    message = state_of(*state, applied=applied, goal=goal, obstacles=around, field=field, footprint=footprint)
    policy = LearnedPolicy(weights)
    nominal, _ = policy.nominal_action(message, np.array(latent))
    expected = policy.act(np.array(observe_one(state, applied, goal, around, field, footprint, latent)))
    assert (np.abs(np.array(nominal) - expected) / weights["action_scale"]).max() < 1e-6


@pytest.mark.parametrize("place", ["values", "goal", "footprint", "obstacles"])
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_what_is_no_number_is_refused(place, bad):
    wrong = {"values": (bad, 0.2, 0.3, 0.4), "goal": (1.0, bad), "footprint": (0.1, 0.2, bad)}
    wrong["obstacles"] = ((bad, 1.0, 0.3),)
    state = state_of(**{place: wrong[place]})
    with pytest.raises(MessageError, match="not finite"):
        LearnedPolicy(shipped("car_learned")).nominal_action(state, np.zeros(4))


@given(some.integers(0, 2**32 - 1))
@example(1000003)
@settings(max_examples=60)
def test_the_compensation_is_that_of_the_tangent_on_every_road(seed):
    """To the last bit whether the model was asked often enough for its equations to be recorded, or not."""
    draw, model = np.random.default_rng(seed), load_model("car")
    state, nominal = draw.uniform(-1.0, 1.5, 4), draw.uniform(-0.3, 1.5, 2)
    latent = model.latent + draw.uniform(0.0, 0.5, len(model.latent))
    floats = state.tolist(), nominal.tolist(), latent.tolist()
    slow = SpeedCompensation(model).target(*floats)
    for _ in range(250):
        model.scalar_step(model.period)
    assert model.scalar_step(model.period) is not None
    assert SpeedCompensation(model).target(*floats) == slow
    f, g = model.affine(state, latent, around=nominal)
    hold, loaded = g[3, 0], model.step(state, nominal, latent)[3]
    secant = (model.step(state, nominal + np.array([1e-3, 0.0]), latent)[3] - loaded) / 1e-3
    if secant > 0.01:
        expected = nominal[0] + (model.step(state, nominal)[3] - loaded) / secant
        assert abs(slow - expected) < 1e-9 * (1.0 + abs(expected))
    if hold > 0.01 and abs(secant - hold) < 0.01 * hold:  # else the limit of the acceleration lies between the two
        expected = nominal[0] + (model.step(state, nominal)[3] - f[3] - g[3] @ nominal) / hold
        assert abs(slow - expected) < 0.02 * abs(expected - nominal[0]) + 1e-9
