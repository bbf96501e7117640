"""What models are off by before and after they are tuned, over a drive, over drives, and on logs of a real car."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from safedpa.dynamics import load_model
from safedpa.errors import InputError
from safedpa.safety.margin import split_conformal_margin
from safedpa_lab.experiments import tuning_real
from safedpa_lab.experiments.tuning_errors import errors_of_drive, ratios_of
from safedpa_lab.experiments.tuning_real import RealTuning, parts_of, real_tuning
from safedpa_sim.training.paper_tuning import lived_of
from safedpa_sim.training.predictors import AbstractPredictor, NetworkPredictor, open_loop_errors
from safedpa_sim.training.tuning_data import Drive, record_circles

WEIGHTS = load_model("car_simulated").base.weights


def errors_at(predictor: AbstractPredictor, drive: Drive, starts: list[int], steps: int) -> np.ndarray:
    """Own-frame errors (starts, states) after so many steps."""
    seen = predictor.seen(lived_of(predictor.networks, [drive]))
    with torch.no_grad():
        return open_loop_errors(predictor, seen, torch.tensor(starts), steps)[-1].double().numpy()


def test_errors_of_a_drive_are_added_up_over_its_starts() -> None:
    """Of 100 transitions those from tick 60 on; over a second (20) every fifth that still fits."""
    (run,), predictor = record_circles(100, 3, 100), NetworkPredictor(WEIGHTS)
    drive = Drive(run.states, run.actions[:-1])
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
    told = ratios_of(base, row, np.array([1.0, 2.0]))
    assert told["mean_square"] == pytest.approx([2.25 / 1.25, (2.0 + 1.0 / 6.0) / 1.25, (2.0 + 1.0 / 3.0) / 1.25])
    assert told["squared_norm"] == pytest.approx([1.5, 4.0 / 3.0, 5.0 / 3.0])
    roots = [(np.sqrt(2.0) + 0.5 * np.sqrt(second)) / 1.5 for second in (1.0, 2.0 / 3.0, 4.0 / 3.0)]
    assert told["root_mean_square"] == pytest.approx(roots)


@pytest.mark.parametrize(("share", "cuts"), [(0.5, (5, 2)), (0.25, (2, 1)), (1.0, (10, 4))])
def test_parts_of_drives_share_the_state_at_the_cut(share: float, cuts: tuple[int, int]) -> None:
    drives = [Drive(np.arange(n + 1.0)[:, None], np.arange(float(n))[:, None]) for n in (10, 4)]
    first, rest = parts_of(drives, share)
    assert [len(one.actions) for one in first] == list(cuts)
    assert [len(one.actions) for one in rest] == [10 - cuts[0], 4 - cuts[1]]
    for before, after in zip(first, rest, strict=True):
        assert before.states[-1] == after.states[0] == len(before.actions)


def test_each_log_is_judged_in_its_second_half_with_a_margin_of_the_others_last_quarters(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Logs of 332 and 720 transitions; no training is looked at: each gives the weights that ship."""
    logs = {name: record_circles(rows, rows, rows)[0] for name, rows in (("a" * 19, 332), ("b" * 19, 720))}
    drives = {name: Drive(run.states, run.actions[:-1]) for name, run in logs.items()}
    for name in logs:
        (tmp_path / tuning_real.CAR.replace("*", name)).touch()

    def refused(*_: Any) -> Any:
        raise InputError("no better")

    predictor, own = NetworkPredictor(WEIGHTS), list[list[int]]()

    def online(model: AbstractPredictor, given: list[Drive], _: Any) -> Any:
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
    assert folds[0]["said"] == {"ours": "refused: no better", "online": "ridge 0.1"}
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
