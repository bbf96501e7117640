"""Logs of five rows, logs in which nothing moves, logs given twice, and places where nothing may be written."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from safedpa.compare.output import refuse_inputs
from safedpa.errors import InputError
from safedpa.records import load_run
from safedpa.robots.car.system import CAR
from safedpa.systems import System, Variable, add_system
from safedpa_services.command_line.group import safedpa

HEADER = "t,x,y,yaw,speed,target_speed,steer"


def table(rows: int, *, still: bool = False, factor: float = 1.0, since: float = 0.0) -> str:
    """A circle, or a car that stands."""
    t = 0.05 * np.arange(rows)
    yaw = 0.0 * t if still else t
    ones = np.full(rows, 0.0 if still else 1.0)
    columns = np.column_stack([t * factor + since, np.sin(yaw), 1 - np.cos(yaw), yaw, ones, ones, 0.3 * ones])
    columns[:, 1:] += 0.0 if still else 0.002 * np.random.default_rng(1).normal(size=(rows, 6))
    return "\n".join([HEADER, *(",".join(repr(float(value)) for value in row) for row in columns), ""])


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "five.csv").write_text(table(5))
    (tmp_path / "still.csv").write_text(table(300, still=True))
    (tmp_path / "good.csv").write_text(table(300))
    return tmp_path


def refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    assert safedpa.run(arguments) == 2
    return capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments",
    [
        ["diagnose", "car", "five.csv", "--out", "new"],
        ["diagnose", "car", "five.csv", "--check"],
        ["rehearse", "car", "five.csv"],
        ["add", "car", "drive_lag", "five.csv", "--out", "new.toml"],
    ],
    ids=["diagnose", "check", "rehearse", "add"],
)
def test_five_rows_are_refused_as_too_few_without_asking_for_another_horizon(
    arguments: list[str], here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = refused(arguments, capsys)
    assert "lasts 0.2 s" in text
    assert "record 5 s" in text
    assert "choose a shorter horizon" not in text
    assert not list(here.glob("new*"))


def test_an_effect_is_not_fitted_to_a_stationary_car(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "nothing to fit" in refused(["add", "car", "drive_lag", "still.csv", "--out", "new.toml"], capsys)
    assert not (here / "new.toml").exists()


def test_the_check_reports_data_in_which_nothing_changes(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert safedpa.run(["diagnose", "car", "still.csv", "--check"]) == 0
    assert "data: no state ever changes" in capsys.readouterr().out


def test_no_nan_is_printed_for_a_stationary_car(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert safedpa.run(["diagnose", "car", "still.csv", "--out", "new"]) == 0
    assert "nan times" not in capsys.readouterr().out


@pytest.mark.parametrize("command", [["add", "car", "drive_lag"], ["predict", "car"]], ids=["add", "predict"])
def test_a_folder_is_refused_as_the_file_to_write(
    command: list[str], here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = refused([*command, "good.csv", "--horizon", "1", "--out", str(here)], capsys)
    assert "is a folder; name the file" in text


def test_a_recording_given_twice_counts_once_and_is_reported(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (here / "link.csv").symlink_to("good.csv")
    documents = []
    for runs in (["good.csv"], ["good.csv", "link.csv"]):
        assert safedpa.run(["compare", "car", *runs, "--out", "new", "--json"]) == 0
        documents.append(json.loads(capsys.readouterr().out))
    once, twice = documents
    assert twice["windows"] == once["windows"]
    assert twice["error"] == once["error"]
    assert "same_recording" in [item["kind"] for item in twice["data_quality"]]


@pytest.mark.parametrize("name", ["metadata.yaml", "drive_0.db3", "drive_0.mcap"])
def test_the_files_of_a_bag_are_inputs(tmp_path: Path, name: str) -> None:
    (tmp_path / name).touch()
    with pytest.raises(InputError, match="is an input of this command"):
        refuse_inputs([tmp_path / name], [tmp_path])
    refuse_inputs([tmp_path / "report.html"], [tmp_path])


def test_a_folder_is_not_proposed_for_itself(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (here / "logs").mkdir()
    assert "did you mean" not in refused(["compare", "car", "logs"], capsys)


def test_milliseconds_since_1970_are_recognised_at_any_rate(tmp_path: Path) -> None:
    """1.7e12 s is no time that a robot could have."""
    for factor in (20.0, 100.0, 1000.0):  # rows 1, 5 and 50 ms apart
        (tmp_path / "drive.csv").write_text(table(300, factor=factor, since=1.7e12))
        with pytest.raises(InputError, match="it looks like ms"):
            load_run(tmp_path / "drive.csv", CAR)


@pytest.mark.parametrize("rows", [0, 1, 4])
def test_too_few_rows_are_refused_with_the_number_wanted(tmp_path: Path, rows: int) -> None:
    (tmp_path / "drive.csv").write_text(table(rows))
    with pytest.raises(InputError, match="wanted 5 rows one after another"):
        load_run(tmp_path / "drive.csv", CAR)


@pytest.mark.parametrize(
    ("variable", "said"),
    [
        (Variable("heading", "deg", -360.0, 360.0, angle=True), "got an angle in 'deg', wanted 'rad'"),
        (Variable("speed", "m/s", 5.0, -5.0), "got bounds 5 to -5"),
        (Variable("speed", "m/s", float("nan"), 5.0), "got bounds nan to 5"),
    ],
)
def test_a_system_with_wrong_units_or_bounds_is_refused(variable: Variable, said: str) -> None:
    with pytest.raises(InputError, match=said):
        add_system(System("odd_one", (variable,), ()))
