"""``safedpa calibrate`` on a recorded drive, and the theory's constants from the training simulator."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from safedpa.adaptation import AdaptationNode
from safedpa.bus import LATENT, LatentMessage, VerdictMessage
from safedpa.bus.messages.codec import encode
from safedpa.bus.messages.topics import STATE, key_of
from safedpa.dynamics import fingerprint, load_model
from safedpa.errors import InputError
from safedpa.networks import Description, EnvironmentEntry, LearnedNetworks, Weights
from safedpa.policy import PolicyNode
from safedpa.records import McapRecorder
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety import MarginCalibration
from safedpa.safety.defaults import margin_for, settings_named
from safedpa_lab.commands.experiment import EXPERIMENTS, ExperimentCommand
from safedpa_services.command_line.calibrate import command
from safedpa_sim.closed_loop import drive
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene

COMMAND = ExperimentCommand(EXPERIMENTS["theory"])

MODEL = load_model("car")


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("drive") / "recording.mcap"
    filtering = SafetyFilterNode(MODEL, settings_named("car"), margin_for(MODEL))
    nodes = [AdaptationNode(MODEL), PolicyNode(MODEL), filtering]
    listener, file = AdaptationNode(MODEL), McapRecorder(path)
    for tick in drive(CarRobot(Scene.random(4, "chair"), 0.05), nodes, 800):
        latent = listener.step("r1", tick.state, {})[LATENT]
        listener.afterwards("r1")
        assert isinstance(latent, LatentMessage)
        assert isinstance(tick.verdict, VerdictMessage)
        at = 10**9 + tick.state.tick * 50_000_000
        file.write(key_of("fleet", "r1", STATE), encode(tick.state), at, at)
        file.write(key_of("fleet", "r1", LATENT), encode(latent), at, at)
    file.close()
    return path


def test_both_margins_are_written_with_their_coverage_on_fresh_steps(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "margin.toml"
    result = CliRunner().invoke(command, [str(recording), "--out", str(out)])
    assert result.exit_code == 0, result.output
    found = MarginCalibration.load(out)
    assert found.fingerprint == fingerprint(MODEL)
    assert set(found.theorem) == set(found.epsilon) == {"obstacle", "field", "speed"}
    assert 600 <= found.transitions < 700  # four fifths of 799
    assert set(found.covered) == {f"{name}.{kind}" for name in ("conformal", "theorem") for kind in found.epsilon}
    for kind, epsilon in found.epsilon.items():
        assert found.covered[f"conformal.{kind}"] > 0.95
        assert found.covered[f"theorem.{kind}"] > 0.97
        assert found.theorem[kind] > epsilon
        assert f"conformal {epsilon:.4f}" in result.output
    assert found.constants["step"] > 0.0


def test_with_enough_drives_the_margins_are_over_drives(tmp_path: Path) -> None:
    """Ten short drives of one robot, each a start of its own; the order of the file is that of nothing."""
    path, file = tmp_path / "recording.mcap", McapRecorder(tmp_path / "recording.mcap")
    for epoch in range(1, 11):
        listener = AdaptationNode(MODEL)
        nodes = [AdaptationNode(MODEL), PolicyNode(MODEL), SafetyFilterNode(MODEL, settings_named("car"), None)]
        robot = CarRobot(Scene.random(epoch, "box"), 0.05, epoch=epoch)
        for tick in drive(robot, nodes, 40):
            latent = listener.step("r1", tick.state, {})[LATENT]
            listener.afterwards("r1")
            at = 10**9 + tick.state.tick * 50_000_000
            file.write(key_of("fleet", "r1", STATE), encode(tick.state), at, at)
            file.write(key_of("fleet", "r1", LATENT), encode(latent), at, at)
    file.close()
    out = tmp_path / "margin.toml"
    result = CliRunner().invoke(command, [str(path), "--out", str(out), "--coverage", "0.85"])
    assert result.exit_code == 0, result.output
    found = MarginCalibration.load(out)
    assert (found.drives, found.transitions) == (8, 8 * 39)
    assert set(found.drive) == set(found.epsilon) == {"obstacle", "field", "speed"}
    assert all(found.drive[kind] >= epsilon for kind, epsilon in found.epsilon.items())
    assert {f"drive.{kind}" for kind in found.epsilon} <= set(found.covered)
    assert "312 transitions of 8 drives" in result.output
    few = CliRunner().invoke(command, [str(path), "--out", str(out), "--coverage", "0.9"])
    assert "too few drives for a margin of a whole drive" in few.output
    assert MarginCalibration.load(out).drives == 0


def test_constants_of_a_model_without_networks_are_refused() -> None:
    result = CliRunner().invoke(COMMAND, ["car", "--simulator", "car_small"])
    assert isinstance(result.exception, InputError)
    assert "no networks" in str(result.exception)


def test_a_command_prints_the_constants(tmp_path: Path) -> None:
    arguments = ["car_simulated", "--states", "60", "--coverage", "0.9", "--out", str(tmp_path / "constants.json")]
    result = CliRunner().invoke(COMMAND, arguments)
    assert result.exit_code == 0, result.output
    found = json.loads((tmp_path / "constants.json").read_text(encoding="utf-8"))
    assert f"{found['constants']['f']['at_coverage']:.4f}" in result.output
    assert 0.5 < found["covered"]["conformal"] <= 1.0


def small_weights(entries: tuple[EnvironmentEntry, ...], seed: int = 0) -> Weights:
    """Untrained networks with mu and phi, of the right shapes."""
    random = np.random.default_rng(seed)
    shapes = {
        "mu": ((8, len(entries)), (2, 8)),
        "f": ((8, 5), (8, 8), (4, 8)),
        "g": ((8, 5), (8, 8), (8, 8)),
        "phi.dense": ((4, 9), (4, 4)),
        "phi.conv": ((4, 4, 8), (4, 4, 8)),
    }
    tensors = {}
    for name, sizes in shapes.items():
        for index, size in enumerate(sizes):
            tensors[f"{name}.{index}.weight"] = random.normal(size=size) / np.sqrt(np.prod(size[1:]))
            tensors[f"{name}.{index}.bias"] = np.zeros(size[0])
    tensors |= {"phi.out.weight": random.normal(size=(2, 4)), "phi.out.bias": np.zeros(2)}
    tensors |= {"feature_middle": np.array([0.0, 0.0, 0.7]), "feature_scale": np.array([1.0, 1.0, 1.5])}
    tensors |= {"action_middle": np.array([0.7, 0.0]), "action_scale": np.array([1.3, 0.34])}
    tensors |= {"increment_scale": np.array([0.03, 0.01, 0.02, 0.1])}
    low, high = (np.array([getattr(entry, name) for entry in entries]) for name in ("low", "high"))
    tensors |= {"environment_middle": 0.5 * (low + high), "environment_scale": 0.5 * (high - low)}
    tensors |= {"latent_low": np.full(2, -3.0), "latent_high": np.full(2, 3.0), "latent_nominal": np.zeros(2)}
    description = Description(
        "car", 0.05, ("x", "y", "yaw", "speed"), ("target_speed", "steer"), 2, 50, environment=entries
    )
    return Weights({name: np.asarray(value, np.float32) for name, value in tensors.items()}, description)


def test_the_simulators_constants_cover_fresh_steps() -> None:
    from safedpa_lab.experiments.driving.theory import theory_experiment
    from safedpa_sim.training.configuration import load_configuration
    from safedpa_sim.training.environments.batched_simulator import BatchedSimulator

    configuration = load_configuration("car_small")
    weights = small_weights(BatchedSimulator(configuration).entries)
    result = theory_experiment(weights, configuration, 500, 0.95, seed=0)
    assert result["history_encoder"]
    assert result["covered"]["bound"] >= 0.95
    assert 0.9 < result["covered"]["conformal"] < 0.99
    assert result["bound"]["largest"] >= result["bound"]["at_coverage"] > result["conformal"] > 0.0
    for pair in result["lipschitz"].values():
        assert 0.0 < pair["largest_slope"] <= pair["bound"]
    assert result["constants"]["latent"]["at_coverage"] > 0.0
    again = theory_experiment(weights, configuration, 500, 0.95, seed=0)
    assert again == result


def test_weights_of_another_environment_are_refused() -> None:
    from safedpa_lab.experiments.driving.theory import simulated_branches
    from safedpa_sim.training.configuration import load_configuration

    other = small_weights((EnvironmentEntry("payload.mass_ratio", 0.0, 1.0),))
    with pytest.raises(InputError, match="the configuration draws"):
        simulated_branches(LearnedNetworks(other), load_configuration("car_small"), 10, 5, 0)
