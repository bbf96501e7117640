"""The table of tunings: its metrics and ratios by hand, what is kept and when it is made again, and a run in small."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from safedpa.dynamics import shipped_models
from safedpa.errors import InputError
from safedpa_lab.experiments.tuning import CarTuning, car_tuning
from safedpa_lab.experiments.tuning_errors import metrics_of, ratios_of
from safedpa_lab.experiments.tuning_kept import Kept, key_of
from safedpa_lab.experiments.tuning_page import tuning_page
from safedpa_lab.experiments.tuning_real import RealTuning, parts_of, real_tuning
from safedpa_sim.training.tuning_data import Drive

SCALE = np.array([1.0, 2.0, 4.0, 8.0])


def drive(squares, count=1):
    return {"squares": list(squares), "count": count}


def test_the_three_metrics_follow_their_definitions():
    """Mean squares 4, 4, 16, 64: roots 2, 2, 4, 8, scaled 2, 1, 1, 1."""
    found = metrics_of([drive((2.0, 8.0, 0.0, 128.0), 1), drive((6.0, 0.0, 32.0, 0.0), 1)], SCALE)
    assert found["root_mean_square"] == pytest.approx((2.0 + 1.0 + 1.0 + 1.0) / 4.0)
    assert found["mean_square"] == pytest.approx((4.0 + 1.0 + 1.0 + 1.0) / 4.0)
    assert found["squared_norm"] == pytest.approx(4.0 + 4.0 + 16.0 + 64.0)
    assert (found["along"], found["yaw"], found["speed"]) == pytest.approx((2.0, 4.0, 8.0))


def test_a_row_with_half_of_every_error_is_twice_as_good_in_every_draw():
    base = [[drive(np.array([1.0, 2.0, 3.0, 4.0]) * factor, 3)] for factor in (1.0, 5.0, 0.2)]
    row = [[drive(np.array(group[0]["squares"]) / 4.0, 3)] for group in base]
    found = ratios_of(base, row, SCALE)
    assert found["root_mean_square"] == pytest.approx([2.0, 2.0, 2.0])
    assert found["squared_norm"] == pytest.approx([4.0, 4.0, 4.0])


def test_the_interval_of_a_ratio_is_that_of_the_draws_of_whole_seeds():
    """Two seeds with ratios 1 and 3: a draw has both (2), or one of them twice, a quarter of the time each."""
    base = [[drive((1.0, 0.0, 0.0, 0.0))], [drive((9.0, 0.0, 0.0, 0.0))]]
    row = [[drive((1.0, 0.0, 0.0, 0.0))], [drive((1.0, 0.0, 0.0, 0.0))]]
    point, low, high = ratios_of(base, row, SCALE)["root_mean_square"]
    assert point == pytest.approx(math.sqrt(5.0))
    assert (low, high) == pytest.approx((1.0, 3.0))


def test_unpaired_drives_are_refused():
    with pytest.raises(ValueError, match="wanted pairs of the same drives"):
        ratios_of([[drive(SCALE)]], [[drive(SCALE)], [drive(SCALE)]], SCALE)


def test_a_kept_result_is_made_once_for_each_key(tmp_path):
    made = []
    kept = Kept(tmp_path / "kept")

    def make():
        made.append(1)
        return {"errors": [0.1, 0.2]}

    assert [kept.table("row", key, make) for key in ("a", "a", "b")] == [{"errors": [0.1, 0.2]}] * 3
    assert len(made) == 2
    numbers = (np.arange(3.0), np.eye(2))
    again = [kept.arrays("drive", "a", lambda: numbers) for _ in range(2)][1]
    np.testing.assert_array_equal(again[1], numbers[1])
    module = "safedpa_sim.training.paper_tuning"
    assert key_of(module, 0) == key_of(module, 0)
    assert key_of(module, 0) != key_of(module, 1)


def test_a_file_in_the_place_of_the_folder_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be made"):
        Kept(tmp_path / "file" / "kept")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rows": ("shiped",)}, "did you mean 'shipped'"),
        ({"drives": 1}, "drives: got 1, wanted 2 to 100"),
        ({"seed": 500}, "seed: got 500, wanted 0 to 299"),
        ({"ticks": 99}, "wanted at least 100"),
    ],
)
def test_invalid_tunings_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        CarTuning(Path("learned/car"), **options)


def test_half_of_a_drive_and_the_rest_share_the_state_between_them():
    states, actions = np.arange(20.0).reshape(5, 4), np.zeros((4, 2))
    begun, rest = parts_of([Drive(states, actions)], 0.5)
    assert (len(begun[0].actions), len(rest[0].actions)) == (2, 2)
    np.testing.assert_array_equal(begun[0].states[-1], rest[0].states[0])


def test_the_real_car_is_left_out_without_recordings(tmp_path):
    assert "no --data was given" in real_tuning(RealTuning(None))["left_out"]
    with pytest.raises(InputError, match=r"--data .*: got 0 logs of the real car, wanted two or more"):
        RealTuning(tmp_path)


@pytest.mark.long
@pytest.mark.slow
def test_a_small_run_resumes_and_its_page_has_every_metric(tmp_path):
    experiment = CarTuning(
        shipped_models()["car_learned"].parent,
        tmp_path,
        drives=2,
        ticks=100,
        own_ticks=320,
        rows=("shipped", "online_shipped"),
    )
    first = car_tuning(experiment)
    told = []
    assert car_tuning(experiment, told.append) == first
    rows = first["rows"]
    assert list(rows) == ["untuned", "untuned_point", "shipped", "online_shipped"]
    assert rows["shipped"]["ratios"]["none"]["one_step"]["untuned"]["root_mean_square"][0] > 3.0
    point = rows["untuned_point"]["metrics"]["none"]["one_step"]
    assert point["across"] < 0.3 * rows["untuned"]["metrics"]["none"]["one_step"]["across"]
    assert point["yaw"] == pytest.approx(rows["untuned"]["metrics"]["none"]["one_step"]["yaw"], rel=0.2)
    towing = [rows["shipped"]["metrics"][load]["one_step"]["squared_norm"] for load in ("box", "chair", "large_chair")]
    assert min(towing) < rows["shipped"]["metrics"]["loads"]["one_step"]["squared_norm"] < max(towing)
    assert rows["shipped"]["metrics"]["loads"]["one_step"]["squared_norm"] == pytest.approx(np.mean(towing), rel=0.05)
    for taken in rows["online_shipped"]["taken"].values():
        assert taken["refused"] or taken["after"][0] < taken["before"][0]
    page = tuning_page({"car": first, "real": {"left_out": "no logs"}})
    assert "## Squared norm, raw SI units, one second" in page
    assert page.count("| ours, as shipped |") == 10
    assert "Left out: no logs." in page
