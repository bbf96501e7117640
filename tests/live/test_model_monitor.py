"""The watch over a model: silent while the model is right, quick and precise when it is not."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.dynamics import load_model
from safedpa.live.model_monitor import BEYOND, EDetector, ModelMonitor

pytestmark = pytest.mark.slow

CHANGE = 800
"""Tick; 40 s."""
FAULTS = {
    "towed_load": {"mass_ratio": 0.6, "deceleration": 1.5},
    "constant_force": {"ax": 0.8, "ay": 0.3},
    "steering_offset": {"angle": 0.08},
}
CAR = load_model("car")


def watched(car, rows):
    watch = ModelMonitor(car)
    for row in rows:
        watch.observe(*row, None)
        yield row[0], watch


@pytest.mark.long
def test_ten_minutes_of_a_right_model_raise_nothing(car, drive_of):
    largest = max(watch.evidence.value for _, watch in watched(car, drive_of(12_000)))
    assert largest < 0.5 * ModelMonitor(car).evidence.threshold


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_raised_within_ten_seconds_and_dated_to_the_second(car, drive_of, name):
    rows = drive_of(CHANGE + 300, CHANGE, name, **FAULTS[name])
    tick, watch = next((tick, watch) for tick, watch in watched(car, rows) if watch.evidence.raised)
    assert CHANGE < tick <= CHANGE + 200
    assert CHANGE - 30 <= watch.changed_at() <= CHANGE + 10
    assert watch.error > watch.band.error


def test_a_stationary_robot_teaches_no_band_and_raises_nothing(car):
    random = np.random.default_rng(0)
    rows = [(tick, random.normal(0.0, 1e-3, 4), np.zeros(2)) for tick in range(2000)]
    *_, (_, watch) = watched(car, rows)
    assert watch.band is None
    assert watch.evidence.value == 0.0


def test_a_new_watch_reports_errors_on_the_scale_of_the_one_before(car, drive_of):
    *_, (_, old) = watched(car, drive_of(900))
    new = ModelMonitor(car, scale=old.scale)
    for row in drive_of(900):
        new.observe(*row, None)
    assert new.error == old.error
    assert (new.band.scale == old.scale).all()


def slide(watch, speeds):
    """A car that its own model holds to be stationary is pushed along x, at these speeds [m/s] of each tick."""
    x = np.concatenate([[0.0], np.cumsum(np.array(speeds) * 0.05)])
    for tick, position in enumerate(x):
        watch.observe(tick, np.array([position, 0.0, 0.0, 0.0]), np.zeros(2), None)
    return watch


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_error_is_that_of_the_last_five_seconds(sign):
    """On a scale of 0.5 m and 2 m/s: 0.1 m in a second and no error of the speed are a mean of 0.1."""
    scale = np.array([0.5, 0.0, 0.0, 2.0])
    assert ModelMonitor(CAR, scale=scale).error == 0.0
    fast = [0.7] * 300
    assert slide(ModelMonitor(CAR, scale=scale), fast).error == pytest.approx(0.7)
    assert slide(ModelMonitor(CAR, scale=scale), fast + [0.1 * sign] * 140).error == pytest.approx(0.1)
    assert slide(ModelMonitor(CAR, scale=scale), fast + [0.1 * sign] * 90).error > 0.15


def test_the_band_is_learned_from_twenty_seconds_of_driving():
    assert ModelMonitor(CAR).seconds_to_learn == 20.0
    half, whole = slide(ModelMonitor(CAR), [0.5] * 230), slide(ModelMonitor(CAR), [0.5] * 450)
    assert (half.band, half.seconds_to_learn) == (None, pytest.approx(10.0, abs=1.0))
    assert half.learned_share == pytest.approx(0.5, abs=0.05)
    assert (whole.seconds_to_learn, whole.learned_share) == (0.0, 1.0)
    assert whole.band is not None


def test_the_first_two_forecasts_do_not_count():
    """Actuators may remember commands from before the first tick."""
    assert slide(ModelMonitor(CAR), [0.5] * 31).learned_share == 0.0
    assert slide(ModelMonitor(CAR), [0.5] * 41).learned_share == pytest.approx(1.0 / 40.0)


def test_the_evidence_counts_one_forecast_a_second():
    """Forecasts overlap; the sequential test is allowed to count only those that do not."""
    usual, strange = [0.5] * 450, [5.0] * 60
    watch, at_most = slide(ModelMonitor(CAR), usual + strange), EDetector()
    for second in range(4):  # three seconds, and one that began before
        at_most.add(BEYOND + 1.0, 20 * second)
    assert 0.0 < watch.evidence.value <= at_most.value


def facts(h_now: float, h_next: float = 0.5, margin: float = 0.125) -> Any:
    return SimpleNamespace(h_now=h_now, h_next=h_next, margin=margin)


@pytest.mark.parametrize(
    ("h_after", "covered"), [(0.5, True), (0.375, True), (0.37, False), (0.625, True), (-0.5, False), (2.0, True)]
)
def test_a_step_is_covered_where_h_fell_by_no_more_than_the_margin(h_after, covered):
    """The filter predicted 0.5 with a margin of 0.125."""
    watch = ModelMonitor(CAR)
    watch.judge_margin(7, facts(9.0))
    watch.judge_margin(8, facts(h_after))
    assert watch.coverage == float(covered)


@pytest.mark.parametrize(("tick", "counted"), [(8, True), (7, False), (9, False), (6, False), (-6, False), (0, False)])
def test_a_prediction_is_compared_with_the_next_tick_only(tick, counted):
    watch = ModelMonitor(CAR)
    watch.judge_margin(7, facts(9.0))
    watch.judge_margin(tick, facts(0.0))
    assert watch.coverage == (0.0 if counted else 1.0)


def test_coverage_is_the_share_of_the_steps_that_can_be_judged():
    """One of ten ticks has no verdict and one executed another action: of the other six two are not covered."""
    watch = ModelMonitor(CAR)
    heights = [9.0, 0.5, 0.0, 0.4, None, 0.0, 0.5, 0.0, 0.1, 0.5]
    for tick, height in enumerate(heights):
        watch.judge_margin(tick, None if height is None else facts(height), obeyed=tick != 7)
    assert watch.coverage == pytest.approx(4.0 / 6.0)


def test_coverage_forgets_steps_after_twenty_seconds():
    watch = ModelMonitor(CAR, period=0.05)
    for tick in range(100):
        watch.judge_margin(tick, facts(0.0))
    for tick in range(100, 499):
        watch.judge_margin(tick, facts(0.5))
    assert watch.coverage == pytest.approx(399 / 400)
    watch.judge_margin(499, facts(0.5))
    assert watch.coverage == 1.0
