"""Weights files: what is written is read, and what does not fit is refused by name."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from safedpa.errors import InputError
from safedpa.networks import Description, Weights, load_weights, save_weights


def test_what_is_written_is_read(random_car_weights, tmp_path):
    weights = random_car_weights(7)
    save_weights(weights, tmp_path / "car.safetensors")
    again = load_weights(tmp_path / "car.safetensors")
    assert again.description == weights.description
    assert again.digest == weights.digest
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
    save_file({"a": np.zeros(3)}, tmp_path / "foreign.safetensors")
    save_file({"a": np.zeros(3)}, tmp_path / "old.safetensors", metadata={"safedpa": '{"format": 7}'})
    save_file({"a": np.zeros(3)}, tmp_path / "key.safetensors", metadata={"safedpa": '{"format": 1, "robots": 2}'})
    for name, message in (
        ("text", "text.safetensors"),
        ("foreign", "no description"),
        ("old", "wanted format 1"),
        ("key", "description.robots: unknown key; did you mean 'robot'"),
        ("absent", "absent.safetensors"),
    ):
        with pytest.raises(InputError, match=message):
            load_weights(tmp_path / f"{name}.safetensors")


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("latents", "4", "description.latents: got '4'"),
        ("history", -1, "description.history: got -1"),
        ("period", float("nan"), "description.period: got nan"),
        ("states", 3, "description: "),
    ],
)
def test_a_description_with_wrong_numbers_is_refused(random_car_weights, key, value, message):
    table = json.loads(random_car_weights(0).description.to_json())
    with pytest.raises(InputError, match=message):
        Description.from_json(json.dumps({**table, key: value}))


def test_an_empty_file_is_refused(tmp_path):
    (tmp_path / "empty.safetensors").touch()
    with pytest.raises(InputError, match=r"empty\.safetensors"):
        load_weights(tmp_path / "empty.safetensors")
