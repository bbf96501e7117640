"""Recorded circles have the excitation that tuning needs; unsuitable runs are refused with the reason."""

import numpy as np
import pytest

from safedpa.dynamics import PhysicsModel
from safedpa.effects import AbstractEffect, effect
from safedpa.errors import InputError
from safedpa.records import Run, Stretch, write_csv
from safedpa.robots.car.system import CAR
from safedpa_sim.training.configuration import load_configuration
from safedpa_sim.training.data.recorded_runs import HORIZON, PERIOD, drives_of, load_tuning_runs, record_circles, split
from safedpa_sim.training.environments.batched_simulator import BatchedSimulator
from safedpa_sim.training.phases.phase_3 import ground_simulator, grounded_configuration

HISTORY = 36


@pytest.fixture(scope="module")
def weights(random_car_weights):
    return random_car_weights(1, history=HISTORY)


@pytest.fixture(scope="module")
def circles():
    return record_circles(600, 1, 300)


def changed(run, **columns):
    """Returns the run with transformed columns."""
    values = {
        **dict(zip(CAR.state_names, run.states.T, strict=True)),
        **dict(zip(CAR.action_names, run.actions.T, strict=True)),
        "t": run.t,
    }
    values |= {name: change(values[name]) for name, change in columns.items()}
    states, actions = (np.stack([values[name] for name in names], 1) for names in (CAR.state_names, CAR.action_names))
    return Run(run.name, CAR, values["t"], states, actions, run.stretches)


def shortened(run, rows):
    return Run(run.name, CAR, run.t[:rows], run.states[:rows], run.actions[:rows], (Stretch(0, rows),))


def test_good_runs_become_drives(circles, weights):
    drives = drives_of(circles, weights)
    assert [len(drive.actions) for drive in drives] == [300, 300]
    np.testing.assert_array_equal(drives[1].states, circles[1].states)
    np.testing.assert_array_equal(drives[1].actions, circles[1].actions[:-1])


@pytest.mark.parametrize("rows", [2, HISTORY, HISTORY + HORIZON])
def test_a_run_shorter_than_history_and_horizon_is_refused(circles, weights, rows):
    with pytest.raises(InputError, match=f"{rows} rows, wanted more than {HISTORY + HORIZON}"):
        drives_of([shortened(circles[0], rows)], weights)


def test_a_run_one_row_longer_is_accepted(circles, weights):
    assert len(drives_of([shortened(circles[0], HISTORY + HORIZON + 1), circles[1]], weights)) == 2


def test_a_gap_in_the_middle_leaves_two_short_runs(circles, weights):
    run = shortened(circles[0], 100)
    broken = Run(run.name, CAR, run.t, run.states, run.actions, (Stretch(0, 50), Stretch(50, 100)))
    with pytest.raises(InputError, match="longest stretch without a gap has 50 rows"):
        drives_of([broken], weights)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        *(
            ({signal: lambda values: 0.0 * values + 0.1}, f"{signal} hardly changes")
            for signal in (*CAR.action_names, "speed")
        ),
        ({"t": lambda t: 2.0 * t}, r"a row every 0\.1 s, wanted every 0\.05 s"),
        ({"t": lambda t: t + 0.02 * (np.arange(len(t)) % 2)}, "wanted e"),
        ({"steer": lambda steer: 3.0 * np.sign(steer)}, r"steer from .* the range trained on \(\d+ % of the rows"),
    ],
)
def test_a_run_that_cannot_tune_is_refused_with_the_reason(columns, message, circles, weights):
    with pytest.raises(InputError, match=message):
        drives_of([changed(run, **columns) for run in circles], weights)


def test_no_runs_are_refused(weights):
    with pytest.raises(InputError, match="got none"):
        drives_of([], weights)


def test_a_file_with_values_that_are_no_numbers_is_cut_there(circles, weights, tmp_path):
    values = circles[0].states.copy()
    write_csv(circles[0], tmp_path / "run.csv")
    lines = (tmp_path / "run.csv").read_text().splitlines()
    for row in range(101, 104):
        lines[row] = ",".join(["nan" if index == 4 else cell for index, cell in enumerate(lines[row].split(","))])
    (tmp_path / "run.csv").write_text("\n".join(lines) + "\n")
    drives = load_tuning_runs([tmp_path / "run.csv"], None, CAR, weights)
    assert [len(drive.states) for drive in drives] == [100, len(values) - 103]


def test_whole_runs_are_held_out_where_there_are_several(circles, weights):
    drives = drives_of([*circles, *circles, *circles], weights)
    fitted, held_out = split(drives, HISTORY)
    assert (len(fitted), len(held_out)) == (5, 1)


def test_the_end_of_a_single_run_is_held_out(circles, weights):
    drives = drives_of(circles[:1], weights)
    (fitted,), (held_out,) = split(drives, HISTORY)
    assert len(held_out.actions) == 60
    np.testing.assert_array_equal(fitted.states[-1], held_out.states[0])
    assert len(fitted.actions) + len(held_out.actions) == 300


def test_a_single_run_too_short_to_be_divided_is_refused(circles, weights):
    drives = drives_of([shortened(circles[0], 2 * (HISTORY + HORIZON))], weights)
    with pytest.raises(InputError, match="one part to tune on and one to evaluate"):
        split(drives, HISTORY)


@pytest.fixture(scope="module")
def runs():
    return record_circles(2000, seed=3, run_pairs=1000)


def test_as_many_pairs_as_asked_for_in_runs_of_one_length(runs):
    assert ([len(run.t) - 1 for run in runs], runs[0].period) == ([1000, 1000], pytest.approx(PERIOD))


def test_the_same_seed_gives_the_same_runs_and_another_one_others(runs):
    again, other = record_circles(1000, 3, 1000)[0], record_circles(1000, 4, 1000)[0]
    assert np.array_equal(again.states, runs[0].states)
    assert not np.array_equal(other.states, runs[0].states)


def test_commands_are_held_for_one_to_three_seconds(runs):
    changes = np.flatnonzero(np.any(np.diff(runs[0].actions, axis=0) != 0.0, axis=1))
    holds = np.diff(changes) * PERIOD
    assert holds.min() >= 1.0 - 1e-9
    assert holds.max() <= 3.0 + 1e-9


def test_commands_cover_the_range_and_the_car_follows_them_late(runs):
    run = runs[0]
    assert run.actions[:, 0].min() < -0.3
    assert run.actions[:, 0].max() > 1.5
    assert np.abs(run.actions[:, 1]).max() > 0.3
    error = np.abs(run.states[1:, 3] - run.actions[:-1, 0])
    changes = np.flatnonzero(np.abs(np.diff(run.actions[:, 0])) > 0.5)
    assert np.mean(error[changes + 1]) > 3.0 * np.mean(error[changes - 1])


def test_recording_nothing_is_refused():
    with pytest.raises(InputError, match="0 pairs"):
        record_circles(0, 1)


NEAREST = ("steering_lag", "steering_delay", "actuator_delay", "rolling_resistance", "understeer", "quadratic_drag")
"""The effects that the simulated car has, or that resemble them; searching the others takes time and adds none."""


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
    assert not grounded.model.latent_names  # every parameter is fixed, because training draws its own values
    cars = BatchedSimulator(grounded_configuration(configuration, grounded))
    assert [entry.path for entry in cars.entries] == list(configuration.environment)
    assert cars.remembers


def test_runs_without_information_are_refused() -> None:
    configuration = load_configuration("car_small")
    with pytest.raises(InputError, match="not informative enough to correct the simulator"):
        ground_simulator(configuration, record_circles(60, seed=3, run_pairs=60))
