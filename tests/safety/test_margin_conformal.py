"""Coverage of the margins on data that they have not seen."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import binom

from safedpa.dynamics import PhysicsModel, Setting, fingerprint
from safedpa.errors import InputError
from safedpa.robots.car.barriers.obstacles import car_barriers
from safedpa.safety import (
    FilterSettings,
    FunctionBarrier,
    MarginCalibration,
    OnlineMargin,
    Prediction,
    calibrate_margin,
    one_step_errors,
    smallest_sample,
    split_conformal_margin,
)
from safedpa.safety.margins.calibration import calibration_from_errors
from safedpa.safety.margins.conformal import margins_over_drives

FOOTPRINT = (0.08, 0.40, 0.12)


def test_the_quantile_is_the_stated_order_statistic() -> None:
    errors = np.arange(1.0, 100.0)[::-1]  # 1 .. 99
    assert split_conformal_margin(errors, 0.9) == 90.0
    assert split_conformal_margin(errors, 0.5) == 50.0
    assert split_conformal_margin(errors, 0.99) == 99.0
    assert split_conformal_margin(errors, 0.985) == 99.0
    assert split_conformal_margin(errors, 0.9901) == math.inf
    assert split_conformal_margin([], 0.5) == math.inf
    assert split_conformal_margin([-3.0], 0.5) == -3.0


@pytest.mark.parametrize(
    ("coverage", "least"),
    [(0.01, 1), (0.5, 1), (0.51, 2), (0.75, 3), (0.8, 4), (0.9, 9), (0.95, 19), (0.99, 99), (0.999, 999)],
)
def test_smallest_sample_is_the_first_with_a_finite_margin(coverage: float, least: int) -> None:
    """coverage / (1 - coverage), rounded up."""
    assert smallest_sample(coverage) == least
    assert math.isfinite(split_conformal_margin(np.zeros(least), coverage))
    assert split_conformal_margin(np.zeros(least - 1), coverage) == math.inf


@pytest.mark.parametrize("bad", [0.0, 1.0, -0.5, 1.1, math.nan, math.inf])
def test_refuses_what_is_no_coverage(bad: float) -> None:
    for call in (
        lambda: split_conformal_margin([1.0], bad),
        lambda: smallest_sample(bad),
        lambda: OnlineMargin(0.1, bad),
        lambda: margins_over_drives([[1.0]], bad),
    ):
        with pytest.raises(InputError, match="coverage: got"):
            call()


def test_refuses_errors_that_are_no_numbers() -> None:
    for errors in ([1.0, math.nan], [[1.0]], [math.inf]):
        with pytest.raises(InputError, match="errors: got"):
            split_conformal_margin(errors, 0.5)


@pytest.mark.parametrize("coverage", [0.8, 0.95])
def test_coverage_on_fresh_data_lies_in_its_binomial_interval(coverage: float) -> None:
    """Over many calibrations one fresh error each: covered with probability ceil((n+1) c)/(n+1), independently."""
    random, trials, n = np.random.default_rng(0), 4000, 60
    draws = random.standard_t(3, (trials, n + 1)) ** 3  # heavy tails, skewed
    covered = sum(row[n] <= split_conformal_margin(row[:n], coverage) for row in draws)
    exact = math.ceil((n + 1) * coverage) / (n + 1)
    low, high = binom.interval(0.999, trials, exact)
    assert low <= covered <= high
    assert exact >= coverage


def transitions(model: PhysicsModel, count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    x = random.uniform((-3, -3, -3, -0.5), (3, 3, 3, 2), (count, 4))
    a = random.uniform((-0.6, -0.34), (2.0, 0.34), (count, 2))
    return x, a, model.step(x, a) + random.normal(0.0, 0.004, (count, 4))


def test_calibration_covers_a_world_that_differs_from_the_model(car: PhysicsModel, tmp_path: Path) -> None:
    world = car.with_settings({"base.speed_gain": Setting(3.2)})
    settings = FilterSettings.for_robot("car")
    barriers = car_barriers(settings, FOOTPRINT, [(1.0, 0.5, 0.3), (-2.0, 0.0, 0.2)], (-4, 4, -4, 4))
    found = calibrate_margin(car, barriers, *transitions(world, 800, 1), coverage=0.9, date="2026-11-21")
    assert set(found.epsilon) == {"obstacle", "field", "speed"}
    assert (found.transitions, found.coverage, found.fingerprint) == (800, 0.9, fingerprint(car))
    fresh = one_step_errors(car, barriers, *transitions(world, 800, 2))
    for kind, errors in fresh.items():
        covered = int((errors <= found.epsilon[kind]).sum())
        assert covered >= binom.ppf(0.001, 800, 0.87)  # both samples vary
        assert covered <= binom.ppf(0.999, 800, 0.93)
        assert found.epsilon[kind] > 0.0
    found.save(tmp_path / "margin.toml")
    assert MarginCalibration.load(tmp_path / "margin.toml") == found
    assert FilterSettings.for_robot("car", epsilon=found.epsilon).epsilon == found.epsilon


def test_a_fingerprint_that_is_given_is_kept_whatever_predicted(car: PhysicsModel) -> None:
    """What the filter has in force is looked up by it: a model that was changed on the way must not give its own."""
    one = np.zeros((1, 4)), np.zeros((1, 2)), np.zeros((1, 4))
    barriers = [FunctionBarrier(lambda x: x[0])]
    for model, given, kept in (
        (car, "0123456789ab", "0123456789ab"),
        (car, "", fingerprint(car)),
        (Prediction.of_model(car), "0123456789ab", "0123456789ab"),
        (Prediction.of_model(car), "", ""),
    ):
        found = calibrate_margin(model, barriers, *one, coverage=0.5, date="", model_fingerprint=given)
        assert found.fingerprint == kept


def test_errors_are_predicted_minus_measured_and_the_worst_of_the_kind() -> None:
    prediction = Prediction(lambda x: (x, np.eye(1)))
    parts = [FunctionBarrier(lambda x: [x[0], -x[0]], names=("a", "b"), kind="two"), FunctionBarrier(lambda x: x[0])]
    errors = one_step_errors(prediction, parts, [[0.0], [0.0]], [[1.0], [1.0]], [[0.7], [1.2]])
    np.testing.assert_allclose(errors["two"], [0.3, 0.2])
    np.testing.assert_allclose(errors["function"], [0.3, -0.2])
    two = calibrate_margin(prediction, parts, [[0.0]] * 2, [[1.0]] * 2, [[1.2], [1.2]], coverage=0.5, date="")
    assert two.epsilon == {"two": pytest.approx(0.2), "function": 0.0}  # never negative


def test_scene_and_latent_of_each_transition() -> None:
    prediction = Prediction(lambda x, z: (x + z, np.eye(1)))
    scenes = [[FunctionBarrier(lambda x: x[0], kind="first")], [FunctionBarrier(lambda x: x[0], kind="second")]]
    errors = one_step_errors(
        prediction, lambda row: scenes[row], [[0.0]] * 2, [[0.0]] * 2, [[0.0]] * 2, [[0.5], [0.25]]
    )
    np.testing.assert_allclose(errors["first"], [0.5, 0.0])
    np.testing.assert_allclose(errors["second"], [0.0, 0.25])


@pytest.mark.parametrize("number", [math.nan, math.inf])
def test_a_prediction_without_numbers_is_no_error_of_zero(number: float) -> None:
    prediction = Prediction(lambda x: (np.where(x > 0.5, number, x), np.zeros((1, 1))))
    with np.errstate(invalid="ignore"), pytest.raises(InputError, match="errors: got shape"):
        calibrate_margin(
            prediction,
            [FunctionBarrier(lambda x: [x[0], -x[0]], names=("a", "b"))],
            [[0.0], [1.0], [0.0]],
            [[0.0]] * 3,
            [[0.0], [1.0], [0.0]],
            coverage=0.5,
            date="",
        )


@pytest.mark.parametrize(
    ("changes", "phrase"),
    [
        ({"actions": [[1.0]]}, "transitions: got shapes"),
        ({"next_states": [[1.0, 1.0]] * 3}, "transitions: got shapes"),
        ({"states": [1.0, 1.0, 1.0]}, "transitions: got shapes"),
        ({"actions": [0.0] * 3}, "transitions: got shapes"),
        ({"latents": [0.0] * 3}, "latents: got shape"),
        ({"states": [0.0] * 3, "next_states": [0.0] * 3}, "transitions: got shapes"),
        ({"latents": [[1.0]]}, "latents: got shape"),
        ({"barriers": []}, "barriers: got none"),
        ({"coverage": 0.9}, "transitions: got 3, wanted at least 9"),
        ({"states": np.zeros((0, 1)), "actions": np.zeros((0, 1)), "next_states": np.zeros((0, 1))}, "got shapes"),
    ],
)
def test_calibration_says_what_is_missing(changes: dict[str, Any], phrase: str) -> None:
    good: dict[str, Any] = {
        "model": Prediction(lambda x: (x, np.eye(1))),
        "barriers": [FunctionBarrier(lambda x: x[0])],
        "states": [[0.0]] * 3,
        "actions": [[0.0]] * 3,
        "next_states": [[0.0]] * 3,
        "coverage": 0.5,
        "date": "2026-11-21",
    }
    assert calibrate_margin(**good).epsilon == {"function": 0.0}
    with pytest.raises(InputError, match=phrase):
        calibrate_margin(**{**good, **changes})


def test_as_few_transitions_as_say_something_are_enough_and_every_kind_needs_as_many() -> None:
    made = calibration_from_errors({"a": np.arange(9.0)}, 0.9, "", "x")
    assert (made.epsilon, made.transitions) == ({"a": 8.0}, 9)
    for errors, count in (({"a": np.zeros(8)}, 8), ({"a": np.zeros(9), "b": np.zeros(8)}, 8), ({}, 0)):
        with pytest.raises(InputError, match=f"transitions: got {count}, wanted at least 9"):
            calibration_from_errors(errors, 0.9, "", "x")
    with pytest.raises(InputError, match="transitions: got 0, wanted at least 1 "):
        calibration_from_errors({}, 0.5, "", "x")
    prediction = Prediction(lambda x: (x, np.eye(1)))
    barriers, one = [FunctionBarrier(lambda x: x[0])], ([[0.0]], [[0.5]], [[0.2]])
    own = calibrate_margin(prediction, barriers, *one, coverage=0.5, date="")
    assert own.transitions == 1
    assert own.epsilon == {"function": pytest.approx(0.3)}


GOOD_FILE = MarginCalibration({"obstacle": 0.02}, 0.95, 500, "2026-11-21", "abc").write()


@pytest.mark.parametrize(
    ("old", "new", "phrase"),
    [
        ("coverage = 0.95", "coverage = 1.0", "coverage: got 1"),
        ("coverage = 0.95", "coverage = 0.0", "coverage: got 0.0, wanted more than 0"),
        ("coverage = 0.95", "coverage = nan", "coverage: got nan, wanted a finite number"),
        ("coverage = 0.95", "coverage = true", "coverage: got True, wanted a finite number"),
        ("coverage = 0.95", "coverage = 'x'", "coverage: got 'x'"),
        ("coverage = 0.95", "", "coverage: missing"),
        ("coverage", "coverrage", "coverrage: unknown key; did you mean 'coverage'"),
        ("= 0.02", "= -0.02", r"epsilon\.obstacle: got -0\.02"),
        ("= 0.02", "= inf", r"epsilon\.obstacle: got inf, wanted a finite number"),
        ("= 0.02", "= true", r"epsilon\.obstacle: got True, wanted a finite number"),
        ("= 0.02", '= 0.02\n"speed" = nan', r"epsilon\.speed: got nan, wanted a finite number"),
        ("= 0.02", "= 0.02\n[drive]\nobstacle = -0.5", r"drive\.obstacle: got -0\.5, wanted a finite number >= 0"),
        ("= 0.02", "= 0.02\n[theorem]\nobstacle = nan", r"theorem\.obstacle: got nan"),
        ("= 0.02", "= 0.02\n[constants]\nL = -1.0", r"constants\.L: got -1\.0"),
        ("= 0.02", "= 0.02\n[covered]\na = inf", r"covered\.a: got inf"),
        ("format = 2", "format = 2\ndrives = inf", "drives: got inf"),
        ("format = 2", "format = 2\ndrives = -1", "drives: got -1"),
        ("format = 2", "format = 2\norigin = 3", "origin: got 3"),
        ("format = 2", "format = 2\ndrive = 3", "drive: got 3"),
        ("format = 2", "format = 2\ntheorem = [0.1]", "theorem: got .* wanted a table of numbers"),
        ('"obstacle" = 0.02', "", "epsilon: got {}"),
        ("transitions = 500", "transitions = 0", "transitions: got 0"),
        ('date = "2026-11-21"', "date = 3", "date: got 3"),
        ('fingerprint = "abc"', "", "fingerprint: missing; wanted the keys format, coverage, transitions, date,"),
        ("transitions = 500", "", "transitions: missing"),
        ("format = 2", "", "format: missing"),
        ("format = 2", "format = 7", "format: wanted 2"),
        ("format = 2", "format", "not TOML"),
    ],
)
def test_margin_files_are_checked(old: str, new: str, phrase: str, tmp_path: Path) -> None:
    path = tmp_path / "margin.toml"
    path.write_text(GOOD_FILE)
    assert MarginCalibration.load(path).epsilon == {"obstacle": 0.02}
    path.write_text(GOOD_FILE.replace(old, new))
    with pytest.raises(InputError, match=phrase):
        MarginCalibration.load(path)


@pytest.mark.parametrize(
    "changes",
    [
        {"epsilon": {"obstacle": 0}},
        {"coverage": 1e-9, "transitions": 1},
        {"coverage": math.nextafter(1.0, 0.0), "drives": 1, "origin": "a command"},
        {"drive": {"obstacle": 0.0}, "theorem": {"obstacle": 0.0}},
        {"constants": {"step": 1.5}, "covered": {"theorem.obstacle": 0.995}},
    ],
    ids=str,
)
def test_calibrations_at_the_ends_of_their_ranges_come_back_from_their_file(changes: dict[str, Any]) -> None:
    made = replace(MarginCalibration({"obstacle": 0.02}, 0.95, 500, "2026-11-21", "abc"), **changes)
    assert MarginCalibration.parse(made.write()) == made


@pytest.mark.parametrize("margin", ["drive", "theorem"])
def test_a_chosen_margin_has_a_number_for_each_kind_and_no_other(margin: str) -> None:
    epsilon = {"obstacle": 0.1, "speed": 0.2}
    made = MarginCalibration(epsilon, 0.95, 500, "", "abc", **{margin: {"speed": 0.4, "obstacle": 0.3}})
    assert made.select(margin).epsilon == {"obstacle": 0.3, "speed": 0.4}
    assert made.select("conformal").epsilon == epsilon
    assert made.select(0.7).epsilon == {"obstacle": 0.7, "speed": 0.7}
    for table in ({}, {"obstacle": 0.3}, {"obstacle": 0.3, "corridor": 0.4}, {**epsilon, "corridor": 0.1}):
        with pytest.raises(
            InputError, match=f"margin '{margin}': the calibration has it for .*, wanted obstacle, speed"
        ):
            replace(made, **{margin: table}).select(margin)


def run(online: OnlineMargin, errors: np.ndarray) -> np.ndarray:
    missed = []
    for error in errors:
        missed.append(error > online.value)
        online.update(error)
    return np.array(missed)


def test_online_margin_stays_calibrated_while_nothing_changes() -> None:
    random = np.random.default_rng(3)
    calibrated = split_conformal_margin(np.abs(random.normal(0, 0.01, 2000)), 0.9)
    missed = run(OnlineMargin(calibrated, 0.9), np.abs(random.normal(0, 0.01, 3000)))
    assert missed.mean() <= 0.11
    assert missed.mean() > 0.04


def test_online_margin_recovers_coverage_after_a_shift() -> None:
    """Errors five times as large: a fixed margin would miss two thirds of them."""
    random = np.random.default_rng(4)
    calibrated = split_conformal_margin(np.abs(random.normal(0, 0.01, 2000)), 0.9)
    shifted, online = np.abs(random.normal(0, 0.05, 2000)), OnlineMargin(calibrated, 0.9)
    assert (shifted > calibrated).mean() > 0.6
    missed = run(online, shifted)
    assert missed[200:].mean() == pytest.approx(0.1, abs=0.03)
    assert online.value > 3 * calibrated
    run(online, np.full(600, 0.001))
    assert online.value == calibrated  # and comes back


def test_the_online_margin_never_undercuts_the_calibrated_one_and_takes_the_ends_of_its_ranges() -> None:
    online = OnlineMargin(0.02, 0.9)
    for error in np.full(300, -1.0):
        assert online.update(error) == 0.02
    assert OnlineMargin(0.0, 0.9).value == 0.0
    hasty = OnlineMargin(0.1, 0.5, rate=1.0, window=1)
    assert [hasty.update(error) for error in (0.3, 0.2)] == [0.6, 0.2]  # alpha 0: twice; alpha 0.5: the one there is


def test_the_online_margin_follows_a_worked_example() -> None:
    online = OnlineMargin(0.1, 0.5, rate=0.5, window=3)
    assert online.update(0.3) == 0.3  # missed: alpha 0.25, rank 2 of 1: the largest
    assert online.update(0.4) == 0.8  # missed: alpha 0: twice the largest
    assert online.update(0.2) == 0.4  # covered: alpha 0.25, rank 3 of 3
    assert online.update(0.1) == 0.2  # covered: alpha 0.5, rank 2 of {0.4, 0.2, 0.1}
    assert online.update(math.nan) == 0.4  # counts as missed, is not kept: alpha 0.25
    assert OnlineMargin(0.1, 0.5).update(math.inf) == 0.1


def test_one_early_miss_does_not_widen_the_margin_but_many_do() -> None:
    online = OnlineMargin(0.02, 0.99, rate=0.002, window=500)
    assert online.update(0.3) == 0.02  # the sixth largest of 500 counts, and 499 are taken as within the calibrated one
    assert [online.update(0.3) for _ in range(3)] == [0.02, 0.3, 0.3]
    assert online.update(0.35) == 0.35  # the level is nearly used up: the largest
    assert online.update(0.36) == 0.36
    assert online.update(0.37) == 0.74  # and now it is: twice the largest


@pytest.mark.parametrize(
    "bad",
    [
        {"calibrated": -0.1}, {"calibrated": math.inf}, {"calibrated": math.nan}, {"rate": 0.0}, {"rate": 1.0001},
        {"rate": math.nan}, {"window": 0},
    ],
)  # fmt: skip
def test_online_margin_refuses(bad: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=r"calibrated margin: got|wanted 0 < rate <= 1 and window >= 1"):
        OnlineMargin(**{"calibrated": 0.1, "coverage": 0.9, **bad})


def test_coverage_is_the_share_of_the_last_window() -> None:
    online = OnlineMargin(0.5, 0.9, rate=1e-6, window=4)
    assert online.coverage is None
    reported = []
    for error in (0.9, 0.1, 0.1, 0.1, 0.1, 0.1, 2.0, 3.0):
        online.update(error)
        reported.append(online.coverage)
    assert reported == [0.0, 0.5, pytest.approx(2 / 3), 0.75, 1.0, 1.0, 0.75, 0.5]


def test_two_hundred_errors_are_kept_by_default() -> None:
    online = OnlineMargin(0.1, 0.9)
    online.update(5.0)
    for _ in range(199):
        online.update(0.0)
    assert online.coverage == 1.0 - 1 / 200
    online.update(0.0)
    assert online.coverage == 1.0


def misses_of(online: OnlineMargin, errors: np.ndarray) -> int:
    return int(run(online, errors).sum())


@pytest.mark.parametrize("growth", [1.5, 2.0, 3.0, 7.9])
def test_errors_that_grow_without_end_are_missed_as_seldom_as_stated(growth: float) -> None:
    """Twice the largest error of the window, and no more, misses errors that treble in every single step."""
    alpha, rate, doublings = 0.01, 0.002, math.ceil(math.log2(growth))
    errors = 0.011 * growth ** np.arange(13)
    online = OnlineMargin(0.01, 1.0 - alpha, rate, 500)
    run(online, np.full(4000, 0.005))  # a calm hour is no credit
    assert misses_of(online, errors) < alpha * len(errors) + alpha / rate + max(doublings, 1)


@pytest.mark.parametrize("seed", range(20))
def test_in_no_stretch_are_more_errors_missed_than_stated(seed: int) -> None:
    """Calm, bursts and errors that grow by up to a factor of four over the largest of the window, in any order."""
    random, alpha, rate, window, doublings = np.random.default_rng(seed), 0.05, 0.01, 40, 2
    online, missed, kept = OnlineMargin(0.01, 1.0 - alpha, rate, window), [], [0.0]
    for _ in range(1500):
        largest = max(0.01, *kept[-window:])
        beyond = min(1.001 * online.value, 4.0 * largest)  # the margin, as far as the statement allows
        error = beyond if random.uniform() < 0.3 else random.uniform(0.0, 0.02)
        missed.append(error > online.value)
        online.update(error)
        kept.append(error)
        if largest > 1e9:
            break
    total = np.concatenate([[0], np.cumsum(missed)])
    assert sum(missed) > doublings
    for length in (1, 10, len(missed) // 4, len(missed)):
        worst = (total[length:] - total[:-length]).max()
        assert worst < alpha * length + alpha / rate + doublings


def test_the_margin_falls_back_to_its_quantile_once_misses_are_allowed_again() -> None:
    online = OnlineMargin(0.01, 0.5, rate=0.5, window=4)
    assert [online.update(error) for error in (0.02, 0.1, 0.3)] == [pytest.approx(0.02), 0.2, 1.2]
    assert online.update(0.01) == pytest.approx(1.2)  # alpha is 0 still
    assert online.update(0.01) == 0.3
    assert online.update(0.31) == pytest.approx(0.62)  # twice the largest again, not four times


def test_a_margin_of_messages_stays_a_number_that_they_carry() -> None:
    online = OnlineMargin(1.0, 0.5, rate=1.0, window=2)
    for power in range(80):
        online.update(10.0**power)
    assert online.value == 1e12


class Recording:
    """A recording of two stretches, with one step of another length."""

    def parts(self) -> Any:
        rows = np.array([[0.0], [1.0], [2.0], [3.0]])
        yield np.array([0.0, 0.05, 0.10, 0.30]), rows, np.ones((4, 1))
        yield np.array([9.0, 9.05]), 10.0 + rows[:2], np.ones((2, 1))


def test_recorded_drives_and_pairs_give_the_margin_of_their_transitions() -> None:
    """x+ is predicted as x + 1.25, and measured as x + 1: h = -x errs by -0.25, h = x by 0.25."""
    prediction, barrier = Prediction(lambda x: (x + 0.25, np.eye(1))), FunctionBarrier(lambda x: x[0], kind="wall")
    pair = np.arange(4.0)[:, None], np.ones((4, 1))
    for drives in ([Recording()], [pair], [Recording(), Recording()]):
        found = calibrate_margin(prediction, [barrier], drives, coverage=0.5, date="2026-11-29")
        assert found.epsilon == pytest.approx({"wall": 0.25})
    assert calibrate_margin(prediction, [barrier], [Recording()], coverage=0.5, date="").transitions == 3


@pytest.mark.parametrize("drives", [[], [(np.zeros((1, 1)), np.zeros((1, 1)))], [(np.zeros((3, 1)), np.zeros((2, 1)))]])
def test_drives_without_a_step_or_with_unequal_tables_are_refused(drives: Any) -> None:
    with pytest.raises(InputError, match="drives: got"):
        calibrate_margin(Prediction(lambda x: (x, np.eye(1))), [], drives, coverage=0.5, date="")
