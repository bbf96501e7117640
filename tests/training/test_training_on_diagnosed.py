"""What was diagnosed joins the environment that the next training draws from."""

from __future__ import annotations

import pytest
import torch

from safedpa.dynamics import load_model, parse_model
from safedpa.errors import InputError
from safedpa.networks import load_weights
from safedpa_services.command_line.group import safedpa
from safedpa_sim.training.configuration import load_configuration, with_diagnosed
from safedpa_sim.training.simulator import BatchedCars

FOUND = """format = 1
robot = "car"
period = 0.02
[base]
kind = "kinematic_bicycle"
drive = "speed_servo"
wheelbase = 0.32
speed_gain = { value = 3.1, free = true }
acceleration_limit = 6.0
[[effects]]
name = "quadratic_drag"
coefficient = 0.12
[[effects]]
name = "speed_command_gain"
gain = 0.8
[[effects]]
name = "towed_load"
mass_ratio = 0.5
deceleration = 1.0
"""


@pytest.fixture(scope="module")
def configuration():
    return with_diagnosed(load_configuration("car_small"), parse_model(FOUND))


def test_effects_are_drawn_about_the_value_that_was_found(configuration):
    assert configuration.environment["quadratic_drag.coefficient"] == pytest.approx((0.06, 0.18))
    assert configuration.environment["speed_command_gain.gain"] == pytest.approx((0.7, 0.9))
    given = load_configuration("car_small").environment
    assert configuration.environment["towed_load.mass_ratio"] == given["towed_load.mass_ratio"]
    assert set(given) < set(configuration.environment)


def test_the_simulator_is_the_diagnosed_model_at_the_period_of_the_configuration(configuration):
    assert configuration.simulator.period == load_configuration("car_small").simulator.period
    cars = BatchedCars(configuration)
    values = {path: setting.value for path, setting in cars.model.settings.items()}
    assert (values["base.speed_gain"], values["base.wheelbase"]) == (3.1, 0.32)
    names = [entry.path for entry in cars.entries]
    drawn = cars.draw_environments(2000, cars.generator(1))[:, names.index("quadratic_drag.coefficient")]
    acting = drawn[drawn > 0.0]
    assert 0.15 < (drawn == 0.0).float().mean() < 0.25
    assert 0.06 <= acting.min() < 0.07
    assert 0.17 < acting.max() <= 0.18


def test_the_command_trains_weights_that_know_the_effect(tmp_path, capsys):
    torch.set_num_threads(1)
    path = tmp_path / "model.toml"
    path.write_text(FOUND, encoding="utf-8")
    out = str(tmp_path / "learned")
    few = ["train", "car", "--small", "--pairs", "4096", "--phases", "1a"]
    assert safedpa.run([*few, "--model", str(path), "--out", out, "--json"]) == 0
    capsys.readouterr()
    entries = load_weights(tmp_path / "learned" / "car_simulated.safetensors").description.environment
    assert "quadratic_drag.coefficient" in {entry.path for entry in entries}


@pytest.mark.parametrize(("name", "message"), [("car_learned", "wanted physics"), ("dart_car", "throttle")])
def test_models_that_cannot_be_trained_on_are_refused(name, message):
    with pytest.raises(InputError, match=message):
        with_diagnosed(load_configuration("car_small"), load_model(name))
