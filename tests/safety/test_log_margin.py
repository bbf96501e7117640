"""Margins of logs, over drives, and kept from the last decision: never beyond what they were made for."""

import dataclasses
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy.stats import binom

from safedpa.api.deployment import drive_command
from safedpa.calibration.from_drives import calibration_from_drives, covered_shares
from safedpa.calibration.from_runs import LogMargin, calibration_from_runs, log_margin, log_margin_message
from safedpa.dynamics import PhysicsModel, Setting, fingerprint, load_model
from safedpa.errors import InputError
from safedpa.records.run import Run, Stretch
from safedpa.robots.car.barriers.obstacles import car_barriers
from safedpa.safety import FilterSettings, MarginCalibration, Prediction, parse_settings, split_conformal_margin
from safedpa.safety.barriers.limits import SpeedBarrier
from safedpa.safety.barriers.stack import make_barrier_set
from safedpa.safety.defaults import settings_named
from safedpa.safety.margins.active import ActiveMargins
from safedpa.safety.margins.conformal import margins_over_drives
from safedpa.safety.margins.error_clipping import ErrorClip, HSample
from safedpa.safety.solver.sqp import DecisionError
from safedpa_lab.experiments.driving.safety_pays import HIDDEN, incomplete_model, oracle_model

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


def reported(*runs: Run, model: PhysicsModel = CAR) -> tuple[LogMargin, str]:
    found = log_margin(model, SETTINGS, runs, 0.99, "2026-11-28")
    return found, log_margin_message(model, found)


def refused(*runs: Run, model: PhysicsModel = CAR) -> str:
    with pytest.raises(InputError) as caught:
        reported(*runs, model=model)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_logs_of_the_models_own_rate_have_the_margin_that_they_had() -> None:
    run = log_of(np.full(300, 0.05))
    found, notice = reported(run)
    assert found.calibration == calibration_from_runs(CAR, SETTINGS, [run], 0.99, "2026-11-28")
    assert (found.period, notice) == (0.05, ""), "nothing to report"


@pytest.mark.parametrize("period", [0.01, 1.0 / 7.0, 0.1, 0.025])
def test_logs_of_another_rate_have_a_margin_of_their_own_steps(period: float) -> None:
    found, notice = reported(log_of(np.full(300, period)), log_of(np.full(200, 1.004 * period)))
    assert found.calibration.period == found.period == pytest.approx(period)
    assert found.calibration.fingerprint == fingerprint(CAR), "it belongs to the model, whatever its steps"
    assert found.calibration.transitions == 500
    assert all(0.0 <= value < 0.2 for value in found.calibration.epsilon.values())
    assert f"The margin is valid for steps of {period:.3g} s, as in the recordings" in notice
    beyond = f"for the model's period of 0.05 s it is scaled by {0.05 / period:.3g} and has no guarantee"
    assert (beyond if period < 0.05 else "for the model's period of 0.05 s it is wider than needed") in notice


def test_it_is_that_of_the_steps_themselves_and_not_one_that_was_scaled() -> None:
    quick, slow = (reported(log_of(np.full(400, period)))[0].calibration.epsilon for period in (0.01, 0.1))
    assert 0.0 < 3.0 * quick["obstacle"] < slow["obstacle"]


def test_gaps_and_single_rows_are_left_out_and_a_jittering_clock_leaves_steps_near_the_usual_one() -> None:
    found, _ = reported(log_of(0.01 * DRAW.uniform(0.7, 1.3, 900)))
    assert found.period == pytest.approx(0.01, rel=0.03)
    assert 200 < found.calibration.transitions < 400
    found, _ = reported(log_of(0.01 * DRAW.uniform(0.97, 1.03, 300)))
    assert found.calibration.transitions == 300
    found, _ = reported(log_of(np.full(600, 0.01), gaps=5), log_of(np.full(50, 0.2), "alone", gaps=1))
    assert found.period == pytest.approx(0.01)
    assert found.calibration.transitions == 480


def test_of_several_rates_the_models_own_counts_if_it_has_steps_enough() -> None:
    """However many others there are: of 60,000 rows each twentieth is taken, but these are not thinned out by that."""
    own, quick = log_of(np.full(99, 0.05), "own"), log_of(np.full(9000, 0.01), "quick")
    found, notice = reported(quick, own)
    assert (found.period, found.calibration.transitions, found.others) == (0.05, 99, 9000)
    assert notice == "The margin is valid for the model's period of 0.05 s; 9000 steps of other lengths were not used."
    both = log_of(np.concatenate([np.full(120, 0.05), np.full(3000, 0.01)]))
    assert reported(both)[0].calibration.transitions == pytest.approx(120, abs=1)


@pytest.mark.parametrize("together", [False, True])
def test_of_several_rates_without_the_models_own_none_is_chosen(together: bool) -> None:
    """In two recordings or in one: no one says at which of them the robot will drive."""
    parts = [np.full(900, 0.01), np.full(200, 1.0 / 7.0)]
    runs = [log_of(np.concatenate(parts))] if together else [log_of(part) for part in parts]
    notice = refused(*runs)
    assert notice == (
        "margin: got steps of 0.01 to 0.143 s, none of the model's own 0.05 s, wanted recordings of one rate or 99 "
        "steps of the model's own; use recordings of one rate, or record at the model's"
    )
    few = refused(*runs, log_of(np.full(98, 0.05)))
    assert "98 of the model's own 0.05 s" in few


def test_the_rate_of_a_log_is_that_of_most_of_its_time_not_of_a_moment_or_of_rows() -> None:
    found, notice = reported(log_of(np.concatenate([np.full(1000, 0.01), np.full(20, 0.04)])))
    assert (found.calibration.transitions, found.others) == (1000, 20)
    assert "20 steps of other lengths were not used" in notice
    # Of quick steps there are many in a moment, of slow ones few in most of a drive.
    slow, moment = log_of(np.full(300, 1.0 / 7.0)), log_of(np.full(400, 0.01))
    assert reported(slow, moment)[0].period == pytest.approx(1.0 / 7.0)
    assert "got steps of 0.01 to 0.143 s" in refused(log_of(np.full(3000, 0.01)), slow)
    assert "no transition of 0.015 s, wanted runs with steps of that length" in refused(
        log_of(np.tile([0.01, 0.02], 150))
    )


@pytest.mark.parametrize(("rows", "period"), [(60, 0.01), (98, 0.1), (98, 0.05)])
def test_a_log_that_is_too_short_is_refused(rows: int, period: float) -> None:
    assert f"transitions: got {rows}, wanted at least 99 for a coverage of 0.99" in refused(
        log_of(np.full(rows, period))
    )


def test_a_log_without_a_step_is_refused_and_stretches_of_two_rows_have_one() -> None:
    alone = log_of(np.full(10, 0.05), gaps=1)
    for runs in ((), (alone,), (replace(alone, stretches=()),)):
        assert refused(*runs).startswith("margin: no steps, wanted recordings with at least 99 of one length")
    # Of a log that loses every third row.
    found = log_margin(CAR, SETTINGS, [log_of([0.1] * 399, gaps=2)], 0.99, "2026-11-28")
    assert (found.period, found.calibration.transitions) == (pytest.approx(0.1), 200)


def test_networks_predict_no_other_steps_than_those_that_they_were_trained_on() -> None:
    learned = load_model("car_learned")
    notice = refused(log_of(np.full(300, 0.01)), model=learned)
    assert notice == (
        "margin: got steps of 0.01 s, wanted 0.05 s, for which the model's networks were trained; record at that rate"
    )
    assert reported(log_of(np.full(300, 0.05)), model=learned)[0].period == 0.05


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
    found, _ = reported(log_of(np.full(300, 0.02)), model=free)
    assert found.calibration.fingerprint == fingerprint(free)
    assert MarginCalibration.parse(found.calibration.write()) == found.calibration


def test_margins_over_four_drives_are_the_stated_order_statistics() -> None:
    drives = [np.array([0.1, 0.5]), np.array([0.2, 0.2]), np.array([0.3]), np.array([0.0, 0.4])]
    step, drive = margins_over_drives(drives, 0.6)
    assert drive == 0.4  # the third of four largest errors: 5 x 0.6
    assert step == 0.3  # shares reach 3 = 5 x 0.6 with 0, 0.1, 0.2, 0.2 (a half each) and 0.3 (a whole one)
    assert margins_over_drives(drives, 0.81) == (math.inf, math.inf)
    assert margins_over_drives([], 0.5) == (math.inf, math.inf)
    assert margins_over_drives([[1.0]], 0.5) == (1.0, 1.0)
    assert margins_over_drives([[1.0, 3.0, 2.0]], 0.5) == (3.0, 3.0)
    assert margins_over_drives([[1.0, 3.0, 2.0]], 0.51) == (math.inf, math.inf)


@pytest.mark.parametrize("bad", [[[]], [[math.nan]], [[[1.0]]], [[math.inf]], [[1.0], [1.0, math.nan]]])
def test_refuses_drives_without_errors_or_with_none_that_are_numbers(bad: list[list[float]]) -> None:
    with pytest.raises(InputError, match="errors of a drive"):
        margins_over_drives(bad, 0.5)


def drawn(random: np.random.Generator, count: int) -> list[np.ndarray]:
    """Drives of which each has its own size of errors, as a load has, and its own length."""
    sizes = np.exp(random.normal(0.0, 1.0, count))
    return [size * np.abs(random.normal(0.0, 0.1, random.integers(5, 30))) for size in sizes]


def test_fresh_drives_are_covered_as_often_as_stated_where_steps_taken_for_exchangeable_are_not() -> None:
    random, trials, coverage, drives = np.random.default_rng(0), 1500, 0.9, 20
    whole = step = pooled = 0
    for _ in range(trials):
        made, fresh = drawn(random, drives), drawn(random, 1)[0]
        for_step, for_drive = margins_over_drives(made, coverage)
        whole += bool(fresh.max() <= for_drive)
        step += bool(fresh[random.integers(len(fresh))] <= for_step)
        pooled += bool(fresh.max() <= split_conformal_margin(np.concatenate(made), coverage))
    low = binom.ppf(0.001, trials, coverage)
    assert whole >= low
    assert step >= low
    assert pooled < 0.8 * low, "a margin that covers steps says nothing about drives"
    assert whole <= binom.ppf(0.999, trials, math.ceil((drives + 1) * coverage) / (drives + 1)), (
        "and no more than needed"
    )


def heights(errors: object) -> np.ndarray:
    """Predicted and measured h with these errors, near the boundary."""
    wanted = np.asarray(errors, dtype=np.float64)
    return np.array([HSample(error, 0.0) for error in wanted])


def test_a_calibration_says_both_and_the_settings_choose() -> None:
    drives = [{"a": heights([0.01 * k, 0.0]), "b": np.zeros((0, 4))} for k in range(100)]
    made = calibration_from_drives(drives, 0.99, "2026-11-22", "x", origin="a command")
    assert (made.drives, made.transitions, made.origin) == (100, 200, "a command")
    assert made.epsilon == {"a": pytest.approx(0.99), "b": 0.0}
    assert made.drive == {"a": pytest.approx(0.99), "b": 0.0}
    assert MarginCalibration.parse(made.write()) == made
    smaller = calibration_from_drives(drives, 0.9, "2026-11-22", "x")
    assert smaller.epsilon["a"] == pytest.approx(0.81), "half of the steps are errors of 0"
    assert smaller.drive["a"] == pytest.approx(0.9)
    assert smaller.select("drive").epsilon == smaller.drive
    assert smaller.select(parse_settings('system = "car"\nmargin = "drive"').margin).epsilon == smaller.drive
    with pytest.raises(InputError, match="margin 'drive': the calibration has it for no kind, wanted a, b"):
        dataclasses.replace(smaller, drive={}).select("drive")
    with pytest.raises(InputError, match=r"drives: got 98, wanted at least 99 for a coverage of 0\.99"):
        calibration_from_drives(drives[:98], 0.99, "2026-11-22", "x")


def test_a_clip_level_is_raised_until_it_is_above_the_boundary_layer_of_the_margin() -> None:
    """At h of 5 no one is near; an error that leads from there to 1 is one of a robot whose margin needs that room."""
    drives = [{"a": np.array([HSample(5.0, 5.0 - 0.04 * k), HSample(0.3, 0.3)])} for k in range(100)]
    far = calibration_from_drives(drives, 0.9, "2026-11-22", "x", ErrorClip(0.1, {"a": 0.5}))
    assert far.drive == far.epsilon == {"a": 0.0}, "an error of 4 m that ends at 1 m is none"
    assert far.constants == {"clip.a": 0.5, "drive.clip.a": 0.5}
    no_one = [{"a": np.array([HSample(0.9, 0.9 - 0.0001 * k)])} for k in range(100)]
    seen = calibration_from_drives(no_one, 0.9, "2026-11-22", "x", ErrorClip(0.1, {"a": 0.5}))
    assert seen.constants["clip.a"] == 1.0, "where no one came near, farther steps have to say something"
    assert seen.drive["a"] == pytest.approx(0.009)
    with pytest.raises(InputError, match="transitions: got 0"):
        calibration_from_drives([{"a": np.zeros((0, 4))}] * 100, 0.9, "", "x")
    low = [{"a": np.array([HSample(5.0, 1.0 - 0.01 * k)])} for k in range(100)]
    found = calibration_from_drives(low, 0.9, "2026-11-22", "x", ErrorClip(0.1, {"a": 0.5}))
    assert found.drive["a"] == pytest.approx(4.9), "0.4 is too much for a ceiling of 0.5, and so on up to all of it"
    assert found.constants["drive.clip.a"] == 64.0


def test_ten_drives_near_are_enough_and_fewer_are_not() -> None:
    """A drive in which nothing of the kind was there is none that came near, and none with an error."""
    near, far, low = HSample(0.3, 0.29), HSample(0.9, 0.88), ErrorClip(0.1, {"a": 0.5})
    for count, top, drive in ((10, 0.5, 0.01), (9, 1.0, 0.02)):
        drives = [{"a": np.array([near, far])}] * count + [{"a": np.array([far])}] + [{}] * (98 - count)
        made = calibration_from_drives(drives, 0.99, "", "x", low)
        assert made.constants["clip.a"] == top
        assert made.drive["a"] == pytest.approx(drive)
        assert made.transitions == 2 * count + 1, "a drive without anything has no step"
    never = calibration_from_drives([{"a": np.array([HSample(1e13, 1e13)])}] * 99, 0.99, "", "x", low)
    assert never.constants["clip.a"] == 0.5 * 2.0**40
    assert never.drive == {"a": 0.0}


def test_what_a_margin_covers_is_counted_where_something_came_near() -> None:
    low = ErrorClip(0.1, {"a": 0.5})
    drives = [
        {"a": heights([0.1, 0.2, 0.3, 0.4])},
        {"a": np.array([HSample(0.9, 0.6)])},
        {},
        {"a": np.array([HSample(0.9, 0.6), HSample(0.45, 0.2)])},
    ]
    assert covered_shares(drives, "a", 0.0, low).tolist() == [0.0, 1.0, 1.0, 0.0]
    assert covered_shares([{"a": np.array([HSample(0.25, 0.0), HSample(0.26, 0.0)])}], "a", 0.25).tolist() == [0.5], (
        "an error of just the margin is covered"
    )
    assert covered_shares(drives, "a", 0.25, low).tolist() == [0.5, 0.0, 1.0, 0.5], "a wide margin sees farther"


EPSILON = {"obstacle": 0.1, "default": 0.02}


def test_margins_follow_the_request_and_the_barriers() -> None:
    margins = ActiveMargins(EPSILON)
    one, other = (
        make_barrier_set(car_barriers(FilterSettings.for_robot("car"), (0.1, 0.4, 0.1), [(1.0, 1.0, 0.2)] * n))
        for n in (1, 2)
    )
    asked: dict[str, float] = {}
    for _ in range(2):
        assert margins.resolve(one, asked) == ([0.1, 0.02, 0.02], 0.1)
    asked["speed"] = 0.3
    for _ in range(2):
        assert margins.resolve(one, asked) == ([0.1, 0.3, 0.3], 0.3)
    assert margins.resolve(one, dict(asked)) is margins.resolve(one, asked)  # kept
    assert margins.resolve(other, asked) == ([0.1, 0.1, 0.3, 0.3], 0.3)
    assert margins.resolve(one, {}) == ([0.1, 0.02, 0.02], 0.1)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -0.1])
def test_a_bad_margin_is_refused_every_time_and_forgotten(bad: float) -> None:
    margins = ActiveMargins(EPSILON)
    stack = make_barrier_set(car_barriers(FilterSettings.for_robot("car"), (0.1, 0.4, 0.1), [(1.0, 1.0, 0.2)]))
    asked = {"speed": bad}
    for _ in range(2):
        with pytest.raises(DecisionError, match="not a finite number >= 0"):
            margins.resolve(stack, asked)
    assert margins.resolve(stack, {}) == ([0.1, 0.02, 0.02], 0.1)


@pytest.mark.parametrize(("name", "affine"), [("car_learned", True), ("car", False)])
def test_only_networks_have_the_same_slopes_about_every_action(name: str, affine: bool) -> None:
    model = load_model(name)
    prediction, latent = Prediction.of_model(model), tuple(model.latent.tolist())
    assert prediction.affine is affine
    state, random = (0.3, -0.2, 0.7, 0.9), np.random.default_rng(0)
    actions = random.uniform((-0.6, -0.34), (2.0, 0.34), (300, 2)).tolist()  # enough for the straight road
    for action in actions:
        prediction.next_state_floats(state, action, latent, None)
    slopes = [prediction.control_matrix_floats(state, action, latent, None) for action in actions]
    assert all(slope == slopes[0] for slope in slopes) is affine
    at = np.array(prediction.next_state_floats(state, actions[0], latent, None))
    there = np.array(prediction.next_state_floats(state, actions[1], latent, None))
    predicted = at + np.array(slopes[0]) @ (np.array(actions[1]) - np.array(actions[0]))
    assert np.allclose(there, predicted, rtol=0.0, atol=1e-12) is affine


def test_what_was_ever_in_sight_may_be_named_though_nothing_was_asked_when_it_came() -> None:
    margins, bare = ActiveMargins(EPSILON), make_barrier_set([SpeedBarrier(-1.0, 1.0)])
    strange = SpeedBarrier(-1.0, 1.0)
    strange.kind = "wheel"
    with pytest.raises(DecisionError, match="'wheel', a kind without barriers"):
        margins.resolve(bare, {"wheel": 0.3})
    assert margins.resolve(bare, {}) == ([0.02, 0.02], 0.02)
    assert margins.resolve(make_barrier_set([strange]), {}) == ([0.02, 0.02], 0.02)
    assert margins.resolve(bare, {"wheel": 0.3}) == ([0.02, 0.02], 0.02)
    assert margins.resolve(make_barrier_set([strange]), {"wheel": 0.3}) == ([0.3, 0.3], 0.3)
