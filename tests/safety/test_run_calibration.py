"""Margins from runs: nothing to add where the model is right, more where it lacks something, kept with the model."""

from __future__ import annotations

import numpy as np
import pytest

from safedpa.dynamics import PhysicsModel, load_model
from safedpa.errors import InputError
from safedpa.records.run import Run, Stretch
from safedpa.safety.calibration import MarginCalibration
from safedpa.safety.run_calibration import calibration_from_runs
from safedpa.safety.shipped import margin_for, settings_named
from safedpa_sim.experiments.hidden_car import HIDDEN, incomplete_model, oracle_model


def driven(model: PhysicsModel, rows: int = 300) -> Run:
    """What the model itself does under steps of speed and steer."""
    random = np.random.default_rng(4)
    actions = np.column_stack(
        [np.repeat(random.uniform(0.2, 2.0, 30), 10), np.repeat(random.uniform(-0.3, 0.3, 30), 10)]
    )
    states = np.zeros((rows, 4))
    memory = model.initial_memory(actions[0])
    for row in range(rows - 1):
        states[row + 1], memory = model.advance(states[row], actions[row], memory)
    return Run("run", model.system, model.period * np.arange(rows), states, actions, (Stretch(0, rows),))


@pytest.mark.parametrize("name", HIDDEN)
def test_the_true_model_needs_no_margin_and_the_incomplete_one_does(name: str) -> None:
    true, settings = oracle_model(HIDDEN[name]), settings_named("car")
    run = driven(true)
    right = calibration_from_runs(true, settings, [run], 0.95, "2024-01-01")
    wrong = calibration_from_runs(incomplete_model(), settings, [run], 0.95, "2024-01-01")
    assert right.epsilon["obstacle"] < 1e-9
    assert wrong.epsilon["obstacle"] > 0.002
    assert right.fingerprint != wrong.fingerprint


def test_a_saved_margin_belongs_to_its_model(tmp_path) -> None:
    model = incomplete_model()
    calibration = calibration_from_runs(model, settings_named("car"), [driven(model)], 0.95, "2024-01-01")
    calibration.save(tmp_path / "margin.toml")
    assert MarginCalibration.load(tmp_path / "margin.toml") == calibration
    assert margin_for(model, str(tmp_path / "margin.toml")) == calibration


def test_other_robots_and_other_periods_are_refused() -> None:
    with pytest.raises(InputError, match="got a model with the actions throttle, steer"):
        calibration_from_runs(load_model("dart_car"), settings_named("car"), [], 0.9, "2024-01-01")
    run = driven(incomplete_model())
    slow = Run(run.name, run.system, 2.0 * run.t, run.states, run.actions, run.stretches)
    with pytest.raises(InputError, match=r"no transition of 0\.05 s"):
        calibration_from_runs(incomplete_model(), settings_named("car"), [slow], 0.9, "2024-01-01")
