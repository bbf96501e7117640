"""The table of tunings: metrics and ratios checked by hand, errors over drives and logs, and a small run."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from safedpa.dynamics import load_model, shipped_models
from safedpa.errors import InputError
from safedpa.safety.margins.conformal import split_conformal_margin
from safedpa_lab.experiments.tuning import real_car as tuning_real
from safedpa_lab.experiments.tuning.errors import errors_of_drive, metrics_of, ratios_of
from safedpa_lab.experiments.tuning.experiment import CarTuning, car_tuning, tuning_page
from safedpa_lab.experiments.tuning.models import Retained, key_of
from safedpa_lab.experiments.tuning.real_car import RealTuning, parts_of, real_tuning
from safedpa_lab.tuning.paper import sequence_of
from safedpa_lab.tuning.predictors import AbstractPredictor, NetworkPredictor, open_loop_errors
from safedpa_sim.training.data.recorded_runs import TuningDrive, record_circles

WEIGHTS = load_model("car_simulated").base.weights


def errors_at(predictor: AbstractPredictor, drive: TuningDrive, starts: list[int], steps: int) -> np.ndarray:
    """Returns own-frame errors (starts, states) after some steps."""
    seen = predictor.seen(sequence_of(predictor.networks, [drive]))
    with torch.no_grad():
        return open_loop_errors(predictor, seen, torch.tensor(starts), steps)[-1].double().numpy()


@pytest.mark.long
def test_errors_of_a_drive_are_added_up_over_its_starts() -> None:
    """Of 100 transitions those from tick 60 on count; over a horizon of 20 every fifth that still fits."""
    (run,), predictor = record_circles(100, 3, 100), NetworkPredictor(WEIGHTS)
    drive = TuningDrive(run.states, run.actions[:-1])
    found = errors_of_drive(predictor, drive)
    for horizon, starts, steps in (("one_step", list(range(60, 100)), 1), ("one_second", [60, 65, 70, 75, 80], 20)):
        squares = (errors_at(predictor, drive, starts, steps) ** 2).sum(axis=0)
        assert found[horizon]["count"] == len(starts)
        assert found[horizon]["squares"] == pytest.approx(squares.tolist(), rel=1e-4)


def test_a_ratio_counts_every_step_and_its_interval_every_draw_of_groups() -> None:
    """Mean squares of (2, 1) and (1, 1) with scales 1 and 2: 1.125 over 0.625, and 3 over 2. A draw of the first group
    alone has (2, 4/3) over (1, 1), one of the second alone (2, 2/3) over (1, 1)."""

    def of(count: int, *squares: float) -> dict[str, Any]:
        return {"squares": list(squares), "count": count}

    base = [[of(2, 4.0, 1.0), of(1, 2.0, 3.0)], [of(3, 6.0, 2.0)]]
    row = [[of(2, 1.0, 1.0), of(1, 2.0, 2.0)], [of(3, 3.0, 3.0)]]
    reported = ratios_of(base, row, np.array([1.0, 2.0]))
    assert reported["mean_square"] == pytest.approx([2.25 / 1.25, (2.0 + 1.0 / 6.0) / 1.25, (2.0 + 1.0 / 3.0) / 1.25])
    assert reported["squared_norm"] == pytest.approx([1.5, 4.0 / 3.0, 5.0 / 3.0])
    roots = [(np.sqrt(2.0) + 0.5 * np.sqrt(second)) / 1.5 for second in (1.0, 2.0 / 3.0, 4.0 / 3.0)]
    assert reported["root_mean_square"] == pytest.approx(roots)


@pytest.mark.parametrize(("share", "cuts"), [(0.5, (5, 2)), (0.25, (2, 1)), (1.0, (10, 4))])
def test_parts_of_drives_share_the_state_at_the_cut(share: float, cuts: tuple[int, int]) -> None:
    drives = [TuningDrive(np.arange(n + 1.0)[:, None], np.arange(float(n))[:, None]) for n in (10, 4)]
    first, rest = parts_of(drives, share)
    assert [len(one.actions) for one in first] == list(cuts)
    assert [len(one.actions) for one in rest] == [10 - cuts[0], 4 - cuts[1]]
    for before, after in zip(first, rest, strict=True):
        assert before.states[-1] == after.states[0] == len(before.actions)


@pytest.mark.long
def test_each_log_is_judged_in_its_second_half_with_a_margin_of_the_others_last_quarters(tmp_path, monkeypatch) -> None:
    """Logs of 332 and 720 transitions; trainings are faked and return the shipped weights."""
    logs = {name: record_circles(rows, rows, rows)[0] for name, rows in (("a" * 19, 332), ("b" * 19, 720))}
    drives = {name: TuningDrive(run.states, run.actions[:-1]) for name, run in logs.items()}
    for name in logs:
        (tmp_path / tuning_real.CAR.replace("*", name)).touch()

    def refused(*_: Any) -> Any:
        raise InputError("no better")

    predictor, own = NetworkPredictor(WEIGHTS), list[list[int]]()

    def online(model: AbstractPredictor, given: list[TuningDrive], _: Any) -> Any:
        own.append([len(drive.actions) for drive in given])
        return model, SimpleNamespace(refused=False, ridge=0.1)

    monkeypatch.setattr(tuning_real, "mapped_runs", lambda paths, *_: list(logs.values()) if paths else [])
    monkeypatch.setattr(tuning_real, "train_affine", lambda *_: (WEIGHTS, {}))
    monkeypatch.setattr(tuning_real, "train_history_encoder", lambda *_: (WEIGHTS, {}))
    monkeypatch.setattr(tuning_real, "tune_as_written", lambda *_: WEIGHTS)
    monkeypatch.setattr(tuning_real, "tune_on_drives", refused)
    monkeypatch.setattr(tuning_real, "tuned_online", online)
    folds = real_tuning(RealTuning(tmp_path))["folds"]
    assert own == [[166], [360]]
    assert [(fold["log"][0], fold["transitions"]) for fold in folds] == [("a", 166), ("b", 360)]
    assert folds[0]["notice"] == {"ours": "refused: no better", "online": "ridge 0.1"}
    for fold, other in zip(folds, reversed(drives.values()), strict=True):
        judged = parts_of([drives[fold["log"]]], 0.5)[1][0]
        known = parts_of([other], 0.75)[1][0]
        for horizon, steps in (("one_step", 1), ("one_second", 20)):
            off = [
                np.hypot(*errors_at(predictor, one, list(range(60, len(one.actions) - steps + 1)), steps)[:, :2].T)
                for one in (known, judged)
            ]
            row = fold["rows"]["untuned"][horizon]
            margin = split_conformal_margin(off[0], 0.99)
            assert np.isfinite(margin) == (len(off[0]) >= 99), "of fewer errors there is none"
            assert row["margin"] == pytest.approx(margin, rel=1e-3)
            assert row["covered"] == pytest.approx((off[1] <= margin).mean(), abs=0.01)
            assert row["count"] == len(off[1])
            assert fold["rows"]["paper"] == fold["rows"]["ours"] == fold["rows"]["untuned"]


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


def test_unpaired_drives_are_refused():
    with pytest.raises(ValueError, match="wanted pairs of the same drives"):
        ratios_of([[drive(SCALE)]], [[drive(SCALE)], [drive(SCALE)]], SCALE)


def test_a_kept_result_is_made_once_for_each_key(tmp_path):
    made = []
    retained = Retained(tmp_path / "retained")

    def make():
        made.append(1)
        return {"errors": [0.1, 0.2]}

    assert [retained.table("row", key, make) for key in ("a", "a", "b")] == [{"errors": [0.1, 0.2]}] * 3
    assert len(made) == 2
    numbers = (np.arange(3.0), np.eye(2))
    again = [retained.arrays("drive", "a", lambda: numbers) for _ in range(2)][1]
    np.testing.assert_array_equal(again[1], numbers[1])
    module = "safedpa_lab.tuning.paper"
    assert key_of(module, 0) == key_of(module, 0)
    assert key_of(module, 0) != key_of(module, 1)


def test_a_file_in_the_place_of_the_folder_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be made"):
        Retained(tmp_path / "file" / "retained")


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


def test_the_real_car_is_left_out_without_recordings(tmp_path):
    assert "no --data was given" in real_tuning(RealTuning(None))["left_out"]
    with pytest.raises(InputError, match=r"--data .*: got 0 logs of the real car, wanted two or more"):
        RealTuning(tmp_path)


@pytest.mark.long
@pytest.mark.slow
def test_a_small_run_resumes_and_its_page_has_every_metric(tmp_path):
    experiment = CarTuning(
        shipped_models()["car_learned"].parent, tmp_path, drives=2, ticks=100, own_ticks=320,
        rows=("shipped", "online_shipped"),
    )  # fmt: skip
    first = car_tuning(experiment)
    reported = []
    assert car_tuning(experiment, reported.append) == first
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
