"""A fault of the data is found by the model's own prediction before any effect is tried, and not in a good log."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from safedpa.diagnosis.fit.data_checks import PreparedRuns, check_data_sufficiency, data_at_horizon, prepare_runs
from safedpa.dynamics import load_model
from safedpa.dynamics.user_files import load_user_file_everywhere
from safedpa.effects import Context, Parameter, RateEffect, Stage
from safedpa.effects.library import REGISTERED
from safedpa.records import Run, load_run
from safedpa_lab.hidden import cases_of
from safedpa_lab.hidden import write_case as write_hidden
from safedpa_lab.own_robots import models
from safedpa_lab.own_robots.cases import OwnCase, write_case
from safedpa_lab.own_robots.data_faults import FAULTS, Log, faulty_log, good_log

pytestmark = pytest.mark.slow


def prepared(folder: Path, robot: str, log: Log, keep: tuple[str, ...] = ()) -> tuple[PreparedRuns, list[Run]]:
    load_user_file_everywhere(Path(models.__file__))
    file, _, _ = write_case(OwnCase("own_none", robot, 1, {}, 1), folder, [(log.t, log.states, log.actions)])
    model = load_model(file)
    runs = [replace(Run.from_arrays(log.t, log.states, log.actions, model), keep=keep)]
    return prepare_runs(model, runs), runs


def kinds(found: PreparedRuns) -> set[Any]:
    return {row["kind"] for row in found.quality}


@pytest.mark.parametrize(
    ("fault", "robot", "kind", "channel"),
    [
        ("states_drift", "own_quadrotor", "clock_drift", "vx"),
        ("states_drift", "own_boat", "clock_drift", "x and y and yaw"),
        ("commands_drift", "own_joint", "clock_drift", "current"),
        ("wheel_reversed", "own_quadrotor", "opposite_sign", "roll"),
        ("wheel_reversed", "own_omni", "opposite_sign", "uw"),
    ],
)
def test_a_fault_of_a_channel_is_named_and_no_effect_is_tried(
    tmp_path: Path, fault: str, robot: str, kind: str, channel: str
) -> None:
    log, truth = faulty_log(FAULTS[fault], robot, 79000)
    found, runs = prepared(tmp_path, robot, log)
    (message,) = (row["message"] for row in found.quality if row["kind"] == kind)
    assert channel in message
    assert "nothing was cut" in message
    if kind == "clock_drift":
        seconds = float(message.split(" s later than")[0].split()[-1])
        assert seconds == pytest.approx(truth.size, rel=0.3)
    shooting = data_at_horizon(found.runs, found.seconds).shooting
    assert check_data_sufficiency(shooting, found.runs, runs).wrong


class Diverging(RateEffect):
    """An effect whose predictions overflow at every size that is tried."""

    name = "diverging"
    robot = "own_joint"
    stage = Stage.RESISTANCE
    equation = "d(rate)/dt += exp(size rate^2)"
    parameters = (Parameter("size", "s2/rad2", 0.0, 1e6, 1e3),)
    signature = "none"
    source = "a user's mistake"

    def modify(self, rates: Mapping[str, Any], parameters: Mapping[str, Any], context: Context) -> dict[str, Any]:
        speed = context.state["rate"]
        return {**rates, "rate": rates["rate"] + context.operations.exp(parameters["size"] * (1.0 + speed * speed))}


def test_an_effect_that_diverges_does_not_hide_a_drifting_clock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    load_user_file_everywhere(Path(models.__file__))
    monkeypatch.setitem(REGISTERED, ("own_joint", "diverging"), Diverging())
    log, _ = faulty_log(FAULTS["commands_drift"], "own_joint", 79000)
    found, _ = prepared(tmp_path, "own_joint", log)
    assert "clock_drift" in kinds(found)


@pytest.mark.parametrize(
    ("robot", "kind"), [("own_quadrotor", "outside"), ("own_servo", "effect"), ("own_joint", "plain")]
)
def test_a_good_log_has_no_such_fault(tmp_path: Path, robot: str, kind: str) -> None:
    found, _ = prepared(tmp_path, robot, good_log(kind, robot, 79500))
    assert not kinds(found) & {"clock_drift", "opposite_sign", "coarse_part"}


@pytest.mark.parametrize(("suite", "seed"), [("ordinary", 1995572000), ("ordinary", 1371787591), ("hard", 3216918331)])
def test_a_missing_effect_is_no_drifting_clock(tmp_path: Path, suite: str, seed: int) -> None:
    # In one of six logs the drive differs between beginning and end so much that the effect looks like a drift.
    (case,) = (case for case in cases_of(suite, 16, 91003) if case.seed == seed)
    log = write_hidden(case, tmp_path)
    model = load_model(log.model)
    found = prepare_runs(model, [load_run(path, model.system) for path in log.runs])
    assert "clock_drift" not in kinds(found)


def test_a_recalibrated_angle_is_no_gravity_and_a_relocalisation_only_cuts(tmp_path: Path) -> None:
    log, truth = faulty_log(FAULTS["recalibrated"], "own_joint", 79000)
    found, runs = prepared(tmp_path / "joint", "own_joint", log)
    (row,) = (row for row in found.quality if row["kind"] == "offset")
    assert row["start_t"] == truth.time
    assert float(row["message"].split(" rad ")[0].split()[-1]) == pytest.approx(abs(truth.size), rel=0.05)
    assert ("more" if truth.size > 0 else "less") in row["message"]
    shooting = data_at_horizon(found.runs, found.seconds).shooting
    assert check_data_sufficiency(shooting, found.runs, runs).wrong
    kept, (run,) = prepared(tmp_path / "kept", "own_joint", log, ("offset",))
    assert "kept_offset" in kinds(kept)
    assert not check_data_sufficiency(shooting, kept.runs, [run]).wrong
    log, _ = faulty_log(FAULTS["recalibrated"], "own_boat", 79000)
    found, _ = prepared(tmp_path / "boat", "own_boat", log)
    assert "jump" in kinds(found)
    assert "offset" not in kinds(found)


def test_of_a_log_that_is_mostly_out_of_bounds_no_effect_is_named(tmp_path: Path) -> None:
    log, _ = faulty_log(FAULTS["degrees"], "own_quadrotor", 83000)
    found, runs = prepared(tmp_path, "own_quadrotor", log)
    shooting = data_at_horizon(found.runs, found.seconds).shooting
    sufficient = check_data_sufficiency(shooting, found.runs, runs)
    assert sufficient.wrong
    assert "widen the bound" in sufficient.why_not


def test_of_a_log_that_is_out_of_bounds_for_a_while_the_rest_is_used(tmp_path: Path) -> None:
    log = good_log("plain", "own_quadrotor", 79500)
    log.states[400:1200, 0] = 25.0
    found, runs = prepared(tmp_path, "own_quadrotor", log)
    (row,) = (row for row in found.quality if row["kind"] == "out_of_bounds")
    assert row["count"] == 800
    for most_rows in (40_000, 700):  # thinned to fewer rows than were cut
        used = prepare_runs(load_model(tmp_path / "given" / "model.toml"), runs, most_rows)
        shooting = data_at_horizon(used.runs, used.seconds).shooting
        assert "bound" not in check_data_sufficiency(shooting, used.runs, runs).why_not


def test_rows_from_which_a_state_has_coarse_steps_are_left_out(tmp_path: Path) -> None:
    log, truth = faulty_log(FAULTS["quantised"], "own_servo", 79000)
    found, runs = prepared(tmp_path, "own_servo", log)
    assert truth.time is not None
    assert found.runs[0].t[found.runs[0].stretches[-1].stop - 1] == pytest.approx(truth.time - 0.02, abs=0.05)
    (row,) = (row for row in found.quality if row["kind"] == "coarse_part")
    assert row["count"] == len(log.t) - len(found.runs[0].stretches[0])
    assert f"t = {truth.time:.3f} s" in row["message"]
    assert runs[0].duration == pytest.approx(float(log.t[-1]))


def test_both_are_kept_on_request(tmp_path: Path) -> None:
    log, _ = faulty_log(FAULTS["quantised"], "own_servo", 79000)
    kept, (run,) = prepared(tmp_path / "coarse", "own_servo", log, ("coarse_part",))
    assert "coarse_part" not in kinds(kept)
    assert kept.runs[0].duration == run.duration
    log, _ = faulty_log(FAULTS["states_drift"], "own_boat", 79000)
    kept, (run,) = prepared(tmp_path / "drift", "own_boat", log, ("clock_drift",))
    assert "kept_clock_drift" in kinds(kept)
    shooting = data_at_horizon(kept.runs, kept.seconds).shooting
    assert not check_data_sufficiency(shooting, kept.runs, [run]).wrong


def test_steps_throughout_or_soon_after_the_start_cut_nothing(tmp_path: Path) -> None:
    log, _ = faulty_log(FAULTS["rate_quantised"], "own_servo", 79000)
    found, runs = prepared(tmp_path / "whole", "own_servo", log)
    assert "quantised" in kinds(found)
    assert "coarse_part" not in kinds(found)
    early = good_log("plain", "own_servo", 79000)
    early.states[100:, 0] = 0.08 * np.round(early.states[100:, 0] / 0.08)
    found, runs = prepared(tmp_path / "early", "own_servo", early)
    assert "quantised" in kinds(found)
    assert found.runs[0].duration == runs[0].duration
