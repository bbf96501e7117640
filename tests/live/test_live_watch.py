"""The watch over a model: silent while the model is right, and quick, precise and in plain words when it is not."""

from __future__ import annotations

import numpy as np
import pytest

from safedpa.live.forecasts import Forecast
from safedpa.live.watch import VerdictFacts, Watch, learned_band, place_in_words

pytestmark = pytest.mark.slow

CHANGE = 800
"""Tick; 40 s."""
FAULTS = {
    "towed_load": {"mass_ratio": 0.6, "deceleration": 1.5},
    "constant_force": {"ax": 0.8, "ay": 0.3},
    "steering_offset": {"angle": 0.08},
}


def watched(car, rows):
    watch = Watch(car)
    for row in rows:
        watch.observe(*row, None)
        yield row[0], watch


@pytest.mark.long
def test_ten_minutes_of_a_right_model_raise_nothing(car, drive_of):
    largest = max(watch.evidence.value for _, watch in watched(car, drive_of(12_000)))
    assert largest < 0.5 * Watch(car).evidence.threshold


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_raised_within_ten_seconds_and_dated_to_the_second(car, drive_of, name):
    rows = drive_of(CHANGE + 300, CHANGE, name, **FAULTS[name])
    tick, watch = next((tick, watch) for tick, watch in watched(car, rows) if watch.evidence.raised)
    assert CHANGE < tick <= CHANGE + 200
    assert CHANGE - 30 <= watch.changed_at() <= CHANGE + 10
    assert watch.error > watch.band.error


def test_a_robot_that_stands_still_teaches_no_band_and_raises_nothing(car):
    random = np.random.default_rng(0)
    rows = [(tick, random.normal(0.0, 1e-3, 4), np.zeros(2)) for tick in range(2000)]
    *_, (_, watch) = watched(car, rows)
    assert watch.band is None
    assert watch.evidence.value == 0.0


def test_a_new_watch_tells_errors_on_the_scale_of_the_one_before(car, drive_of):
    *_, (_, old) = watched(car, drive_of(900))
    new = Watch(car, scale=old.scale)
    for row in drive_of(900):
        new.observe(*row, None)
    assert new.error == old.error
    assert (new.band.scale == old.scale).all()


def test_coverage_is_the_share_of_steps_within_the_margin(car):
    watch = Watch(car)
    for tick in range(101):
        h = 1.0 if tick % 10 else 0.97
        watch.judge_margin(tick, VerdictFacts(h_now=h, h_next=1.0, margin=0.02))
    assert watch.coverage == pytest.approx(0.9)


def test_coverage_leaves_out_what_was_not_done_and_what_was_not_foreseen(car):
    watch = Watch(car)
    watch.judge_margin(0, VerdictFacts(1.0, 1.0, 0.01))
    watch.judge_margin(1, VerdictFacts(0.0, 1.0, 0.01), obeyed=False)
    watch.judge_margin(2, None)
    watch.judge_margin(3, VerdictFacts(0.0, 1.0, 0.01))
    watch.judge_margin(5, VerdictFacts(0.0, 1.0, 0.01))
    assert watch.coverage == 1.0


def made(error, yaw=0.0, speed=1.0, steer=0.0):
    began, measured = np.array([0.0, 0.0, yaw, speed]), np.array([1.0, 0.0, yaw, speed])
    return Forecast(0, 20, began, measured, measured - np.array(error), np.array([speed, steer]), np.ones(2))


@pytest.fixture(scope="module")
def quiet_band(car):
    random = np.random.default_rng(1)
    return learned_band(
        car.system,
        [made(random.normal(0.0, 1e-3, 4), yaw, 1.0 + 0.5 * np.sin(yaw)) for yaw in np.linspace(0.0, 6.0, 40)],
    )


def test_words_say_which_way_and_how_much(car, quiet_band):
    words = place_in_words(car.system, quiet_band, [made((0.0, 0.0, 0.0, -0.2))] * 6, 1.0)
    assert words == "speed: 0.2 m/s less than predicted after 1 s"
    assert place_in_words(car.system, quiet_band, [made((0.0, 0.0, 0.0, -0.2))] * 3, 1.0) == ""


def test_words_name_the_side_of_a_variable_that_matters(car, quiet_band):
    fast = [made((0.0, 0.0, 0.3, 0.0), speed=1.8)] * 5
    slow = [made((0.0, 0.0, 0.05, 0.0), speed=0.4)] * 5
    words = place_in_words(car.system, quiet_band, fast + slow, 1.0)
    assert words.startswith("yaw: ")
    assert "more than predicted" in words
    assert words.endswith("is above 1.1 m/s")


def test_errors_of_both_signs_are_large_on_the_side_where_their_sizes_are(car, quiet_band):
    slow = [made((0.0, 0.0, error, 0.0), speed=0.4) for error in (0.3, -0.3) * 4]
    fast = [made((0.0, 0.0, error, 0.0), speed=1.8) for error in (0.05, -0.05) * 4]
    words = place_in_words(car.system, quiet_band, slow + fast, 1.0)
    assert words.startswith("yaw: ")
    assert "beside the prediction" in words
    assert words.endswith("speed is below 1.1 m/s")
    mirrored = [made((0.0, 0.0, -0.05, 0.0), speed=0.4)] * 5 + [made((0.0, 0.0, -0.3, 0.0), speed=1.8)] * 5
    assert place_in_words(car.system, quiet_band, mirrored, 1.0).endswith("speed is above 1.1 m/s")


def test_words_tell_a_wind_by_the_heading(car, quiet_band):
    wind = [made((0.0, 0.0, 0.0, -0.3 * np.cos(yaw - 1.0)), yaw=yaw) for yaw in np.linspace(0.0, 6.0, 20)]
    words = place_in_words(car.system, quiet_band, wind, 1.0)
    assert "turning with the heading" in words
    assert "-123 degrees" in words
