"""Phase 1a at small scale: it explains the motion, is reproducible bit for bit, and resumes after an interruption."""

from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from safedpa.dynamics import load_model
from safedpa.errors import InputError
from safedpa.networks import LearnedNetworks, Weights
from safedpa_sim.training.configuration import Configuration, load_configuration
from safedpa_sim.training.data.transitions import draw_transitions
from safedpa_sim.training.environments.batched_simulator import BatchedSimulator
from safedpa_sim.training.export.weights import export_model, normalise_latent
from safedpa_sim.training.networks.modules import HistoryNetwork, affine_networks
from safedpa_sim.training.networks.prediction_errors import affine_floor
from safedpa_sim.training.phases import phase_1a
from safedpa_sim.training.phases.phase_1a import train_affine

SMALL = load_configuration("car_small")


def with_pairs(pairs: int, **changes: Any) -> Configuration:
    return replace(SMALL, phase_1a=replace(SMALL.phase_1a, pairs=pairs, batch=256, **changes))


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Weights, dict[str, Any]]:
    torch.set_num_threads(1)
    return train_affine(SMALL, tmp_path_factory.mktemp("phase_1a"))


def test_phase_1a_explains_the_motion(trained: tuple[Weights, dict[str, Any]]) -> None:
    _, summary = trained
    explained = dict(zip(summary["states"], summary["explained"], strict=True))
    assert explained["speed"] > 0.95
    assert min(explained[name] for name in ("x", "y", "yaw")) > 0.98
    assert summary["loss"] < 0.03
    assert summary["learning_curve"][0][1] > 5 * summary["learning_curve"][-1][1]


def test_the_latent_encodes_the_effect_of_the_environment(trained: tuple[Weights, dict[str, Any]]) -> None:
    weights, _ = trained
    networks, cars = affine_networks(weights), BatchedSimulator(SMALL)
    drawn = draw_transitions(cars, 5000, cars.generator(99))
    networks.requires_grad_(False)
    right = networks.encode(drawn.environment)
    swapped = networks.encode(drawn.environment.roll(1, 0))
    measured = drawn.increment / networks.increment_scale
    errors = [
        float((networks(drawn.state, drawn.action, z) - measured)[:, 3].square().mean()) for z in (right, swapped)
    ]
    assert errors[0] < 0.4 * errors[1]


def test_services_and_training_compute_the_same(trained: tuple[Weights, dict[str, Any]], tmp_path: Path) -> None:
    weights, _ = trained
    export_model(weights, SMALL.simulator, tmp_path / "learned.toml")
    model, networks, cars = load_model(tmp_path / "learned.toml"), affine_networks(weights), BatchedSimulator(SMALL)
    drawn = draw_transitions(cars, 100, cars.generator(5))
    with torch.inference_mode():
        latents = networks.encode(drawn.environment)
        following = networks.step(drawn.state, drawn.action, latents)
    numbers = LearnedNetworks(weights).encode(drawn.environment.double().numpy())
    np.testing.assert_allclose(numbers, latents, atol=1e-5)
    states, actions = drawn.state.double().numpy(), drawn.action.double().numpy()
    np.testing.assert_allclose(model.step(states, actions, numbers), following, atol=1e-5)
    for index in range(5):
        np.testing.assert_allclose(
            model.step(states[index], actions[index], numbers[index]), following[index], atol=1e-5
        )


def test_the_latent_is_zero_in_the_neutral_environment_and_has_unit_spread(trained: tuple[Weights, dict[str, Any]]):
    weights, _ = trained
    networks, cars = affine_networks(weights), BatchedSimulator(SMALL)
    with torch.inference_mode():
        np.testing.assert_allclose(networks.encode(cars.nominal), np.zeros(4), atol=1e-5)
        latents = networks.encode(cars.draw_environments(20_000, cars.generator(8)))
    assert latents.std(0).tolist() == pytest.approx([1.0] * 4, abs=0.03)
    assert weights["latent_nominal"].tolist() == [0.0] * 4
    inside = (latents.numpy() >= weights["latent_low"]) & (latents.numpy() <= weights["latent_high"])
    assert inside.mean() > 0.9999


def test_rescaling_the_latent_changes_no_prediction(trained: tuple[Weights, dict[str, Any]]) -> None:
    networks, cars = affine_networks(trained[0]), BatchedSimulator(SMALL)
    drawn = draw_transitions(cars, 500, cars.generator(6))
    with torch.inference_mode():
        before = networks(drawn.state, drawn.action, networks.encode(drawn.environment))
        networks.change_latent(torch.tensor([0.5, -1.0, 2.0, 0.0]), torch.tensor([-2.0, 0.3, 1.0, 5.0]))
        after = networks(drawn.state, drawn.action, networks.encode(drawn.environment))
        assert not np.allclose(networks.encode(cars.nominal), 0.0, atol=0.1)
        normalise_latent(networks, cars, 0)
        normal = networks(drawn.state, drawn.action, networks.encode(drawn.environment))
    np.testing.assert_allclose(after, before, atol=1e-4)
    np.testing.assert_allclose(normal, before, atol=1e-4)


def test_the_description_says_what_it_was_trained_on(trained: tuple[Weights, dict[str, Any]]) -> None:
    described = trained[0].description
    assert [entry.path for entry in described.environment] == list(SMALL.environment)
    assert (described.environment[2].low, described.environment[2].high) == (0.0, 1.6)
    assert (described.trained_on["pairs"], described.trained_on["seed"]) == (147 * 1024, 0)
    assert described.trained_on["configuration"]["phase_1a"]["hidden"] == 64


def same(one: Weights, other: Weights) -> bool:
    return all(np.array_equal(one[name], other[name]) for name in one.tensors) and one.digest == other.digest


def test_an_interrupted_training_gives_the_same_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    configuration, calls = with_pairs(20 * 256, checkpoint_seconds=0.0), 0
    whole, _ = train_affine(configuration, tmp_path / "whole")

    def interrupted(*arguments: Any, **options: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == 8:
            raise KeyboardInterrupt
        return draw_transitions(*arguments, **options)

    monkeypatch.setattr(phase_1a, "draw_transitions", interrupted)
    with pytest.raises(KeyboardInterrupt):
        train_affine(configuration, tmp_path / "part")
    assert calls == 8
    assert (tmp_path / "part" / "checkpoint_1a.pt").exists()
    resumed, summary = train_affine(configuration, tmp_path / "part")
    assert calls == 8 + 13 + 1, "7 steps were kept, 13 were left, and one draw is the held-out one"
    assert same(resumed, whole)
    assert not (tmp_path / "part" / "checkpoint_1a.pt").exists()
    assert [pairs for pairs, _ in summary["learning_curve"]] == [256 * step for step in range(1, 21)]


def test_it_reports_progress_up_to_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Uses a clock that advances by a second per step; with the real clock only the end would be reported."""
    monkeypatch.setattr(phase_1a, "monotonic", count().__next__)
    reported: list[tuple[str, int, int, str]] = []
    train_affine(with_pairs(5 * 256), tmp_path, lambda *phrase: reported.append(phrase))
    assert [(phase, done, everything) for phase, done, everything, _ in reported[-2:]] == [("1a", 5 * 256, 5 * 256)] * 2
    assert [done for _, done, _, _ in reported[:5]] == [256 * step for step in range(1, 6)]
    assert all(note.startswith("loss ") for *_, note in reported)


def test_a_checkpoint_of_another_configuration_is_ignored(tmp_path: Path) -> None:
    first, _ = train_affine(with_pairs(4 * 256), tmp_path / "alone")
    other = replace(with_pairs(8 * 256, checkpoint_seconds=0.0), seed=3)

    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_affine(other, tmp_path, interrupt)
    assert (tmp_path / "checkpoint_1a.pt").exists()
    again, _ = train_affine(with_pairs(4 * 256), tmp_path)
    assert same(first, again)


def test_a_damaged_checkpoint_is_named(tmp_path: Path) -> None:
    (tmp_path / "checkpoint_1a.pt").write_bytes(b"PK\x03\x04 no archive")
    with pytest.raises(InputError, match=r"checkpoint_1a.pt: no usable checkpoint .*remove it to train"):
        train_affine(with_pairs(256), tmp_path)


def test_seeds_decide_the_result(tmp_path: Path) -> None:
    first, again, other = (train_affine(replace(with_pairs(4 * 256), seed=seed), tmp_path)[0] for seed in (0, 0, 1))
    assert same(first, again)
    assert not np.array_equal(first["f.0.weight"], other["f.0.weight"])


def test_ablations_have_no_latent(trained: tuple[Weights, dict[str, Any]], tmp_path: Path) -> None:
    fix, fix_summary = train_affine(SMALL, tmp_path, variant="fix", alone={})
    mix, mix_summary = train_affine(SMALL, tmp_path, variant="mix")
    for weights in (fix, mix):
        assert weights.description.latents == 0
        assert not weights.has("mu")
        assert weights["f.0.weight"].shape == (32, 3)
        export_model(weights, SMALL.simulator, tmp_path / "ablation.toml")
        assert load_model(tmp_path / "ablation.toml").latent_names == ()
    speed = 3
    assert fix_summary["explained"][speed] > 0.95, "in the one environment that it knows"
    # without z the effect of the environments on the speed stays unexplained
    assert mix_summary["explained"][speed] < trained[1]["explained"][speed] - 0.03


def test_the_non_affine_part_is_the_servo_limit() -> None:
    cars = BatchedSimulator(SMALL)
    parameter = "base.acceleration_limit"
    limited = float(affine_floor(cars, cars.generator(0), 200)[3])
    unlimited = {parameter: replace(SMALL.simulator.settings[parameter], value=50.0)}
    free = BatchedSimulator(replace(SMALL, simulator=SMALL.simulator.with_settings(unlimited)))
    assert 0.004 < limited < 0.015
    assert float(affine_floor(free, free.generator(0), 200)[3]) < 1e-4


def test_a_missing_device_is_named() -> None:
    if not torch.cuda.is_available():
        with pytest.raises(InputError, match=r"--device cuda: torch finds no CUDA device here"):
            train_affine(SMALL, Path(), device="cuda")
    with pytest.raises(InputError, match=r"--device abacus: no such kind of device; wanted cpu or cuda"):
        train_affine(SMALL, Path(), device="abacus")


def test_the_history_network_agrees_with_that_of_the_services() -> None:
    network = HistoryNetwork(9, 50, 4)
    names = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
    assert names["phi.dense.0.weight"] == (32, 9)
    assert names["phi.conv.1.weight"] == (32, 32, 8)
    assert names["phi.out.weight"] == (4, 32)
    assert network(torch.zeros(7, 50, 9)).shape == (7, 4)
    with pytest.raises(InputError, match="history: got 35, too short"):
        HistoryNetwork(9, 35, 4)
