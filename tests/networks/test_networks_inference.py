"""Inference in numpy: against torch, and against the geometry that it promises."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safedpa.errors import InputError
from safedpa.networks import HistoryEncoder, LearnedNetworks, convolution_stack, dense_stack, frame_of
from safedpa.networks.layers import layers_of

STATES = st.tuples(st.floats(-50.0, 50.0), st.floats(-50.0, 50.0), st.floats(-7.0, 7.0), st.floats(-1.0, 2.5)).map(
    np.array
)


def test_dense_and_convolution_agree_with_torch(random_car_weights):
    torch = pytest.importorskip("torch")
    weights = random_car_weights(3)
    draw = np.random.default_rng(0)
    x = draw.normal(size=(5, 7)).astype(np.float32)
    seen = torch.from_numpy(x)
    for index in range(3):
        seen = torch.nn.functional.linear(
            seen, *(torch.from_numpy(weights[f"f.{index}.{part}"]) for part in ("weight", "bias"))
        )
        seen = torch.relu(seen) if index < 2 else seen
    np.testing.assert_allclose(dense_stack(x, layers_of(weights.tensors, "f"), "relu"), seen.numpy(), atol=1e-5)

    rows = draw.normal(size=(2, 50, 32)).astype(np.float32)
    wave = torch.from_numpy(rows).swapaxes(1, 2)
    for index in range(2):
        wave = torch.relu(
            torch.nn.functional.conv1d(
                wave, *(torch.from_numpy(weights[f"phi.conv.{index}.{part}"]) for part in ("weight", "bias")), stride=4
            )
        )
    ours = convolution_stack(rows, layers_of(weights.tensors, "phi.conv"), 4)
    assert ours.shape == (2, 1, 32)
    np.testing.assert_allclose(ours, wave.swapaxes(1, 2).numpy(), atol=1e-5)


@given(STATES, STATES)
def test_own_increments_lead_back(state, following):
    frame = frame_of("car")
    reached = state + frame.world_increment(state, frame.own_increment(state, following))
    turn = (reached - following)[2]
    assert abs((turn + np.pi) % (2 * np.pi) - np.pi) < 1e-9
    np.testing.assert_allclose(np.delete(reached, 2), np.delete(following, 2), atol=1e-9)


@given(STATES, st.floats(-9.0, 9.0), st.floats(-9.0, 9.0))
def test_a_car_at_another_position_moves_alike(random_car_weights, state, east, north):
    networks = LearnedNetworks(random_car_weights(1))
    latent = np.array([0.3, -0.2, 0.1, 0.5])
    moved = state + np.array([east, north, 0.0, 0.0])
    for here, there in zip(networks.increment(state, latent), networks.increment(moved, latent), strict=True):
        np.testing.assert_array_equal(here, there)


def test_one_robot_and_many_get_the_same(random_car_weights):
    weights = random_car_weights(2)
    networks, encoder = LearnedNetworks(weights), HistoryEncoder(weights)
    draw = np.random.default_rng(5)
    states, latents = draw.normal(size=(6, 4)), draw.normal(size=(6, 4))
    f, g = networks.increment(states, latents)
    assert f.shape == (6, 4)
    assert g.shape == (6, 4, 2)
    rows = encoder.rows(draw.normal(size=(6, 51, 4)), draw.normal(size=(6, 50, 2)))
    encoded = encoder.encode(rows)
    assert networks.encode(np.array([[0.5, 1.0]])).shape == (1, 4)
    for index in range(6):
        one = networks.increment(states[index], latents[index])
        np.testing.assert_allclose(one[0], f[index], atol=1e-6)
        np.testing.assert_allclose(one[1], g[index], atol=1e-6)
        np.testing.assert_allclose(encoder.encode(rows[index]), encoded[index], atol=1e-5)


def test_a_history_that_is_too_short_is_padded_or_refused(random_car_weights):
    encoder = HistoryEncoder(random_car_weights(4))
    rows = encoder.rows(np.zeros((4, 4)), np.zeros((3, 2)))
    assert encoder.padded(rows).shape == (50, 9)
    assert not encoder.padded(rows)[:47].any()
    np.testing.assert_array_equal(encoder.padded(rows)[47:], rows)
    long = np.arange(60.0)[:, None] * np.ones(9)
    np.testing.assert_array_equal(encoder.padded(long), long[10:])
    with pytest.raises(InputError, match="3 rows of 9, wanted 50 of 9"):
        encoder.encode(rows)
    with pytest.raises(InputError, match="one state more"):
        encoder.rows(np.zeros((4, 4)), np.zeros((4, 2)))


def test_a_latent_stays_in_the_range_that_the_networks_know(random_car_weights):
    encoder = HistoryEncoder(random_car_weights(4))
    latent = encoder.encode(1e3 * np.random.default_rng(0).normal(size=(20, 50, 9)))
    assert np.abs(latent).max() == 3.0
