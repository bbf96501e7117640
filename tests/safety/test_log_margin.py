"""The margin of a diagnosed model is of the steps that its logs have: those of the model, or of the one other rate."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike

from safedpa.dynamics import PhysicsModel, Setting, fingerprint, load_model
from safedpa.errors import InputError
from safedpa.records.run import Run, Stretch
from safedpa.safety import MarginCalibration
from safedpa.safety.run_calibration import LogMargin, calibration_from_runs, log_margin, log_margin_told
from safedpa.safety.shipped import settings_named
from safedpa_lab.experiments.hidden_car import HIDDEN, incomplete_model, oracle_model
from safedpa_services.driving import drive_command

CAR = incomplete_model()
SETTINGS = settings_named("car")
DRAW = np.random.default_rng(5)


def log_of(steps: ArrayLike, name: str = "run", gaps: int = 0) -> Run:
    """What another model does over ``steps`` [s] of some lengths, cut after every ``gaps`` rows."""
    apart, true = np.asarray(steps, dtype=np.float64), oracle_model(HIDDEN["steering_offset"])
    t = np.concatenate([[0.0], np.cumsum(apart)])
    random = np.random.default_rng(len(apart))
    held = (t / 0.5).astype(int)
    speeds, angles = random.uniform(0.2, 2.0, held[-1] + 1), random.uniform(-0.3, 0.3, held[-1] + 1)
    actions = np.column_stack([speeds[held], angles[held]])
    states = np.zeros((len(t), 4))
    memory = true.initial_memory(actions[0])
    for row, period in enumerate(apart.tolist()):
        states[row + 1], memory = true.advance(states[row], actions[row], memory, period=period)
    edges = [*range(0, len(t), gaps or len(t)), len(t)]
    stretches = tuple(Stretch(*edges[at : at + 2]) for at in range(len(edges) - 1))
    return Run(name, true.system, t, states, actions, stretches)


def told(*runs: Run, model: PhysicsModel = CAR) -> tuple[LogMargin, str]:
    found = log_margin(model, SETTINGS, runs, 0.99, "2026-11-28")
    return found, log_margin_told(model, found)


def refused(*runs: Run, model: PhysicsModel = CAR) -> str:
    with pytest.raises(InputError) as caught:
        told(*runs, model=model)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_logs_of_the_models_own_rate_have_the_margin_that_they_had() -> None:
    run = log_of(np.full(300, 0.05))
    found, said = told(run)
    assert found.calibration == calibration_from_runs(CAR, SETTINGS, [run], 0.99, "2026-11-28")
    assert (found.period, said) == (0.05, ""), "nothing to be told"


@pytest.mark.parametrize("period", [0.01, 1.0 / 7.0, 0.1, 0.025])
def test_logs_of_another_rate_have_a_margin_of_their_own_steps(period: float) -> None:
    found, said = told(log_of(np.full(300, period)), log_of(np.full(200, 1.004 * period)))
    assert found.calibration.period == found.period == pytest.approx(period)
    assert found.calibration.fingerprint == fingerprint(CAR), "it belongs to the model, whatever its steps"
    assert found.calibration.transitions == 500
    assert all(0.0 <= value < 0.2 for value in found.calibration.epsilon.values())
    assert f"The margin is of steps of {period:.3g} s, as the recordings have them" in said
    beyond = f"over the model's own, 0.05 s, it is {0.05 / period:.3g} times as wide and promises nothing"
    assert (beyond if period < 0.05 else "over the model's own, 0.05 s, it is wider than needed") in said


def test_it_is_that_of_the_steps_themselves_and_not_one_that_was_scaled() -> None:
    quick, slow = (told(log_of(np.full(400, period)))[0].calibration.epsilon for period in (0.01, 0.1))
    assert 0.0 < 3.0 * quick["obstacle"] < slow["obstacle"]


def test_a_clock_that_jitters_leaves_steps_near_the_usual_one() -> None:
    found, _ = told(log_of(0.01 * DRAW.uniform(0.7, 1.3, 900)))
    assert found.period == pytest.approx(0.01, rel=0.03)
    assert 200 < found.calibration.transitions < 400
    found, _ = told(log_of(0.01 * DRAW.uniform(0.97, 1.03, 300)))
    assert found.calibration.transitions == 300


def test_gaps_and_single_rows_are_left_out() -> None:
    found, _ = told(log_of(np.full(600, 0.01), gaps=5), log_of(np.full(50, 0.2), "alone", gaps=1))
    assert found.period == pytest.approx(0.01)
    assert found.calibration.transitions == 480


def test_of_several_rates_the_models_own_counts_if_it_has_steps_enough() -> None:
    """However many others there are: of 60,000 rows each twentieth is taken, but these are not thinned out by that."""
    own, quick = log_of(np.full(99, 0.05), "own"), log_of(np.full(9000, 0.01), "quick")
    found, said = told(quick, own)
    assert (found.period, found.calibration.transitions, found.others) == (0.05, 99, 9000)
    assert said == "The margin is of the model's own steps of 0.05 s; 9000 steps of other lengths tell nothing of it."
    both = log_of(np.concatenate([np.full(120, 0.05), np.full(3000, 0.01)]))
    assert told(both)[0].calibration.transitions == pytest.approx(120, abs=1)


@pytest.mark.parametrize("together", [False, True])
def test_of_several_rates_without_the_models_own_none_is_chosen(together: bool) -> None:
    """In two recordings or in one: nobody says at which of them the robot will drive."""
    parts = [np.full(900, 0.01), np.full(200, 1.0 / 7.0)]
    runs = [log_of(np.concatenate(parts))] if together else [log_of(part) for part in parts]
    said = refused(*runs)
    assert said == (
        "margin: got steps of 0.01 to 0.143 s, none of the model's own 0.05 s, wanted recordings of one rate or 99 "
        "steps of the model's own; diagnose those of one rate alone, or record at the model's"
    )
    few = refused(*runs, log_of(np.full(98, 0.05)))
    assert "98 of the model's own 0.05 s" in few


def test_a_moment_at_another_rate_does_not_hide_that_of_the_log() -> None:
    found, said = told(log_of(np.concatenate([np.full(1000, 0.01), np.full(20, 0.04)])))
    assert (found.calibration.transitions, found.others) == (1000, 20)
    assert "20 steps of other lengths tell nothing of it" in said


def test_the_time_counts_and_not_the_rows() -> None:
    """Of quick steps there are many in a moment, of slow ones few in most of a drive."""
    slow, moment = log_of(np.full(300, 1.0 / 7.0)), log_of(np.full(400, 0.01))
    assert told(slow, moment)[0].period == pytest.approx(1.0 / 7.0)
    assert "got steps of 0.01 to 0.143 s" in refused(log_of(np.full(3000, 0.01)), slow)
    assert "no transition of 0.015 s, wanted runs with steps of that length" in refused(
        log_of(np.tile([0.01, 0.02], 150))
    )


@pytest.mark.parametrize(("rows", "period"), [(60, 0.01), (98, 0.1), (98, 0.05)])
def test_a_log_that_is_too_short_is_refused(rows: int, period: float) -> None:
    assert f"transitions: got {rows}, wanted at least 99 for a coverage of 0.99" in refused(
        log_of(np.full(rows, period))
    )


def test_a_log_without_a_step_is_refused() -> None:
    alone = log_of(np.full(10, 0.05), gaps=1)
    for runs in ((), (alone,), (replace(alone, stretches=()),)):
        assert refused(*runs).startswith("margin: got no step, wanted recordings with at least 99 of one length")


def test_networks_tell_no_other_steps_than_those_that_they_were_trained_on() -> None:
    learned = load_model("car_learned")
    said = refused(log_of(np.full(300, 0.01)), model=learned)
    assert said == (
        "margin: got steps of 0.01 s, wanted those of 0.05 s, on which the model's networks were trained; "
        "record at that rate"
    )
    assert told(log_of(np.full(300, 0.05)), model=learned)[0].period == 0.05


def test_the_command_that_drives_with_it_has_the_rate_of_its_steps() -> None:
    """At its model's own the filter would widen a margin of quicker steps, and promise nothing."""
    path, margin = Path("model.toml"), Path("margin.toml")
    usual = drive_command(CAR, path, margin)
    assert drive_command(CAR, path, margin, period=0.05) == usual == drive_command(CAR, path, margin, period=0.0501)
    assert drive_command(CAR, path, margin, period=1.0 / 7.0) == f"{usual} --rate 7"
    assert drive_command(CAR, path, margin, period=0.0101) == f"{usual} --rate 99.01"
    assert drive_command(CAR, path, margin, period=0.001) == drive_command(CAR, path, margin, period=2.0) == usual
    assert drive_command(CAR, path, margin, period=1.0) == f"{usual} --rate 1"


def test_the_margin_of_a_model_with_free_numbers_stays_its_own() -> None:
    free = CAR.with_settings({"base.speed_gain": Setting(3.0, free=True)})
    found, _ = told(log_of(np.full(300, 0.02)), model=free)
    assert found.calibration.fingerprint == fingerprint(free)
    assert MarginCalibration.parse(found.calibration.write()) == found.calibration


def test_stretches_of_two_rows_have_a_step() -> None:
    """Of a log that loses every third row."""
    found = log_margin(CAR, SETTINGS, [log_of([0.1] * 399, gaps=2)], 0.99, "2026-11-28")
    assert (found.period, found.calibration.transitions) == (pytest.approx(0.1), 200)
