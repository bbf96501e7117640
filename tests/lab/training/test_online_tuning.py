"""Online tuning, conversion between reference points, and residual networks."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from safedpa.dynamics import PhysicsModel, Setting, load_model
from safedpa.effects import effect
from safedpa.errors import InputError
from safedpa.networks import load_weights, save_weights
from safedpa.networks.weights import STRIDE
from safedpa.robots.car.dynamics.kinematic_bicycle import KinematicBicycle
from safedpa_lab.tuning import predictors
from safedpa_lab.tuning.online import OnlineTuning, add_to_heads, head_features, tuned_online
from safedpa_lab.tuning.paper import PaperTuning, sequence_of, tune_as_written
from safedpa_lab.tuning.predictors import NetworkPredictor, one_step_errors, open_loop_errors
from safedpa_lab.tuning.reference_point import ReferencePoint, weights_reported_of_axle
from safedpa_lab.tuning.residual_networks import (
    ResidualTuning,
    judged_error,
    learn_residual,
    residual_predictor,
    residual_weights,
    untrained_residual,
)
from safedpa_sim.robots.car.parameters import CAR_PARAMETERS
from safedpa_sim.robots.car.world import CarWorld
from safedpa_sim.training.configuration import load_configuration
from safedpa_sim.training.data.recorded_runs import TuningDrive, record_circles
from safedpa_sim.training.networks.prediction_errors import ALONG

WEIGHTS = load_model("car_simulated").base.weights
SCALE = torch.from_numpy(np.array(WEIGHTS["increment_scale"]))


@pytest.fixture(scope="module")
def circles():
    return [TuningDrive(run.states, run.actions[:-1]) for run in record_circles(1600, 12, 400)]


def predictor():
    return NetworkPredictor(weights_reported_of_axle(WEIGHTS, 0.15))


def one_step(model, drives):
    seen = model.seen(sequence_of(model.networks, drives))
    index = torch.arange(len(seen.sequence.rows))
    with torch.no_grad():
        return open_loop_errors(model, seen, index[index - seen.sequence.first >= 60], 1)[0]


def test_added_heads_add_their_output_to_every_increment(circles):
    model = predictor()
    seen = model.seen(sequence_of(model.networks, circles[:1]))
    b, left = head_features(model, seen, 3)
    added = 0.01 * torch.randn(b.shape[1], 4, generator=torch.Generator().manual_seed(1))
    add_to_heads(model, added)
    torch.testing.assert_close(head_features(model, seen, 3)[1], left - b @ added, rtol=0.0, atol=2e-5)


def test_features_give_the_error_that_the_model_leaves(circles):
    model = predictor()
    seen = model.seen(sequence_of(model.networks, circles[:1]))
    left = head_features(model, seen)[1]
    index = torch.arange(len(left))
    with torch.no_grad():
        errors = open_loop_errors(model, seen, index, 1)[0]
    frame, sequence = model.networks.frame, seen.sequence
    own = frame.own_increment(sequence.states, sequence.following)
    expected = frame.own_increment(
        sequence.states, sequence.states + frame.world_increment(sequence.states, own - SCALE * left)
    )
    predicted = expected - own  # error in the frame before the step; the one after it is rotated by the yaw
    turned = torch.hypot(errors[:, 0], errors[:, 1])
    torch.testing.assert_close(turned, torch.hypot(predicted[:, 0], predicted[:, 1]), rtol=0.0, atol=2e-6)
    torch.testing.assert_close(errors[:, 2:], predicted[:, 2:], rtol=0.0, atol=2e-6)


def test_other_drives_are_predicted_better_after_it(circles):
    model = predictor()
    tuned, taken = tuned_online(model, circles[:3], SCALE, OnlineTuning(ridges=(1e-2, 1e-1)))
    before, after = ((one_step(it, circles[3:]) / SCALE).square().mean().sqrt() for it in (model, tuned))
    assert not taken.refused
    assert all(new < old for new, old in zip(taken.after, taken.before, strict=True))
    assert after < 0.7 * before


def test_what_the_drives_that_are_left_out_contradict_is_refused_and_the_model_stays_as_it_was(circles):
    """In one drive the steering is mirrored: a fit to either drive makes the other worse."""
    states, actions = circles[1]
    model = predictor()
    contradicting = [circles[0], TuningDrive(states, actions * np.array([1.0, -1.0]))]
    tuned, taken = tuned_online(model, contradicting, SCALE, OnlineTuning(ridges=(1e-3,)))
    assert taken.refused
    assert taken.ridge is None
    for name, tensor in model.networks.state_dict().items():
        assert torch.equal(tensor, tuned.networks.state_dict()[name])
    for name, tensor in model.encoder.state_dict().items():
        assert torch.equal(tensor, tuned.encoder.state_dict()[name])
    assert tuned.recent is None


def test_of_a_single_drive_the_end_is_left_out_and_decides(circles):
    states, actions = circles[0]
    turned = np.concatenate([actions[:300] * np.array([1.0, -1.0]), actions[300:]])
    _, taken = tuned_online(predictor(), [TuningDrive(states, turned)], SCALE, OnlineTuning(ridges=(1e-3,)))
    assert taken.refused
    _, taken = tuned_online(predictor(), circles[:1], SCALE, OnlineTuning(ridges=(1e-2,)))
    assert not taken.refused


def test_a_model_without_any_error_stays_as_it_was(circles, monkeypatch):
    monkeypatch.setattr(predictors, "open_loop_errors", lambda *given: torch.zeros(given[3], len(given[2]), 4))
    _, taken = tuned_online(predictor(), circles, SCALE)
    assert taken.refused
    assert taken.before == (0.0, 0.0)


def test_drives_that_are_too_short_are_refused(circles):
    states, actions = circles[0]
    with pytest.raises(InputError, match="has 200 transitions, wanted two of more than 72, or one of more than 288"):
        tuned_online(predictor(), [TuningDrive(states[:201], actions[:200])], SCALE)


def test_settings_that_cannot_be_are_refused():
    with pytest.raises(InputError, match="wanted ridges above 0"):
        OnlineTuning(ridges=(0.0,))
    with pytest.raises(InputError, match="wanted 1 and 8 at least"):
        PaperTuning(batch=4)


def test_the_papers_loss_falls_and_the_same_seed_gives_the_same_weights(circles):
    tuning = PaperTuning(updates=25, batch=128, learning_rate=1e-3, seed=4)
    tuned = [tune_as_written(WEIGHTS, circles[:3], tuning) for _ in range(2)]
    assert tuned[0].digest == tuned[1].digest
    losses = [one_step(NetworkPredictor(it), circles[:3]).square().sum(-1).mean() for it in (WEIGHTS, tuned[0])]
    assert losses[1] < 0.5 * losses[0]
    assert (tuned[0]["latent_low"] < tuned[0]["latent_high"]).all()
    np.testing.assert_array_equal(tuned[0]["mu.0.weight"], WEIGHTS["mu.0.weight"])


def test_histories_along_a_drive_give_the_errors_of_histories_one_by_one(circles):
    model = predictor()
    free = torch.full((4,), 1e6)
    model.networks.latent_low.copy_(-free)
    model.networks.latent_high.copy_(free)
    seen = model.seen(sequence_of(model.networks, circles[:1]))
    start = torch.tensor([80, 150])
    together, _ = one_step_errors(model, seen, start)
    index = (start[:, None] + STRIDE * torch.arange(ALONG)).flatten()
    alone = open_loop_errors(model, seen, index, 1)[0]
    torch.testing.assert_close(together[:, 2:], alone[:, 2:], rtol=0.0, atol=1e-6)
    torch.testing.assert_close(together[:, :2].norm(dim=1), alone[:, :2].norm(dim=1), rtol=0.0, atol=1e-6)


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
    """The servo controls the speed of the tracked point, so the target there is target / cos(beta)."""
    point, state, action = ReferencePoint(AHEAD, WHEELBASE), tensor(0.0, 0.0, yaw, speed), tensor(target, steer)
    stretch = np.hypot(1.0, AHEAD / WHEELBASE * np.tan(steer))
    axle, _ = bicycle(0.0).advance(state.numpy(), action.numpy(), ())
    reported, _ = bicycle(AHEAD).advance(point.of_axle(state, action).numpy(), np.array([target * stretch, steer]), ())
    np.testing.assert_allclose(point.of_axle(torch.from_numpy(axle), action).numpy(), reported, atol=2e-6)


def test_the_simulated_cars_centre_of_mass_is_the_point_ahead_of_its_axle():
    world = CarWorld((0.3, -0.2, 0.7), (-1e3, 1e3, -1e3, 1e3))
    point = ReferencePoint(CAR_PARAMETERS.centre_of_mass)
    for speed, steer in ((1.5, 0.3), (1.8, -0.34), (-0.5, 0.2)):
        for _ in range(15):
            world.advance(speed, steer, 0.05)
            reported = point.of_axle(torch.tensor(world.state, dtype=torch.float64), tensor(speed, steer))
            np.testing.assert_allclose(reported[:2].numpy(), tuple(world.body.position), atol=1e-9)


def test_weights_moved_to_the_axle_differ_from_the_exact_change_by_what_is_left_out():
    """The only errors are d (1 - cos u) along and d (u - sin u) across, u the turn in one period."""
    weights = load_model("car_simulated").base.weights
    exact, linear = (
        NetworkPredictor(weights).networks,
        NetworkPredictor(weights_reported_of_axle(weights, AHEAD)).networks,
    )
    generator = torch.Generator().manual_seed(3)
    draw = torch.rand(200, 10, generator=generator)
    state = torch.stack((draw[:, 0], draw[:, 1], 6.0 * draw[:, 2] - 3.0, 2.6 * draw[:, 3] - 0.6), 1)
    action = torch.stack((2.6 * draw[:, 4] - 0.6, 0.68 * draw[:, 5] - 0.34), 1)
    latent = 2.0 * draw[:, 6:] - 1.0
    point = ReferencePoint(AHEAD)
    after = point.to_axle(exact.step(point.of_axle(state, action), action, latent), action)
    own, reported = (
        exact.frame.own_increment(state, following).double()
        for following in (after, linear.step(state, action, latent))
    )
    turn = own[:, 2]
    left_out = torch.stack((AHEAD * (1.0 - torch.cos(turn)), AHEAD * (turn - torch.sin(turn))), 1)
    assert left_out.abs().amax(0)[0] > 1e-4
    torch.testing.assert_close(own[:, :2] - reported[:, :2], left_out, rtol=0.0, atol=2e-6)
    torch.testing.assert_close(own[:, 2:], reported[:, 2:], rtol=0.0, atol=1e-6)


def test_phi_moved_to_the_axle_gives_the_latent_of_the_point():
    """The rows of both drives differ by the term merged into the first layer, up to second order in the turn."""
    weights = load_model("car_simulated").base.weights
    asked, moved = (
        NetworkPredictor(weights, ReferencePoint(AHEAD)),
        NetworkPredictor(weights_reported_of_axle(weights, AHEAD)),
    )
    generator = torch.Generator().manual_seed(5)
    yaw = torch.cumsum(0.02 * torch.randn(53, generator=generator), 0)
    states = torch.stack(
        (0.05 * torch.arange(53.0), 0.01 * torch.randn(53, generator=generator), yaw, 1.0 + 0.0 * yaw), 1
    )
    actions = torch.tensor([[1.0, 0.1]]).expand(52, 2)
    drive = TuningDrive(states.numpy(), actions.numpy())
    latents = [
        model.latent(model.seen(sequence_of(model.networks, [drive])).sequence.rows[None])
        for model in (asked, moved, NetworkPredictor(weights))
    ]
    right, reported, wrong = latents
    assert (right - reported).abs().max() < 0.05 * (right - wrong).abs().max()


def test_what_is_no_wheelbase_is_refused():
    with pytest.raises(InputError, match="wheelbase: got -1"):
        ReferencePoint(0.1, -1.0)


def test_weights_of_another_robot_are_refused():
    weights = load_model("pendulum_learned").base.weights
    with pytest.raises(InputError, match="wanted x, y, yaw, speed"):
        weights_reported_of_axle(weights, AHEAD)


CAR = load_configuration("car_small")
LAGGING = CAR.simulator.with_effect(effect("car", "steering_lag"), {})


@pytest.fixture(scope="module")
def circles_residual():
    return [TuningDrive(run.states, run.actions[:-1]) for run in record_circles(900, 8, 300)]


def judged(predictor, drives):
    return judged_error(predictor, [predictor.seen(sequence_of(predictor.networks, drives))], SCALE)


def one_step_residual(predictor, drives):
    """Returns the scaled RMS error."""
    seen = predictor.seen(sequence_of(predictor.networks, drives))
    with torch.no_grad():
        errors = open_loop_errors(predictor, seen, torch.arange(60, len(seen.sequence.rows)), 1)[0]
    return float((errors / SCALE).square().mean().sqrt())


@pytest.mark.long
def test_without_learning_it_is_the_physics_with_its_actuators_memory(circles_residual):
    predictor = untrained_residual(CAR, LAGGING, WEIGHTS)
    states, actions = circles_residual[0]
    memory, expected = LAGGING.initial_memory(actions[0]), []
    for state, action in zip(states[:-1], actions, strict=True):
        following, memory = LAGGING.advance(state, action, memory)
        expected.append(following)
    seen = predictor.seen(sequence_of(predictor.networks, circles_residual[:1]))
    index = torch.arange(60, len(actions))
    with torch.no_grad():
        errors = open_loop_errors(predictor, seen, index, 1)[0].numpy()
    own = predictor.networks.frame.own_increment(states[61:], np.array(expected)[60:])
    np.testing.assert_allclose(errors, own, atol=2e-4)


@pytest.mark.long
def test_it_learns_what_the_physics_leaves_and_is_the_same_out_of_a_file(circles_residual, tmp_path):
    sizes = {"latents": 2, "hidden": 24, "cars": 5, "steps": 100}
    tuning = ResidualTuning(
        **sizes, updates=60, batch=128, recorded=0.9, rollouts=4, rollout_every=30, horizon=4, learning_rate=2e-3
    )
    found = learn_residual(CAR, LAGGING, WEIGHTS, circles_residual, tuning)
    before, after = (
        one_step_residual(it, circles_residual[2:]) for it in (untrained_residual(CAR, LAGGING, WEIGHTS), found)
    )
    assert after < 0.8 * before
    save_weights(residual_weights(found, WEIGHTS), tmp_path / "residual.safetensors")
    again = residual_predictor(CAR, LAGGING, load_weights(tmp_path / "residual.safetensors"))
    assert judged(again, circles_residual[2:]) == pytest.approx(judged(found, circles_residual[2:]), abs=1e-7)


def test_sizes_that_cannot_be_are_refused():
    with pytest.raises(InputError, match="hidden: got 0, wanted at least 1"):
        ResidualTuning(hidden=0)
