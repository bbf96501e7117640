"""The exported ONNX networks agree with those in NumPy and torch."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from click.testing import CliRunner

from safedpa.errors import InputError
from safedpa.networks import HistoryEncoder, LearnedNetworks, Weights, save_weights
from safedpa.policy.learned import LearnedPolicy
from safedpa.robots.car.observation import observation_length
from safedpa_services.command_line.export import command
from safedpa_sim.training.export.onnx import NETWORKS, export_onnx
from safedpa_sim.training.networks.modules import Dense, affine_networks, history_network

DRAW = np.random.default_rng(4)
LATENTS = 4
AGREE = 1e-5


@pytest.fixture(scope="module")
def weights(random_car_weights):
    """Returns weights with a policy and a narrow latent range, whose bounds are reached."""
    observations = observation_length(LATENTS)
    tensors = {
        "latent_low": np.full(LATENTS, -0.1),
        "latent_high": np.full(LATENTS, -0.05),
        "observation_middle": DRAW.normal(size=observations),
        "observation_scale": DRAW.uniform(0.5, 2.0, observations),
    }
    for index, (inputs, outputs) in enumerate(pairwise((observations, 128, 128, 2))):
        tensors[f"policy.{index}.weight"] = DRAW.normal(0.0, 1.0 / np.sqrt(inputs), (outputs, inputs))
        tensors[f"policy.{index}.bias"] = DRAW.normal(0.0, 0.1, outputs)
    return random_car_weights(4, LATENTS, 50, 256).with_tensors(tensors)


@pytest.fixture(scope="module")
def run(weights, tmp_path_factory):
    folder = tmp_path_factory.mktemp("onnx")
    assert [path.stem for path in export_onnx(weights, folder)] == list(NETWORKS)

    def call(name, **inputs):
        session = onnxruntime.InferenceSession(folder / f"{name}.onnx", providers=["CPUExecutionProvider"])
        given = {key: np.asarray(value, dtype=np.float32) for key, value in inputs.items()}
        return session.run(None, given)[0]

    return call


STATES = DRAW.normal(size=(9, 4)) * [2.0, 2.0, 3.0, 1.0]
LATENT = DRAW.normal(size=(9, LATENTS))


def test_dynamics_agree_with_numpy_and_torch(weights, run):
    f, g = (run(name, state=STATES, latent=LATENT) for name in ("f", "g"))
    ours = LearnedNetworks(weights).own_increment(STATES, LATENT)
    np.testing.assert_allclose(f, ours[0], atol=AGREE)
    np.testing.assert_allclose(g, ours[1], atol=AGREE)
    actions = DRAW.uniform([-0.6, -0.34], [2.0, 0.34], (9, 2))
    tensors = [torch.tensor(part, dtype=torch.float32) for part in (STATES, actions, LATENT)]
    networks = affine_networks(weights)
    with torch.no_grad():
        trained = networks.increment_scale * networks(*tensors)
    np.testing.assert_allclose(f + (g @ actions[:, :, None])[..., 0], trained, atol=AGREE)


def test_environment_encoder_agrees(weights, run):
    environments = DRAW.uniform([0.0, 0.5], [1.6, 3.5], (5, 2))
    latent = run("mu", environment=environments)
    np.testing.assert_allclose(latent, LearnedNetworks(weights).encode(environments), atol=AGREE)
    with torch.no_grad():
        trained = affine_networks(weights).encode(torch.tensor(environments, dtype=torch.float32))
    np.testing.assert_allclose(latent, trained, atol=AGREE)


def test_history_encoder_agrees_and_keeps_its_range(weights, run):
    rows = DRAW.normal(size=(6, 50, 9))
    latent = run("phi", rows=rows)
    np.testing.assert_allclose(latent, HistoryEncoder(weights).encode(rows), atol=AGREE)
    with torch.no_grad():
        free = history_network(weights)(torch.tensor(rows, dtype=torch.float32)).numpy()
    clipped = free.clip(weights["latent_low"], weights["latent_high"])
    np.testing.assert_allclose(latent, clipped, atol=AGREE)
    assert np.abs(free - clipped).max() > 0.01, "the test should reach the range's ends"


def test_policy_agrees(weights, run):
    observations = 4.0 * DRAW.normal(size=(8, observation_length(LATENTS)))
    action = run("policy", observation=observations)
    np.testing.assert_allclose(action, LearnedPolicy(weights).act(observations), atol=AGREE)
    network = Dense((observation_length(LATENTS), 128, 128, 2), "tanh")
    network.load_state_dict(
        {name.removeprefix("policy."): torch.from_numpy(weights[name]) for name in weights.tensors if "policy." in name}
    )
    scaled = (observations - weights["observation_middle"]) / weights["observation_scale"]
    with torch.no_grad():
        chosen = network(torch.tensor(scaled.clip(-10.0, 10.0), dtype=torch.float32)).clamp(-1.0, 1.0).numpy()
    np.testing.assert_allclose(action, weights["action_middle"] + weights["action_scale"] * chosen, atol=AGREE)


def test_exported_networks_accept_one_robot_or_many(run):
    many = run("f", state=STATES, latent=LATENT)
    one = run("f", state=STATES[:1], latent=LATENT[:1])
    np.testing.assert_allclose(one, many[:1], atol=AGREE)


def test_only_networks_in_the_weights_are_written(weights, tmp_path: Path):
    retained = {name: tensor for name, tensor in weights.tensors.items() if not name.startswith(("phi.", "policy."))}
    written = export_onnx(Weights(retained, weights.description), tmp_path)
    assert [path.name for path in written] == ["mu.onnx", "f.onnx", "g.onnx"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["f.onnx", "g.onnx", "mu.onnx"]


def test_the_command_writes_onnx_files(weights, tmp_path: Path):
    save_weights(weights, tmp_path / "car.safetensors")
    call = CliRunner().invoke(command, [str(tmp_path / "car.safetensors"), "--onnx", str(tmp_path / "onnx")])
    assert call.exit_code == 0, call.output
    assert sorted(path.stem for path in (tmp_path / "onnx").iterdir()) == sorted(NETWORKS)


def test_the_command_refuses_options_of_a_recording(tmp_path: Path):
    call = CliRunner().invoke(command, ["car.safetensors", "--onnx", str(tmp_path), "--format", "csv"])
    assert isinstance(call.exception, InputError)
    assert "got it together with --format" in str(call.exception)
