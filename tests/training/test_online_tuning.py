"""Tuning on a robot's own drives: the heads are solved as they say, a worse model is never taken, and L_TUNE falls."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from safedpa.dynamics import load_model
from safedpa.errors import InputError
from safedpa.networks.weights import STRIDE
from safedpa_sim.training import online_tuning
from safedpa_sim.training.online_tuning import OnlineTuning, add_to_heads, head_features, tuned_online
from safedpa_sim.training.paper_tuning import PaperTuning, lived_of, tune_as_written
from safedpa_sim.training.prediction import ALONG
from safedpa_sim.training.predictors import NetworkPredictor, one_step_errors, open_loop_errors
from safedpa_sim.training.reference_point import weights_told_of_axle
from safedpa_sim.training.tuning_data import Drive, record_circles

WEIGHTS = load_model("car_simulated").base.weights
SCALE = torch.from_numpy(np.array(WEIGHTS["increment_scale"]))


@pytest.fixture(scope="module")
def circles():
    return [Drive(run.states, run.actions[:-1]) for run in record_circles(1600, 12, 400)]


def predictor():
    return NetworkPredictor(weights_told_of_axle(WEIGHTS, 0.15))


def one_step(model, drives):
    seen = model.seen(lived_of(model.networks, drives))
    index = torch.arange(len(seen.lived.rows))
    with torch.no_grad():
        return open_loop_errors(model, seen, index[index - seen.lived.first >= 60], 1)[0]


def test_added_heads_add_their_output_to_every_increment(circles):
    model = predictor()
    seen = model.seen(lived_of(model.networks, circles[:1]))
    b, left = head_features(model, seen, 3)
    added = 0.01 * torch.randn(b.shape[1], 4, generator=torch.Generator().manual_seed(1))
    add_to_heads(model, added)
    torch.testing.assert_close(head_features(model, seen, 3)[1], left - b @ added, rtol=0.0, atol=2e-5)


def test_features_give_the_error_that_the_model_leaves(circles):
    model = predictor()
    seen = model.seen(lived_of(model.networks, circles[:1]))
    left = head_features(model, seen)[1]
    index = torch.arange(len(left))
    with torch.no_grad():
        errors = open_loop_errors(model, seen, index, 1)[0]
    frame, lived = model.networks.frame, seen.lived
    own = frame.own_increment(lived.states, lived.following)
    expected = frame.own_increment(lived.states, lived.states + frame.world_increment(lived.states, own - SCALE * left))
    predicted = expected - own  # the error in the frame before the step; that after it is turned by the yaw
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
    """In one drive the car turns the other way at every steer: fitted to either, the other goes wrong."""
    states, actions = circles[1]
    model = predictor()
    contradicting = [circles[0], Drive(states, actions * np.array([1.0, -1.0]))]
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
    _, taken = tuned_online(predictor(), [Drive(states, turned)], SCALE, OnlineTuning(ridges=(1e-3,)))
    assert taken.refused
    _, taken = tuned_online(predictor(), circles[:1], SCALE, OnlineTuning(ridges=(1e-2,)))
    assert not taken.refused


def test_a_model_without_any_error_stays_as_it_was(circles, monkeypatch):
    monkeypatch.setattr(online_tuning, "open_loop_errors", lambda *given: torch.zeros(given[3], len(given[2]), 4))
    _, taken = tuned_online(predictor(), circles, SCALE)
    assert taken.refused
    assert taken.before == (0.0, 0.0)


def test_drives_that_are_too_short_are_refused(circles):
    states, actions = circles[0]
    with pytest.raises(InputError, match="has 200 transitions, wanted two of more than 72, or one of more than 288"):
        tuned_online(predictor(), [Drive(states[:201], actions[:200])], SCALE)


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
    seen = model.seen(lived_of(model.networks, circles[:1]))
    start = torch.tensor([80, 150])
    together, _ = one_step_errors(model, seen, start)
    index = (start[:, None] + STRIDE * torch.arange(ALONG)).flatten()
    alone = open_loop_errors(model, seen, index, 1)[0]
    torch.testing.assert_close(together[:, 2:], alone[:, 2:], rtol=0.0, atol=1e-6)
    torch.testing.assert_close(together[:, :2].norm(dim=1), alone[:, :2].norm(dim=1), rtol=0.0, atol=1e-6)
