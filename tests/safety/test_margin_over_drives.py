"""Margins over drives: what they promise where steps of one drive are alike, and which drives they are made of."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binom

from safedpa.errors import InputError
from safedpa.safety import MarginCalibration, parse_settings, split_conformal_margin
from safedpa.safety.ceiling import Ceiling, Seen
from safedpa.safety.drive_calibration import calibration_from_drives, covered_shares
from safedpa.safety.margin import margins_over_drives


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
    return np.array([Seen(error, 0.0) for error in wanted])


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
    assert smaller.chosen("drive").epsilon == smaller.drive
    assert smaller.chosen(parse_settings('margin = "drive"').margin).epsilon == smaller.drive
    with pytest.raises(InputError, match="margin 'drive': the calibration has it for no kind, wanted a, b"):
        dataclasses.replace(smaller, drive={}).chosen("drive")
    with pytest.raises(InputError, match=r"drives: got 98, wanted at least 99 for a coverage of 0\.99"):
        calibration_from_drives(drives[:98], 0.99, "2026-11-22", "x")


def test_a_ceiling_rises_until_it_is_above_the_layer_of_the_margin() -> None:
    """At h of 5 nobody is near; an error that leads from there to 1 is one of a robot whose margin needs that room."""
    drives = [{"a": np.array([Seen(5.0, 5.0 - 0.04 * k), Seen(0.3, 0.3)])} for k in range(100)]
    far = calibration_from_drives(drives, 0.9, "2026-11-22", "x", Ceiling(0.1, {"a": 0.5}))
    assert far.drive == far.epsilon == {"a": 0.0}, "an error of 4 m that ends at 1 m is none"
    assert far.constants == {"ceiling.a": 0.5, "drive.ceiling.a": 0.5}
    nobody = [{"a": np.array([Seen(0.9, 0.9 - 0.0001 * k)])} for k in range(100)]
    seen = calibration_from_drives(nobody, 0.9, "2026-11-22", "x", Ceiling(0.1, {"a": 0.5}))
    assert seen.constants["ceiling.a"] == 1.0, "where nobody came near, farther steps have to say something"
    assert seen.drive["a"] == pytest.approx(0.009)
    with pytest.raises(InputError, match="transitions: got 0"):
        calibration_from_drives([{"a": np.zeros((0, 4))}] * 100, 0.9, "", "x")
    low = [{"a": np.array([Seen(5.0, 1.0 - 0.01 * k)])} for k in range(100)]
    found = calibration_from_drives(low, 0.9, "2026-11-22", "x", Ceiling(0.1, {"a": 0.5}))
    assert found.drive["a"] == pytest.approx(4.9), "0.4 is too much for a ceiling of 0.5, and so on up to all of it"
    assert found.constants["drive.ceiling.a"] == 64.0


def test_ten_drives_near_are_enough_and_fewer_are_not() -> None:
    """A drive in which nothing of the kind was there is none that came near, and none with an error."""
    near, far, low = Seen(0.3, 0.29), Seen(0.9, 0.88), Ceiling(0.1, {"a": 0.5})
    for count, top, drive in ((10, 0.5, 0.01), (9, 1.0, 0.02)):
        drives = [{"a": np.array([near, far])}] * count + [{"a": np.array([far])}] + [{}] * (98 - count)
        made = calibration_from_drives(drives, 0.99, "", "x", low)
        assert made.constants["ceiling.a"] == top
        assert made.drive["a"] == pytest.approx(drive)
        assert made.transitions == 2 * count + 1, "a drive without anything has no step"
    never = calibration_from_drives([{"a": np.array([Seen(1e13, 1e13)])}] * 99, 0.99, "", "x", low)
    assert never.constants["ceiling.a"] == 0.5 * 2.0**40
    assert never.drive == {"a": 0.0}


def test_what_a_margin_covers_is_counted_where_something_came_near() -> None:
    low = Ceiling(0.1, {"a": 0.5})
    drives = [
        {"a": heights([0.1, 0.2, 0.3, 0.4])},
        {"a": np.array([Seen(0.9, 0.6)])},
        {},
        {"a": np.array([Seen(0.9, 0.6), Seen(0.45, 0.2)])},
    ]
    assert covered_shares(drives, "a", 0.0, low).tolist() == [0.0, 1.0, 1.0, 0.0]
    assert covered_shares([{"a": np.array([Seen(0.25, 0.0), Seen(0.26, 0.0)])}], "a", 0.25).tolist() == [0.5], (
        "an error of just the margin is covered"
    )
    assert covered_shares(drives, "a", 0.25, low).tolist() == [0.5, 0.0, 1.0, 0.5], "a wide margin sees farther"


@pytest.mark.parametrize(
    ("text", "words"),
    [("drives = -1", "drives: got -1"), ("origin = 3", "origin: got 3"), ("drive = 3", "drive: got 3")],
)
def test_the_contents_of_a_margin_file_are_checked(text: str, words: str, tmp_path: Path) -> None:
    good = MarginCalibration({"a": 0.1}, 0.9, 50, "2026-11-22", "x").write()
    (tmp_path / "margin.toml").write_text(f"{text}\n{good}")
    with pytest.raises(InputError, match=words):
        MarginCalibration.load(tmp_path / "margin.toml")
