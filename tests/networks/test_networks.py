"""Weights files and inference in numpy: against torch, and against the geometry that it promises."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safedpa.errors import InputError
from safedpa.networks import (
    Description,
    HistoryEncoder,
    LearnedNetworks,
    Weights,
    convolution_stack,
    dense_stack,
    frame_of,
    load_weights,
    save_weights,
)
from safedpa.networks.layers import layers_of

_PLACES = st.floats(-50.0, 50.0)
STATES = st.tuples(_PLACES, _PLACES, st.floats(-7.0, 7.0), st.floats(-1.0, 2.5)).map(np.array)


def test_dense_and_convolution_agree_with_torch(random_car_weights):
    torch = pytest.importorskip("torch")
    weights = random_car_weights(3)
    draw = np.random.default_rng(0)
    x = draw.normal(size=(5, 7)).astype(np.float32)
    seen = torch.from_numpy(x)
    for index in range(3):
        weight, bias = (torch.from_numpy(weights[f"f.{index}.{part}"]) for part in ("weight", "bias"))
        seen = torch.nn.functional.linear(seen, weight, bias)
        seen = torch.relu(seen) if index < 2 else seen
    np.testing.assert_allclose(dense_stack(x, layers_of(weights.tensors, "f"), "relu"), seen.numpy(), atol=1e-5)

    rows = draw.normal(size=(2, 50, 32)).astype(np.float32)
    wave = torch.from_numpy(rows).swapaxes(1, 2)
    for index in range(2):
        weight, bias = (torch.from_numpy(weights[f"phi.conv.{index}.{part}"]) for part in ("weight", "bias"))
        wave = torch.relu(torch.nn.functional.conv1d(wave, weight, bias, stride=4))
    ours = convolution_stack(rows, layers_of(weights.tensors, "phi.conv"), 4)
    assert ours.shape == (2, 1, 32)
    np.testing.assert_allclose(ours, wave.swapaxes(1, 2).numpy(), atol=1e-5)


@given(STATES, STATES)
def test_own_increments_lead_back(state, following):
    frame = frame_of("car")
    reached = state + frame.world_increment(state, frame.own_increment(state, following))
    assert abs(((reached - following)[2] + np.pi) % (2 * np.pi) - np.pi) < 1e-9
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
    assert (f.shape, g.shape) == ((6, 4), (6, 4, 2))
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
    assert np.abs(encoder.encode(1e3 * np.random.default_rng(0).normal(size=(20, 50, 9)))).max() == 3.0


def test_saved_weights_are_read_back(random_car_weights, tmp_path):
    weights = random_car_weights(7)
    save_weights(weights, tmp_path / "car.safetensors")
    again = load_weights(tmp_path / "car.safetensors")
    assert (again.description, again.digest) == (weights.description, weights.digest)
    assert again.source == tmp_path / "car.safetensors"
    assert list(tmp_path.iterdir()) == [tmp_path / "car.safetensors"]


def test_the_digest_sees_every_number(random_car_weights):
    weights = random_car_weights(7)
    bias = weights["phi.out.bias"].copy()
    bias[0] = np.nextafter(bias[0], np.float32(9.0))
    assert weights.with_tensors({"phi.out.bias": bias}).digest != weights.digest


@pytest.mark.parametrize(
    ("name", "tensor", "message"),
    [
        ("f.0.weight", np.zeros((16, 9)), "'f.0.weight' has shape .16, 9., wanted any x 7"),
        ("g.2.weight", np.zeros((7, 16)), "'g.2.weight' has shape .7, 16., wanted 8 x any"),
        ("mu.1.weight", np.zeros((3, 64)), "'mu.1.weight' has shape .3, 64., wanted 4 x any"),
        ("phi.out.weight", np.zeros((4, 64)), "'phi.out.weight' has shape .4, 64., wanted 4 x 32"),
        ("increment_scale", np.array([1.0, 0.0, 1.0, 1.0]), "increment_scale.*positive"),
        ("f.1.bias", np.full(16, np.nan), "'f.1.bias' holds numbers that are not finite"),
        ("latent_low", np.zeros(3), "'latent_low' has shape"),
    ],
)
def test_tensors_that_do_not_fit_are_named(random_car_weights, name, tensor, message):
    with pytest.raises(InputError, match=message):
        random_car_weights(0).with_tensors({name: tensor})


def test_a_history_too_short_for_the_convolutions_is_refused(random_car_weights):
    weights = random_car_weights(0)
    with pytest.raises(InputError, match=r"a history of 20 is too short for 'phi\.conv\.1\.weight'"):
        Weights(weights.tensors, replace(weights.description, history=20))


def test_missing_tensors_are_named(random_car_weights):
    weights = random_car_weights(0)
    tensors = {name: tensor for name, tensor in weights.tensors.items() if name != "action_scale"}
    with pytest.raises(InputError, match="no tensor 'action_scale'"):
        Weights(tensors, weights.description)


def test_files_that_are_no_weights_are_refused(random_car_weights, tmp_path):
    from safetensors.numpy import save_file

    (tmp_path / "text.safetensors").write_text("no weights")
    (tmp_path / "empty.safetensors").touch()
    save_file({"a": np.zeros(3)}, tmp_path / "foreign.safetensors")
    save_file({"a": np.zeros(3)}, tmp_path / "old.safetensors", metadata={"safedpa": '{"format": 7}'})
    save_file({"a": np.zeros(3)}, tmp_path / "key.safetensors", metadata={"safedpa": '{"format": 1, "robots": 2}'})
    for name, message in (
        ("text", "text.safetensors"), ("empty", "empty.safetensors"), ("absent", "absent.safetensors"),
        ("foreign", "no description"), ("old", "wanted format 1"),
        ("key", "description.robots: unknown key; did you mean 'robot'"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=message):
            load_weights(tmp_path / f"{name}.safetensors")


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("latents", "4", "description.latents: got '4'"), ("history", -1, "description.history: got -1"),
        ("period", float("nan"), "description.period: got nan"), ("states", 3, "description: "),
    ],
)  # fmt: skip
def test_a_description_with_wrong_numbers_is_refused(random_car_weights, key, value, message):
    table = json.loads(random_car_weights(0).description.to_json())
    with pytest.raises(InputError, match=message):
        Description.from_json(json.dumps({**table, key: value}))
