"""The commands as a person runs them: odd and few data, results that replace nothing that was read."""

from __future__ import annotations

import datetime
import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from safedpa.compare.output import new_folder, refuse_inputs, results_folder, writable, writable_file
from safedpa.diagnosis.diagnose import diagnose
from safedpa.dynamics import load_model
from safedpa.effects import effect
from safedpa.errors import InputError
from safedpa.records import load_run
from safedpa.records.run import Run, Stretch
from safedpa.robots.car.system import CAR
from safedpa.systems import System, Variable, add_system
from safedpa_lab.hidden import Case, write_case
from safedpa_services.command_line.group import safedpa


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    case = Case("test", 3, {"quadratic_drag": {"coefficient": 0.12}}, runs=3, seconds=20.0)
    return write_case(case, tmp_path_factory.mktemp("logs"))


def test_diagnose_prints_a_summary_and_writes_its_files(log, tmp_path, capsys):
    paths = [str(path) for path in log.runs]
    assert safedpa.run(["diagnose", str(log.model), *paths, "--out", str(tmp_path)]) == 0
    told = capsys.readouterr().out
    assert "The model lacks quadratic_drag" in told
    assert "quadratic_drag: coefficient 0.1" in told
    assert "given model" in told
    document = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    assert document["added"] == ["quadratic_drag"]
    for name in ("report.html", "diagnosis.rrd"):
        assert (tmp_path / name).stat().st_size > 1000
    model = load_model(str(tmp_path / "model.toml"))
    assert abs(model.settings["quadratic_drag.coefficient"].value - 0.12) < 0.005


def test_json_is_the_report_and_nothing_else(log, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("safedpa.diagnosis.diagnose.library_for", lambda _: [effect("car", "quadratic_drag")])
    assert safedpa.run(["diagnose", str(log.model), str(log.runs[0]), "--json", "--out", str(tmp_path)]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["robot"] == "car"
    margin, model = tmp_path / "margin.toml", tmp_path / "model.toml"
    told = document.pop("margin")
    assert told.pop("period") == pytest.approx(0.05)
    assert told == {"file": str(margin), "said": "", "drive": f"safedpa up --model {model} --margin {margin}"}
    assert document == json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))


def test_add_fits_one_effect_by_choice(log, tmp_path, capsys):
    out = tmp_path / "model2.toml"
    arguments = ["add", str(log.model), "viscous_drag", *map(str, log.runs), "--out", str(out), "--json"]
    assert safedpa.run(arguments) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["after"] < document["before"]
    assert [item.name for item in load_model(str(out)).effects] == ["viscous_drag"]


def test_add_refuses_an_unknown_effect(log, tmp_path, capsys):
    arguments = ["add", str(log.model), "viscus_drag", str(log.runs[0]), "--out", str(tmp_path / "m.toml")]
    assert safedpa.run(arguments) == 2
    assert "viscous_drag" in capsys.readouterr().err


def still(model, seconds, action):
    rows = round(seconds / model.period)
    states = np.zeros((rows, 4))
    states[0] = 0.0, 0.0, 0.0, 1.0
    actions = np.tile(action, (rows, 1))
    for row in range(rows - 1):
        states[row + 1] = model.step(states[row], actions[row])
    states += np.random.default_rng(0).normal(0.0, 0.002, states.shape)
    return Run("run", model.system, model.period * np.arange(rows), states, actions, (Stretch(0, rows),))


def test_two_seconds_are_no_evidence(log):
    model = load_model(str(log.model))
    report = diagnose(model, [still(model, 2.0, [1.0, 0.1])])
    assert report.verdict == "undecided"
    assert report.added == ()
    (why,) = [item["message"] for item in report.data_quality if item["kind"] == "no_verdict"]
    assert report.unexplained is not None
    assert (report.unexplained.depends_on, report.unexplained.expression) == ((), why), "no formula from so little"


def test_constant_inputs_are_no_evidence(log):
    model = load_model(str(log.model))
    report = diagnose(model, [still(model, 40.0, [1.0, 0.1])])
    assert report.verdict == "undecided"
    assert report.added == ()
    assert {"constant_input", "no_verdict"} <= {item["kind"] for item in report.data_quality}


def test_a_horizon_longer_than_the_log_is_refused(log):
    model = load_model(str(log.model))
    with pytest.raises(InputError, match="horizon"):
        diagnose(model, [still(model, 2.0, [1.0, 0.1])], horizon=5.0)


def changed(log, tmp_path, change):
    """The log's runs with their tables changed, as loaded runs."""
    model = load_model(str(log.model))
    found = []
    for path in log.runs:
        names = path.read_text(encoding="utf-8").splitlines()[0].split(",")
        table = np.loadtxt(path, delimiter=",", skiprows=1)
        change(names, table)
        out = tmp_path / path.name
        np.savetxt(out, table, delimiter=",", header=",".join(names), comments="")
        found.append(load_run(str(out), model.system))
    return model, found


def test_swapped_columns_are_not_explained_by_an_effect(log, tmp_path):
    def swap(names, table):
        pair = [names.index("x"), names.index("y")]
        table[:, pair] = table[:, pair[::-1]]

    report = diagnose(*changed(log, tmp_path, swap))
    assert report.verdict == "unexplained"
    assert report.added == ()
    assert "swapped_columns" in {item["kind"] for item in report.data_quality}


@pytest.mark.long
def test_a_teleport_and_a_missing_number_are_cut_and_reported(log, tmp_path):
    def spoil(names, table):
        table[100, names.index("yaw")] = np.nan
        table[200:, names.index("x")] += 3.0

    report = diagnose(*changed(log, tmp_path, spoil))
    assert report.added == ("quadratic_drag",)
    assert {"jump", "not_a_number"} <= {item["kind"] for item in report.data_quality}


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


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    case = Case("test", 3, {"quadratic_drag": {"coefficient": 0.12}}, runs=1, seconds=14.0)
    return write_case(case, tmp_path_factory.mktemp("own"))


@pytest.fixture
def in_use(written, tmp_path, monkeypatch):
    """The current folder, with ``model.toml`` and ``run.csv`` in it."""
    shutil.copy(written.model, tmp_path / "model.toml")
    shutil.copy(written.runs[0], tmp_path / "run.csv")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("safedpa.diagnosis.diagnose.library_for", lambda _: [effect("car", "quadratic_drag")])
    return tmp_path


@pytest.mark.long
@pytest.mark.parametrize("command", ["compare", "diagnose"])
def test_without_out_a_new_folder_is_made(command, in_use, capsys):
    before = {path.name: path.read_bytes() for path in in_use.iterdir()}
    for _ in range(2):
        assert safedpa.run([command, "model.toml", "run.csv"]) == 0
    told = capsys.readouterr().out
    after = {path.name: path.read_bytes() for path in in_use.iterdir() if path.is_file()}
    assert after == before
    made = sorted(path.name for path in in_use.iterdir() if path.is_dir())
    assert len(made) == 2
    assert all(name.startswith(f"{command}-model-20") for name in made)
    assert all(name in told for name in made)


@pytest.mark.parametrize(
    "arguments",
    [
        ["diagnose", "model.toml", "run.csv", "--out", "."],
        ["add", "model.toml", "viscous_drag", "run.csv", "--out", "./model.toml"],
        ["add", "model.toml", "viscous_drag", "run.csv", "--out", "run.csv"],
        ["predict", "model.toml", "run.csv", "--horizon", "0.5", "--out", "run.csv"],
    ],
    ids=["diagnose", "add", "add_over_run", "predict"],
)
def test_an_input_is_not_replaced(arguments, in_use, capsys):
    before = {path.name: path.read_bytes() for path in in_use.iterdir()}
    assert safedpa.run(arguments) == 2
    told = capsys.readouterr().err
    assert "is an input of this command" in told
    assert told.count("\n") == 1
    assert {path.name: path.read_bytes() for path in in_use.iterdir()} == before


def test_force_replaces_it(in_use):
    before = (in_use / "model.toml").read_bytes()
    arguments = ["add", "model.toml", "quadratic_drag", "run.csv", "--out", "model.toml"]
    assert safedpa.run([*arguments, "--force"]) == 0
    assert (in_use / "model.toml").read_bytes() != before


def test_a_folder_that_does_not_exist_is_refused_or_made_on_request(tmp_path: Path) -> None:
    assert writable(tmp_path) == tmp_path
    missing = tmp_path / "a" / "b"
    with pytest.raises(InputError, match=rf"^{missing}: got no folder that exists; make it, or choose another place"):
        writable(missing)
    assert not missing.parent.exists()
    assert writable(missing, create=True).is_dir()
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=r"file: got no folder that exists"):
        writable(tmp_path / "file")


@pytest.mark.parametrize("lacking", [os.W_OK, os.X_OK])
def test_a_folder_without_write_or_search_permission_is_refused(
    lacking: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "access", lambda _, asked: not asked & lacking)
    with pytest.raises(InputError, match=rf"^{tmp_path}: must not be written to; choose another place with --out"):
        writable(tmp_path)
    monkeypatch.setattr(os, "access", lambda _, asked: not asked & os.R_OK)
    assert writable(tmp_path) == tmp_path


def test_a_file_to_write_is_not_a_folder_and_its_folder_exists(tmp_path: Path) -> None:
    assert writable_file(tmp_path / "a.csv") == tmp_path / "a.csv"
    with pytest.raises(InputError, match=rf"^{tmp_path}: is a folder; name the file to write with --out"):
        writable_file(tmp_path)
    with pytest.raises(InputError, match="got no folder that exists"):
        writable_file(tmp_path / "none" / "a.csv")


@pytest.mark.parametrize("written", [False, True])
@pytest.mark.parametrize(
    ("there", "left"), [("", []), ("a", ["a"]), ("a/b", ["a", "a/b"]), ("a/b/c", ["a", "a/b", "a/b/c"])]
)
def test_a_command_that_fails_removes_the_empty_folders_that_it_made_itself(
    there: str, left: list[str], written: bool, tmp_path: Path
) -> None:
    (tmp_path / there).mkdir(parents=True, exist_ok=True)

    def work() -> None:
        with results_folder(tmp_path / "a" / "b", "compare", "car", (), (), False) as folder:
            assert folder.is_dir()
            if written:
                (folder / "report.json").write_text("{}", encoding="utf-8")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        work()
    found = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*"))
    assert found == (sorted({*left, "a", "a/b", "a/b/report.json"}) if written else left)


def test_a_new_folder_is_named_by_the_second_and_counted_from_two(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    made: list[Any] = []
    for _ in range(3):
        made.append(new_folder("diagnose", "models/my_car.toml", datetime.datetime(2026, 1, 2, 3, 4, 5)))
        made[-1].mkdir()
    first = "diagnose-my_car-2026-01-02-030405"
    assert [str(path) for path in made] == [first, f"{first}-2", f"{first}-3"]
