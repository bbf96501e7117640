"""Two checkouts side by side: what the machine does to both falls out of the ratio."""

from __future__ import annotations

import json
import math
from itertools import count
from pathlib import Path

import numpy as np
import pytest

from safedpa.errors import InputError
from safedpa_lab.benchmarks.against import FIGURES, against, checkout_of, interval_of_median
from safedpa_services.command_line.group import safedpa

ROOT = Path(__file__).parents[3]


def test_a_machine_that_slows_down_does_not_change_the_ratio() -> None:
    """It becomes a tenth slower from drive to drive; ours takes 1.2 times as long."""
    drives, asked = count(), []

    def drive(folder: Path) -> dict[str, float]:
        asked.append(folder.name)
        return {"time": 1.1 ** next(drives) * (1.2 if folder.name == "ours" else 1.0)}

    found = against(Path("ours"), Path("other"), 20, 1.0, drive=drive)["figures"]["time"]
    assert asked[:6] == ["other", "ours", "ours", "other", "other", "ours"]
    assert len(asked) == 42
    assert found["ratio"] == pytest.approx(1.2, rel=0.1)
    low, high = found["interval"]
    assert low <= 1.2 <= high


@pytest.mark.parametrize(("number", "low", "high"), [(3, 0, 2), (5, 0, 4), (6, 0, 5), (10, 1, 8), (20, 5, 14)])
def test_the_interval_is_that_of_the_sign_test(number: int, low: int, high: int) -> None:
    assert interval_of_median([float(value) for value in range(number)]) == (low, high)
    outside = 2.0 * sum(math.comb(number, rank) for rank in range(low + 1)) / 2.0**number
    assert number < 6 or outside <= 0.05


def test_the_interval_holds_the_median_as_often_as_it_says() -> None:
    chance = np.random.default_rng(5)
    held = 0
    for _ in range(400):
        low, high = interval_of_median(chance.lognormal(0.0, 1.0, 12).tolist())
        held += low <= 1.0 <= high
    assert held >= 0.93 * 400


def test_what_is_no_checkout_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="wanted a checkout"):
        checkout_of(tmp_path)
    assert checkout_of(ROOT) == ROOT


@pytest.mark.long
@pytest.mark.processes
@pytest.mark.slow
def test_this_checkout_against_itself(capsys: pytest.CaptureFixture[str]) -> None:
    assert safedpa.run(["bench", "against", str(ROOT), "--pairs", "1", "--seconds", "1", "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)["figures"]
    assert 0.1 < figures["start to the first action"]["ours"] < 180.0
    assert figures["sense to act, p50"]["ratio"] > 0.0


@pytest.mark.parametrize(("most", "code"), [("1.1", 1), ("1.3", 0)])
def test_what_is_slower_than_it_may_be_ends_with_an_error(
    most: str, code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("shared/safedpa", "services", "sim"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "shared/safedpa/__init__.py").touch()

    def drive(folder: Path, *_: object) -> dict[str, float]:
        return dict.fromkeys(FIGURES, 1.0 if folder == tmp_path else 1.2)

    monkeypatch.setattr("safedpa_lab.benchmarks.against.driven", drive)
    assert safedpa.run(["bench", "against", str(tmp_path), "--pairs", "1", "--seconds", "1", "--most", most]) == code


@pytest.mark.long
@pytest.mark.processes
@pytest.mark.slow
def test_rows_of_this_checkout_against_itself(capsys: pytest.CaptureFixture[str]) -> None:
    rows = ["--only", "batch", "--only", "decision-parts"]  # of those that load neither torch nor another's programs
    assert safedpa.run(["bench", "against", str(ROOT), "--pairs", "1", *rows, "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)["figures"]
    assert {"decision-parts, the whole decision, physics [us]", "batch, all at once [us]"} <= set(figures)
    assert all(row["unit"] == "us" and 1.0 < row["ours"] < 1e5 for row in figures.values())


def test_a_row_that_is_not_there_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert safedpa.run(["bench", "against", str(ROOT), "--only", "speed"]) == 2
    assert "filter" in capsys.readouterr().err
