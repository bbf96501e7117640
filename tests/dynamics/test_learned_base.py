"""Learned models: the same object as any other, on floats, numpy, torch and complex numbers, and in files."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from safedpa.dynamics import LearnedBase, PhysicsModel, Setting, fingerprint, load_model, save_model
from safedpa.effects.library import effect
from safedpa.errors import ModelFileError
from safedpa.networks import Weights, save_weights

STATE = np.array([1.0, -2.0, 0.7, 1.1])
ACTION = np.array([1.5, 0.2])
LATENT = np.array([0.3, -0.2, 0.1, 0.5])


@pytest.fixture
def model(random_car_weights) -> PhysicsModel:
    return learned(random_car_weights(1))


def learned(weights: Weights) -> PhysicsModel:
    nominal = load_model("car")
    settings = {path: setting for path, setting in nominal.settings.items() if path.startswith("base.")}
    return PhysicsModel(LearnedBase(nominal.base, weights), (), settings)


def test_it_is_what_the_networks_say(model):
    f, g = model.base.networks.increment(STATE, LATENT)
    np.testing.assert_allclose(model.step(STATE, ACTION, LATENT), STATE + f + g @ ACTION, atol=1e-12)
    tangent = model.affine(STATE, LATENT)
    np.testing.assert_allclose(tangent[0], STATE + f, atol=1e-12)
    np.testing.assert_allclose(tangent[1], g, atol=1e-12)


def test_one_many_and_torch_agree(model):
    torch = pytest.importorskip("torch")
    draw = np.random.default_rng(0)
    states, actions, latents = (draw.normal(size=(7, size)) for size in (4, 2, 4))
    many = model.step(states, actions, latents)
    tensors = model.step(*(torch.from_numpy(part) for part in (states, actions, latents)))
    np.testing.assert_allclose(tensors.numpy(), many, atol=1e-6)
    for row in range(7):
        np.testing.assert_allclose(model.step(states[row], actions[row], latents[row]), many[row], atol=1e-6)
    f, g = model.affine(states, latents, around=actions)
    np.testing.assert_allclose(f + np.einsum("nsa,na->ns", g, actions), many, atol=1e-6)


def test_the_latent_is_free_and_starts_where_nothing_acts(model):
    assert model.latent_names == tuple(f"base.latent_{index}" for index in range(4))
    np.testing.assert_array_equal(model.latent, np.zeros(4))


def test_effects_stand_on_top(model):
    wind = effect("car", "constant_force")
    windy = model.with_effect(wind, {"ax": Setting(0.8), "ay": Setting(0.0)})
    change = windy.step(STATE, ACTION, LATENT) - model.step(STATE, ACTION, LATENT)
    np.testing.assert_allclose(change, [0.0, 0.0, 0.0, 0.05 * 0.8 * np.cos(STATE[2])], atol=1e-9)


def test_a_file_and_its_weights_lead_back(model, tmp_path):
    windy = model.with_effect(effect("car", "constant_force"), {"ax": Setting(0.8), "ay": Setting(0.0)})
    save_model(windy, tmp_path / "learned.toml")
    again = load_model(tmp_path / "learned.toml")
    assert again.latent_names == windy.latent_names
    assert fingerprint(again) == fingerprint(windy) != fingerprint(model)
    np.testing.assert_array_equal(again.step(STATE, ACTION, LATENT), windy.step(STATE, ACTION, LATENT))


def test_other_weights_are_another_model(model, random_car_weights):
    assert fingerprint(learned(random_car_weights(2))) != fingerprint(model)


def test_weights_that_do_not_fit_are_refused(model, random_car_weights, tmp_path):
    path = tmp_path / "learned.toml"
    save_model(model, path)
    text = path.read_text()
    save_weights(random_car_weights(2), tmp_path / "learned.safetensors")
    with pytest.raises(ModelFileError, match=r"networks\.digest: got"):
        load_model(path)
    path.write_text(text.replace("learned.safetensors", "absent.safetensors"))
    with pytest.raises(ModelFileError, match=r"networks\.weights: .*absent"):
        load_model(path)
    weights = random_car_weights(2)
    slow = Weights(weights.tensors, replace(weights.description, period=0.1))
    save_weights(slow, tmp_path / "slow.safetensors")
    path.write_text(
        text.replace("learned.safetensors", "slow.safetensors").replace(model.base.weights.digest, slow.digest)
    )
    with pytest.raises(ModelFileError, match=r"period: got 0.05 s, the networks were trained for 0.1 s"):
        load_model(path)
    path.write_text(text.replace("weights = ", "weigths = "))
    with pytest.raises(ModelFileError, match=r"networks\.weights: missing"):
        load_model(path)


def test_weights_of_another_robot_are_refused(random_car_weights):
    with pytest.raises(ModelFileError, match=r"trained for robot 'car'.*the model is a 'pendulum'"):
        LearnedBase(load_model("dfki_pendulum").base, random_car_weights(0))
