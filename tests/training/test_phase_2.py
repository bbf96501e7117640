"""The history encoder learns mu's latent from simulated drives."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from safedpa.networks import HistoryEncoder
from safedpa_sim.training.configuration import load_configuration
from safedpa_sim.training.data.drives import random_drives
from safedpa_sim.training.data.transitions import concatenate, history_rows, transition_sequence
from safedpa_sim.training.environments.batched_simulator import BatchedSimulator
from safedpa_sim.training.networks.modules import HistoryNetwork, affine_networks, history_network
from safedpa_sim.training.networks.prediction_errors import latents_along
from safedpa_sim.training.phases.phase_1a import train_affine
from safedpa_sim.training.phases.phase_2 import train_history_encoder

pytestmark = pytest.mark.slow

# Only loads with the same friction are randomised: a history of 2.5 s can identify them.
SMALL = replace(
    load_configuration("car_small"),
    environment={"towed_load.mass_ratio": (0.0, 1.6), "towed_load.deceleration": (2.0, 2.1)},
    absent=0.0,
)


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    torch.set_num_threads(1)
    return train_affine(SMALL, tmp_path_factory.mktemp("phase_1a"))[0]


@pytest.fixture(scope="module")
def trained(weights, tmp_path_factory):
    phase = replace(SMALL.phase_2, rounds=3, updates=250, cars=300, batch=512)
    return train_history_encoder(replace(SMALL, phase_2=phase), weights, tmp_path_factory.mktemp("phase_2"))


@pytest.mark.long
def test_the_history_reveals_the_effect_of_the_load(weights, trained):
    _, summary = trained
    assert max(summary["explained"]) > 0.5
    assert summary["learning_curve"][-1] < 0.7 * summary["learning_curve"][0]
    with_mu, with_phi = (summary[f"one_step_error_with_{name}"][3] for name in ("mu", "phi"))
    assert with_mu < with_phi < 0.25


@pytest.mark.long
def test_the_services_use_the_weights(weights, trained):
    encoder = HistoryEncoder(trained[0])
    networks = affine_networks(trained[0])
    drives = random_drives(BatchedSimulator(SMALL), networks, 3, 70, 0.0, torch.Generator().manual_seed(1))
    index = torch.tensor([69, 139, 209])
    with torch.no_grad():
        ours = history_network(trained[0])(drives.histories(index, SMALL.history)).numpy()
    states = torch.cat((drives.states[:70], drives.following[69:70])).double().numpy()
    rows = encoder.rows(states[:70], drives.actions[:69].double().numpy())
    theirs = encoder.encode(encoder.padded(rows))
    np.testing.assert_allclose(theirs, ours[0].clip(weights["latent_low"], weights["latent_high"]), atol=1e-4)


@pytest.mark.long
def test_the_same_seed_gives_the_same_encoder(weights, tmp_path):
    phase = replace(SMALL.phase_2, rounds=1, updates=3, cars=20)
    first, second = (train_history_encoder(replace(SMALL, phase_2=phase), weights, tmp_path)[0] for _ in range(2))
    assert first.digest == second.digest


@pytest.mark.long
def test_a_history_sees_its_own_drive_only_and_zeros_before_it(weights):
    networks = affine_networks(weights)
    states, actions = torch.randn(2, 6, 4), torch.randn(2, 5, 2)
    drives = transition_sequence(networks, states, actions)
    seen = drives.histories(torch.tensor([7]), 4)[0]
    rows = history_rows(networks, states[1, :2], actions[1, :2], states[1, 1:3])
    assert torch.equal(seen[:2], torch.zeros(2, 9))
    assert torch.equal(seen[2:], rows)
    both = concatenate([drives, drives])
    assert torch.equal(both.histories(torch.tensor([17]), 4)[0], seen)


@pytest.mark.long
def test_drawn_transitions_have_the_required_distance_from_the_ends(weights):
    drives = transition_sequence(affine_networks(weights), torch.randn(3, 31, 4), torch.randn(3, 30, 2))
    index = drives.draw(500, torch.Generator().manual_seed(0), before=10, ahead=15)
    assert int((index % 30).min()) == 10
    assert int((index % 30).max()) == 15


@pytest.mark.long
@pytest.mark.parametrize("history", [36, 50, 52, 68])
def test_encoding_many_histories_together_changes_nothing(history):
    torch.manual_seed(0)
    encoder, rows = HistoryNetwork(9, history, 4), torch.randn(3, history + 28, 9)
    together = latents_along(encoder, rows, 8)
    alone = torch.stack([encoder(rows[:, 4 * index : 4 * index + history]) for index in range(8)], 1)
    torch.testing.assert_close(together, alone)
