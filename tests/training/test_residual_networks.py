"""Residual networks: physics alone before they learn, what it leaves afterwards, and the same again from a file."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from safedpa.dynamics import load_model
from safedpa.effects import effect
from safedpa.errors import InputError
from safedpa.networks import load_weights, save_weights
from safedpa_sim.training.configuration import load_configuration
from safedpa_sim.training.paper_tuning import lived_of
from safedpa_sim.training.predictors import open_loop_errors
from safedpa_sim.training.residual_networks import (
    ResidualTuning,
    judged_error,
    learn_residual,
    residual_predictor,
    residual_weights,
    untrained_residual,
)
from safedpa_sim.training.tuning_data import Drive, record_circles

CAR = load_configuration("car_small")
WEIGHTS = load_model("car_simulated").base.weights
SCALE = torch.from_numpy(np.array(WEIGHTS["increment_scale"]))
LAGGING = CAR.simulator.with_effect(effect("car", "steering_lag"), {})


@pytest.fixture(scope="module")
def circles():
    return [Drive(run.states, run.actions[:-1]) for run in record_circles(900, 8, 300)]


def judged(predictor, drives):
    return judged_error(predictor, [predictor.seen(lived_of(predictor.networks, drives))], SCALE)


def one_step(predictor, drives):
    """Scaled root mean square error."""
    seen = predictor.seen(lived_of(predictor.networks, drives))
    with torch.no_grad():
        errors = open_loop_errors(predictor, seen, torch.arange(60, len(seen.lived.rows)), 1)[0]
    return float((errors / SCALE).square().mean().sqrt())


@pytest.mark.long
def test_without_learning_it_is_the_physics_with_its_actuators_memory(circles):
    predictor = untrained_residual(CAR, LAGGING, WEIGHTS)
    states, actions = circles[0]
    memory, expected = LAGGING.initial_memory(actions[0]), []
    for state, action in zip(states[:-1], actions, strict=True):
        following, memory = LAGGING.advance(state, action, memory)
        expected.append(following)
    seen = predictor.seen(lived_of(predictor.networks, circles[:1]))
    index = torch.arange(60, len(actions))
    with torch.no_grad():
        errors = open_loop_errors(predictor, seen, index, 1)[0].numpy()
    own = predictor.networks.frame.own_increment(states[61:], np.array(expected)[60:])
    np.testing.assert_allclose(errors, own, atol=2e-4)


@pytest.mark.long
def test_it_learns_what_the_physics_leaves_and_is_the_same_out_of_a_file(circles, tmp_path):
    sizes = {"latents": 2, "hidden": 24, "cars": 5, "steps": 100}
    tuning = ResidualTuning(
        **sizes, updates=60, batch=128, recorded=0.9, rollouts=4, rollout_every=30, horizon=4, learning_rate=2e-3
    )
    found = learn_residual(CAR, LAGGING, WEIGHTS, circles, tuning)
    before, after = (one_step(it, circles[2:]) for it in (untrained_residual(CAR, LAGGING, WEIGHTS), found))
    assert after < 0.8 * before
    save_weights(residual_weights(found, WEIGHTS), tmp_path / "residual.safetensors")
    again = residual_predictor(CAR, LAGGING, load_weights(tmp_path / "residual.safetensors"))
    assert judged(again, circles[2:]) == pytest.approx(judged(found, circles[2:]), abs=1e-7)


def test_sizes_that_cannot_be_are_refused():
    with pytest.raises(InputError, match="hidden: got 0, wanted at least 1"):
        ResidualTuning(hidden=0)
