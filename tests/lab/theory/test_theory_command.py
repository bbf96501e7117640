"""The theory's constants from the training simulator, and the command that prints them."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner

from safedpa.errors import InputError
from safedpa.networks import LearnedNetworks, Weights
from safedpa_lab.commands.experiment import EXPERIMENTS, ExperimentCommand

COMMAND = ExperimentCommand(EXPERIMENTS["theory"])


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


def test_the_simulators_constants_cover_fresh_steps(random_car_weights: Callable[..., Weights]) -> None:
    from safedpa_lab.experiments.driving.theory import theory_experiment
    from safedpa_sim.training.configuration import load_configuration
    from safedpa_sim.training.environments.batched_simulator import BatchedSimulator

    configuration = load_configuration("car_small")
    weights = random_car_weights(latents=2, environment=BatchedSimulator(configuration).entries)
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


def test_weights_of_another_environment_are_refused(random_car_weights: Callable[..., Weights]) -> None:
    from safedpa_lab.experiments.driving.theory import simulated_branches
    from safedpa_sim.training.configuration import load_configuration

    with pytest.raises(InputError, match="the configuration draws"):
        simulated_branches(LearnedNetworks(random_car_weights()), load_configuration("car_small"), 10, 5, 0)
