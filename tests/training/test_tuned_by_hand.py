"""What models are off by before and after they are tuned, from errors that are written down by hand."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from safedpa_lab.experiments import pendulum_payload, relinearised_errors, tuning_errors, tuning_real
from safedpa_sim.training.tuning_data import Drive


def drive(transitions: int) -> Drive:
    return Drive(torch.zeros(transitions + 1, 4), torch.zeros(transitions, 2))


def of(count: int, *squares: float) -> dict[str, Any]:
    return {"squares": list(squares), "count": count}


def test_errors_of_a_drive_are_added_up_over_its_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 100 transitions those from tick 60 on; over a second (20) every fifth that still fits."""
    asked: list[tuple[list[int], int]] = []

    def errors(_predictor: Any, _seen: Any, starts: torch.Tensor, steps: int) -> torch.Tensor:
        asked.append((starts.tolist(), steps))
        last = torch.tensor([1.0, -2.0, 0.0, 3.0]).repeat(len(starts), 1)
        return torch.stack([torch.full_like(last, 99.0), last])

    monkeypatch.setattr(tuning_errors, "open_loop_errors", errors)
    monkeypatch.setattr(tuning_errors, "lived_of", lambda *_: None)
    predictor: Any = SimpleNamespace(seen=lambda _: None, networks=None)
    found = tuning_errors.errors_of_drive(predictor, drive(100))
    assert asked == [(list(range(60, 100)), 1), ([60, 65, 70, 75, 80], 20)]
    assert found == {
        "one_step": of(40, 40.0, 160.0, 0.0, 360.0),
        "one_second": of(5, 5.0, 20.0, 0.0, 45.0),
    }


BASE = [[of(2, 4.0, 1.0), of(1, 2.0, 3.0)], [of(3, 6.0, 2.0)]]
ROW = [[of(2, 1.0, 1.0), of(1, 2.0, 2.0)], [of(3, 3.0, 3.0)]]


def test_the_mean_of_groups_of_drives_is_over_all_their_steps() -> None:
    """(4 + 2) / 3 and 6 / 3; both groups together 12 / 6; the second twice and the first once 18 / 9."""
    picked = np.array([[0], [1]])
    assert tuning_errors._means(BASE, picked).tolist() == [[2.0, 4.0 / 3.0], [2.0, 2.0 / 3.0]]
    assert tuning_errors._means(BASE, np.array([[0, 1]])).tolist() == [[2.0, 1.0]]
    assert tuning_errors._means(ROW, np.array([[1, 1]])).tolist() == [[1.0, 1.0]]


def test_how_many_times_less_a_tuned_model_is_off() -> None:
    """Mean squares of (2, 1) and (1, 1) with scales 1 and 2: 1.125 over 0.625, and 3 over 2."""
    told = tuning_errors.ratios_of(BASE, ROW, np.array([1.0, 2.0]))
    assert told["mean_square"][0] == pytest.approx(1.8)
    assert told["squared_norm"][0] == pytest.approx(1.5)
    assert told["root_mean_square"][0] == pytest.approx((np.sqrt(2.0) + 0.5) / 1.5)
    for point, low, high in told.values():
        assert low <= point <= high


def test_a_log_that_was_left_out_is_judged_in_its_second_half(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 100 and 61 transitions 50 and 31."""
    monkeypatch.setattr(tuning_real, "key_of", lambda *_: "key")
    kept: Any = SimpleNamespace(table=lambda *_: {"rows": {}, "said": {}})

    class Untuned:
        digest = "d"

        def __getitem__(self, _: str) -> Any:
            return np.ones(4, dtype=np.float32)

    configuration: Any = SimpleNamespace(phase_3=None)
    known: Any = Untuned()
    row = tuning_real._fold("log", [drive(100), drive(61)], [[drive(80)]], known, configuration, kept)
    assert (row["log"], row["transitions"]) == ("log", 81)


def test_a_margin_of_other_logs_covers_a_share_of_fresh_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    """Known are errors of 0.01 to 1 m; of five fresh ones in two drives three are at most as large as the margin."""
    known, fresh = drive(100), [drive(90), drive(95)]
    errors = {
        id(known): np.arange(1.0, 101.0) / 100.0,
        id(fresh[0]): np.array([0.2, 1.5]),
        id(fresh[1]): np.array([0.5, 0.9, 2.0]),
    }
    monkeypatch.setattr(tuning_real, "errors_of_drive", lambda *_: {"one_step": of(1, 1.0), "one_second": of(1, 1.0)})
    monkeypatch.setattr(tuning_real, "metrics_of", lambda *_: {})
    monkeypatch.setattr(tuning_real, "_is_long", lambda _: True)
    monkeypatch.setattr(tuning_real, "_position_errors", lambda _predictor, one, _steps: errors[id(one)])
    predictor: Any = None
    found = tuning_real._judged(predictor, [known], fresh, np.ones(4))
    for horizon in ("one_step", "one_second"):
        assert (found[horizon]["count"], found[horizon]["covered"]) == (5, 0.6)
        assert 0.95 <= found[horizon]["margin"] <= 1.0


def test_errors_of_networks_are_the_roots_of_mean_squares(monkeypatch: pytest.MonkeyPatch) -> None:
    """Yaw is off by 3 and 4 rad, the velocity by 1 and 7 m/s in both directions: roots of 12.5 and of 25."""
    off = np.array([[9.0, 9.0, 3.0, 1.0, -1.0], [9.0, -9.0, -4.0, 7.0, -7.0]])
    true = np.arange(10.0).reshape(2, 5)
    f, g = true + off - np.array([1.0, 0.0, 0.0, 0.5, 0.0]), np.zeros((2, 5, 1))
    g[:, :, 0] = np.array([0.5, 0.0, 0.0, 0.25, 0.0])
    cars = SimpleNamespace(generator=lambda _: None)
    drawn = (torch.zeros(2, 3), torch.zeros(2, 5), torch.full((2, 1), 2.0), torch.zeros(2, 5))
    told = SimpleNamespace(trained_on={"pairs": 7, "seed": 1})
    affine = SimpleNamespace(digest="0123456789abcdef0123", description=told)
    free = SimpleNamespace(digest="d", description=told, encode=lambda e: e, increment=lambda *_: true - 2.0 * off)
    networks = SimpleNamespace(encode=lambda e: e, increment=lambda *_: (f, g))
    for name, value in {
        "COMMANDS": {"clean": (1.0,)}, "thrust_configuration": lambda _: None, "BatchedCars": lambda _: cars,
        "affine_floor": lambda *_: np.array([9.0, 9.0, 9.0, 0.25, 0.75]), "draw_transitions": lambda *_: drawn,
        "frame_of": lambda _: SimpleNamespace(world_increment=lambda *_: true), "affine_weights": lambda *_: affine,
        "free_model": lambda *_: free, "LearnedNetworks": lambda _: networks, "_explained": lambda *_: 0.5,
    }.items():  # fmt: skip
        monkeypatch.setattr(relinearised_errors, name, value)
    rows = {row["form"]: row for row in relinearised_errors.point_errors(Path())}
    assert rows["affine"]["yaw"] == pytest.approx(np.sqrt(12.5))
    assert rows["affine"]["velocity"] == pytest.approx(5.0)
    assert rows["free"]["yaw"] == pytest.approx(2.0 * np.sqrt(12.5))
    assert rows["free"]["velocity"] == pytest.approx(10.0)
    assert rows["affine"]["not_affine"] == rows["free"]["not_affine"] == 0.5


@pytest.mark.parametrize(
    ("value", "std", "within"),
    [(0.25, 0.03, True), (0.15, 0.03, True), (0.2, 0.001, True), (0.25, 0.02, False), (0.15, 0.02, False),
     (0.2, None, False), (None, None, False)],
)  # fmt: skip
def test_a_payload_is_found_where_its_mass_lies_within_two_of_the_stated_deviations(
    value: float | None, std: float | None, within: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Hidden are 0.2 kg."""
    named = {} if value is None else {"tip_mass.mass": SimpleNamespace(value=value, std=std)}
    found = SimpleNamespace(parameters=named, added=list(named), stages=[SimpleNamespace(heldout_error=0.5)])
    monkeypatch.setattr(pendulum_payload, "parse_model", lambda text: text)
    monkeypatch.setattr(pendulum_payload, "_logs", lambda *_: [])
    monkeypatch.setattr(pendulum_payload, "diagnose", lambda *_: found)
    row = pendulum_payload.diagnosed_payload(("model", 0.2, 3, 1, 1.0))
    assert row["within"] is within
    assert (row["value"], row["std"], row["mass"], row["seed"]) == (value, std, 0.2, 3)
