"""The training simulator, mended by a diagnosis of circles of the pymunk car."""

from __future__ import annotations

import pytest

from safedpa.dynamics import PhysicsModel
from safedpa.effects import AbstractEffect, effect
from safedpa.errors import InputError
from safedpa_sim.training.configuration import load_configuration
from safedpa_sim.training.grounded_simulator import ground_simulator, grounded_configuration
from safedpa_sim.training.simulator import BatchedCars
from safedpa_sim.training.tuning_data import record_circles

NEAREST = ("steering_lag", "steering_delay", "actuator_delay", "rolling_resistance", "understeer", "quadratic_drag")
"""Of the library, what the pymunk car has or what is easily taken for it: the rest takes time and is not added."""


@pytest.mark.long
@pytest.mark.slow
def test_the_corrected_simulator_predicts_the_real_car(monkeypatch: pytest.MonkeyPatch) -> None:
    library = [effect("car", name) for name in (*NEAREST, "towed_load")]

    def without(model: PhysicsModel) -> list[AbstractEffect]:
        return [item for item in library if item.name not in {own.name for own in model.effects}]

    monkeypatch.setattr("safedpa.diagnosis.diagnose.library_for", without)
    configuration = load_configuration("car_small")
    grounded = ground_simulator(configuration, record_circles(900, seed=3, run_pairs=300))
    errors = grounded.summary()["heldout_error"]
    assert errors[-1] < 0.35 * errors[0]
    late_steering = {"steering_lag", "steering_delay", "actuator_delay"}
    assert late_steering & set(grounded.report.added)
    assert "towed_load" not in grounded.report.added
    assert not grounded.model.latent_names  # every parameter is fixed: training draws its own
    cars = BatchedCars(grounded_configuration(configuration, grounded))
    assert [entry.path for entry in cars.entries] == list(configuration.environment)
    assert cars.remembers


def test_runs_without_information_are_refused() -> None:
    configuration = load_configuration("car_small")
    with pytest.raises(InputError, match="say nothing about the simulator"):
        ground_simulator(configuration, record_circles(60, seed=3, run_pairs=60))
