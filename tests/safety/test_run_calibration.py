"""Margins from runs: nothing to add where the model is right, more where it lacks something, kept with the model."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from safedpa.dynamics import PhysicsModel, Setting, fingerprint, load_model
from safedpa.effects import effect
from safedpa.errors import InputError
from safedpa.records.run import Run, Stretch
from safedpa.safety import live_margin as live_margin_module
from safedpa.safety.calibration import MarginCalibration
from safedpa.safety.live_margin import live_margin
from safedpa.safety.margin_text import margin_from_text
from safedpa.safety.run_calibration import calibration_from_runs
from safedpa.safety.shipped import margin_for, settings_named
from safedpa.safety.theory_recorded import RecordedBound, recorded_bound
from safedpa_lab.experiments.hidden_car import HIDDEN, incomplete_model, oracle_model


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
    with pytest.raises(InputError, match=r"got bounds of -0\.6 to 2 1 for throttle"):
        calibration_from_runs(load_model("dart_car"), settings_named("car"), [], 0.9, "2024-01-01")
    run = driven(incomplete_model())
    slow = Run(run.name, run.system, 2.0 * run.t, run.states, run.actions, run.stretches)
    with pytest.raises(InputError, match=r"no transition of 0\.05 s"):
        calibration_from_runs(incomplete_model(), settings_named("car"), [slow], 0.9, "2024-01-01")


def test_a_prediction_without_numbers_is_no_error_of_zero() -> None:
    """A state beyond all numbers: the model has no finite answer, and the margin may not count that as right."""
    run = driven(incomplete_model())
    states = run.states.copy()
    states[7, 3] = 1e308
    wild = Run(run.name, run.system, run.t, states, run.actions, run.stretches)
    with np.errstate(all="ignore"), pytest.raises(InputError, match="errors: got shape"):
        calibration_from_runs(incomplete_model(), settings_named("car"), [wild], 0.9, "2024-01-01")


def stranger() -> PhysicsModel:
    """A car but for the names of its states, so that no robot declares it."""
    model = incomplete_model()
    states = tuple(dataclasses.replace(one, name=f"other_{one.name}") for one in model.system.state)
    model.system = dataclasses.replace(model.system, name="stranger", state=states)
    return model


@pytest.mark.parametrize(
    ("made", "settings"), [(stranger, "car"), (lambda: load_model("point_wind"), "point")], ids=["stranger", "point"]
)
def test_a_robot_around_whose_states_no_barriers_can_be_drawn_gets_no_margin(made: Any, settings: str) -> None:
    model, chosen = made(), settings_named(settings)
    states, actions = np.zeros((4, len(model.system.state))), np.zeros((4, len(model.system.action)))
    run = Run("run", model.system, model.period * np.arange(4), states, actions, (Stretch(0, 4),))
    with pytest.raises(InputError, match="wanted one of a robot that says which barriers may be drawn"):
        calibration_from_runs(model, chosen, [run], 0.5, "2024-01-01")
    assert live_margin(model, chosen, run, ()) == ""
    nothing: Any = None  # not one transition is looked at
    assert recorded_bound(model, chosen, nothing, np.zeros(0, dtype=bool), 0.5) == RecordedBound({}, {})


def swung(model: PhysicsModel, rows: int = 400) -> Run:
    """A pendulum under torques at random, each held for a tenth of a second."""
    torques = np.repeat(np.random.default_rng(6).uniform(-8.0, 8.0, (rows // 10, 1)), 10, axis=0)
    states = np.zeros((rows, 2))
    for row in range(rows - 1):
        states[row + 1] = model.step(states[row], torques[row])
    return Run("swing", model.system, model.period * np.arange(rows), states, torques, (Stretch(0, rows),))


def test_a_pendulum_needs_the_margin_that_its_payload_makes() -> None:
    """h errs by corridor_seconds times the error of the rate: the same at either edge of any corridor."""
    bare, settings = load_model("pendulum"), settings_named("pendulum")
    run = swung(bare.with_effect(effect("pendulum", "tip_mass"), {"mass": Setting(0.5)}))
    loaded = bare.with_effect(effect("pendulum", "tip_mass"), {"mass": Setting(0.5)})
    right = calibration_from_runs(loaded, settings, [run], 0.95, "2024-01-01")
    wrong = calibration_from_runs(bare, settings, [run], 0.95, "2024-01-01")
    assert right.epsilon["corridor"] < 1e-9
    predicted = np.array([bare.step(state, torque) for state, torque in zip(run.states, run.actions, strict=True)])
    ahead = predicted[:-1] @ [1.0, 0.25] - run.states[1:] @ [1.0, 0.25]
    assert wrong.epsilon["corridor"] == pytest.approx(np.quantile(np.abs(ahead), 0.95), rel=0.1)
    assert wrong.fingerprint != right.fingerprint
    text = live_margin(loaded, settings, run, ())
    assert margin_from_text(text).epsilon["corridor"] < 1e-9, "so an effect can be accepted while it swings"


def test_a_robot_of_another_rate_gets_a_margin_of_its_own_steps_with_a_corrected_model() -> None:
    """Of steps of 0.05 s there are none in its run, and one without a margin could not be accepted at all."""
    model, settings = incomplete_model(), settings_named("car")
    usual = margin_from_text(live_margin(model, settings, driven(oracle_model(HIDDEN["steering_offset"])), ()))
    quick = oracle_model(HIDDEN["steering_offset"]).with_period(0.01)
    found = margin_from_text(live_margin(model, settings, driven(quick), ()))
    assert (usual.period, found.period) == pytest.approx((0.05, 0.01))
    assert found.fingerprint == usual.fingerprint == fingerprint(model)
    assert 0.0 < found.epsilon["obstacle"] < usual.epsilon["obstacle"]
    jitters = driven(oracle_model(HIDDEN["steering_offset"]))
    jitters = dataclasses.replace(jitters, t=1.02 * jitters.t)
    assert margin_from_text(live_margin(model, settings, jitters, ())).period == 0.05


@pytest.mark.parametrize("newest", [{"obstacle": 0.01, "field": 0.03}, None])
def test_the_larger_margin_of_all_and_of_the_newest_half_counts(
    newest: dict[str, float] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the half only stretches that hold a transition; where it is too short, all of the run decides alone."""
    asked: list[tuple[Stretch, ...]] = []
    tables = [{"obstacle": 0.02, "field": 0.01, "speed": 0.05}, newest]

    def calibrated(*given: object) -> MarginCalibration:
        (run,) = given[2]  # type: ignore[misc]
        asked.append(run.stretches)
        if (table := tables[len(asked) - 1]) is None:
            raise InputError("too short")
        return MarginCalibration(table, 0.99, 100, "2024-01-01", "f")

    monkeypatch.setattr(live_margin_module, "calibration_from_runs", calibrated)
    model = incomplete_model()
    stretches = (Stretch(0, 6), Stretch(5, 11), Stretch(6, 12), Stretch(13, 20))
    run = dataclasses.replace(driven(model, 20), stretches=stretches)
    found = margin_from_text(live_margin(model, settings_named("car"), run, ())).epsilon
    assert asked == [stretches, (Stretch(10, 12), Stretch(13, 20))]
    assert found == {"obstacle": 0.02, "field": 0.03 if newest else 0.01, "speed": 0.05}
