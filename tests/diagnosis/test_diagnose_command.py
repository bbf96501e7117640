"""The commands as a person runs them: odd and few data, results that replace nothing that was read."""

import datetime
import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from safedpa.comparison.output import (
    new_folder,
    refuse_inputs,
    require_writable_file,
    require_writable_folder,
    results_folder,
)
from safedpa.diagnosis.diagnose import diagnose
from safedpa.dynamics import load_model
from safedpa.effects import effect
from safedpa.errors import InputError
from safedpa.records import load_run
from safedpa.robots.car.system import CAR
from safedpa.systems import System, Variable, add_system
from safedpa_lab.hidden import Case, write_case
from safedpa_services.command_line.group import safedpa


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    case = Case("test", 3, {"quadratic_drag": {"coefficient": 0.12}}, runs=3, seconds=20.0)
    return write_case(case, tmp_path_factory.mktemp("logs"))


@pytest.mark.long
def test_diagnose_prints_a_summary_and_writes_its_files(log, tmp_path, capsys):
    paths = [str(path) for path in log.runs]
    assert safedpa.run(["diagnose", str(log.model), *paths, "--out", str(tmp_path)]) == 0
    reported = capsys.readouterr().out
    assert "The model lacks quadratic_drag" in reported
    assert "quadratic_drag: coefficient 0.1" in reported
    assert "given model" in reported
    assert json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))["added"] == ["quadratic_drag"]
    for name in ("report.html", "diagnosis.rrd"):
        assert (tmp_path / name).stat().st_size > 1000
    model = load_model(str(tmp_path / "model.toml"))
    assert abs(model.settings["quadratic_drag.coefficient"].value - 0.12) < 0.005


def test_json_prints_only_the_report(log, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("safedpa.diagnosis.diagnose.library_for", lambda _: [effect("car", "quadratic_drag")])
    assert safedpa.run(["diagnose", str(log.model), str(log.runs[0]), "--json", "--out", str(tmp_path)]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["robot"] == "car"
    margin, model = tmp_path / "margin.toml", tmp_path / "model.toml"
    reported = document.pop("margin")
    assert reported.pop("period") == pytest.approx(0.05)
    assert reported == {"file": str(margin), "notice": "", "drive": f"safedpa up --model {model} --margin {margin}"}
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


def test_a_horizon_longer_than_the_log_is_refused(log):
    model = load_model(str(log.model))
    with pytest.raises(InputError, match="horizon"):
        diagnose(model, [load_run(str(log.runs[0]), model.system)], horizon=50.0)


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
        ["diagnose", "car", "five.csv", "--out", "new"], ["diagnose", "car", "five.csv", "--check"],
        ["rehearse", "car", "five.csv"], ["add", "car", "drive_lag", "five.csv", "--out", "new.toml"],
    ],
    ids=["diagnose", "check", "rehearse", "add"],
)  # fmt: skip
def test_five_rows_are_refused_as_too_few_without_asking_for_another_horizon(arguments, here, capsys):
    text = refused(arguments, capsys)
    assert "lasts 0.2 s" in text
    assert "record 5 s" in text
    assert "choose a shorter horizon" not in text
    assert not list(here.glob("new*"))


def test_a_stationary_car_is_reported_without_a_fit_or_nan(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "nothing to fit" in refused(["add", "car", "drive_lag", "still.csv", "--out", "new.toml"], capsys)
    assert not (here / "new.toml").exists()
    assert safedpa.run(["diagnose", "car", "still.csv", "--check"]) == 0
    assert "data: no state ever changes" in capsys.readouterr().out
    assert safedpa.run(["diagnose", "car", "still.csv", "--out", "new"]) == 0
    assert "nan times" not in capsys.readouterr().out


@pytest.mark.parametrize("command", [["add", "car", "drive_lag"], ["predict", "car"]], ids=["add", "predict"])
def test_a_folder_is_refused_as_the_file_to_write(command, here, capsys):
    text = refused([*command, "good.csv", "--horizon", "1", "--out", str(here)], capsys)
    assert "is a folder; name the file" in text


def test_a_recording_given_twice_counts_once_and_is_reported(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (here / "link.csv").symlink_to("good.csv")
    documents = []
    for runs in (["good.csv"], ["good.csv", "link.csv"]):
        assert safedpa.run(["compare", "car", *runs, "--out", "new", "--json", "--force"]) == 0
        documents.append(json.loads(capsys.readouterr().out))
    assert "is an earlier result; choose another folder" in refused(
        ["compare", "car", "good.csv", "--out", "new"], capsys
    )
    once, twice = documents
    assert (twice["windows"], twice["error"]) == (once["windows"], once["error"])
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
        assert "time_unit" in [item.kind for item in load_run(tmp_path / "drive.csv", CAR).findings]


@pytest.mark.parametrize("rows", [0, 1, 4])
def test_too_few_rows_are_refused_with_the_number_wanted(tmp_path: Path, rows: int) -> None:
    (tmp_path / "drive.csv").write_text(table(rows))
    with pytest.raises(InputError, match="wanted at least 5 consecutive rows"):
        load_run(tmp_path / "drive.csv", CAR)


@pytest.mark.parametrize(
    ("variable", "notice"),
    [
        (Variable("heading", "deg", -360.0, 360.0, angle=True), "got an angle in 'deg', wanted 'rad'"),
        (Variable("speed", "m/s", 5.0, -5.0), "got bounds 5 to -5"),
        (Variable("speed", "m/s", float("nan"), 5.0), "got bounds nan to 5"),
    ],
)
def test_a_system_with_wrong_units_or_bounds_is_refused(variable: Variable, notice: str) -> None:
    with pytest.raises(InputError, match=notice):
        add_system(System("odd_one", (variable,), ()))


@pytest.fixture
def in_use(log, tmp_path, monkeypatch):
    """The current folder, with ``model.toml`` and ``run.csv`` in it."""
    shutil.copy(log.model, tmp_path / "model.toml")
    shutil.copy(log.runs[0], tmp_path / "run.csv")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("safedpa.diagnosis.diagnose.library_for", lambda _: [effect("car", "quadratic_drag")])
    return tmp_path


@pytest.mark.long
@pytest.mark.parametrize("command", ["compare", "diagnose"])
def test_without_out_a_new_folder_is_made(command, in_use, capsys):
    before = {path.name: path.read_bytes() for path in in_use.iterdir()}
    for _ in range(2):
        assert safedpa.run([command, "model.toml", "run.csv"]) == 0
    reported = capsys.readouterr().out
    assert {path.name: path.read_bytes() for path in in_use.iterdir() if path.is_file()} == before
    made = sorted(path.name for path in in_use.iterdir() if path.is_dir())
    assert len(made) == 2
    assert all(name.startswith(f"{command}-model-20") for name in made)
    assert all(name in reported for name in made)


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
    reported = capsys.readouterr().err
    assert "is an input of this command" in reported
    assert reported.count("\n") == 1
    assert {path.name: path.read_bytes() for path in in_use.iterdir()} == before


def test_force_replaces_it(in_use):
    before = (in_use / "model.toml").read_bytes()
    arguments = ["add", "model.toml", "quadratic_drag", "run.csv", "--out", "model.toml"]
    assert safedpa.run([*arguments, "--force"]) == 0
    assert (in_use / "model.toml").read_bytes() != before


def test_a_folder_that_does_not_exist_is_refused_or_made_on_request(tmp_path: Path) -> None:
    assert require_writable_folder(tmp_path) == tmp_path
    missing = tmp_path / "a" / "b"
    with pytest.raises(InputError, match=rf"^{missing}: is not an existing folder; create it, or choose another path"):
        require_writable_folder(missing)
    assert not missing.parent.exists()
    assert require_writable_folder(missing, create=True).is_dir()
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=r"file: is not an existing folder"):
        require_writable_folder(tmp_path / "file")


@pytest.mark.parametrize("lacking", [os.W_OK, os.X_OK])
def test_a_folder_without_write_or_search_permission_is_refused(lacking, tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda _, asked: not asked & lacking)
    with pytest.raises(InputError, match=rf"^{tmp_path}: is not writable; choose another path with --out"):
        require_writable_folder(tmp_path)
    monkeypatch.setattr(os, "access", lambda _, asked: not asked & os.R_OK)
    assert require_writable_folder(tmp_path) == tmp_path


def test_a_file_to_write_is_not_a_folder_and_its_folder_exists(tmp_path: Path) -> None:
    assert require_writable_file(tmp_path / "a.csv") == tmp_path / "a.csv"
    with pytest.raises(InputError, match=rf"^{tmp_path}: is a folder; name the file to write with --out"):
        require_writable_file(tmp_path)
    with pytest.raises(InputError, match="is not an existing folder"):
        require_writable_file(tmp_path / "none" / "a.csv")


@pytest.mark.parametrize("written", [False, True])
@pytest.mark.parametrize(
    ("there", "left"), [("", []), ("a", ["a"]), ("a/b", ["a", "a/b"]), ("a/b/c", ["a", "a/b", "a/b/c"])]
)
def test_a_command_that_fails_removes_the_empty_folders_that_it_made_itself(there, left, written, tmp_path):
    (tmp_path / there).mkdir(parents=True, exist_ok=True)

    def work() -> None:
        with results_folder(tmp_path / "a" / "b", (), (), False) as folder:
            assert folder.is_dir()
            if written:
                (folder / "report.json").write_text("{}", encoding="utf-8")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        work()
    found = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*"))
    assert found == (sorted({*left, "a", "a/b", "a/b/report.json"}) if written else left)


def test_a_new_folder_is_named_by_the_second_and_counted_from_two(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    made: list[Any] = []
    for _ in range(3):
        made.append(new_folder("diagnose", "models/my_car.toml", datetime.datetime(2026, 1, 2, 3, 4, 5)))
        made[-1].mkdir()
    first = "diagnose-my_car-2026-01-02-030405"
    assert [str(path) for path in made] == [first, f"{first}-2", f"{first}-3"]


@pytest.fixture
def few(monkeypatch):
    """What comes nearest; the rest of the library takes time and changes nothing."""
    names = ("quadratic_drag", "viscous_drag")
    monkeypatch.setattr("safedpa.diagnosis.diagnose.library_for", lambda _: [effect("car", name) for name in names])


def changed(log, folder, change, runs=2):
    """The log's runs with their tables changed: change(table by column name) in place."""
    paths = []
    for path in log.runs[:runs]:
        names = path.read_text(encoding="utf-8").splitlines()[0].split(",")
        table = dict(zip(names, np.loadtxt(path, delimiter=",", skiprows=1).T, strict=True))
        table = change(table) or table
        out = folder / path.name
        np.savetxt(out, np.column_stack(list(table.values())), delimiter=",", header=",".join(table), comments="")
        paths.append(str(out))
    return paths


def diagnosed(log, paths, folder, capsys):
    """(exit code, report or None, standard error)"""
    code = safedpa.run(["diagnose", str(log.model), *paths, "--out", str(folder), "--json"])
    shown = capsys.readouterr()
    return code, json.loads(shown.out) if shown.out else None, shown.err


TOO_LITTLE = ("too little to judge", "no input ever changes")


def swap(one, other):
    def change(table):
        table[one], table[other] = table[other], table[one]

    return change


def scale(factor, *names):
    def change(table):
        for name in names:
            table[name] = factor * table[name]

    return change


def constant(table):
    table["target_speed"][:], table["steer"][:] = 1.0, 0.1


@pytest.mark.long
@pytest.mark.parametrize(
    ("change", "notice"),
    [
        (lambda table: {name: values[:40] for name, values in table.items()}, "too little to judge"),
        (constant, "no input ever changes"), (swap("x", "y"), "x and y look swapped"), (swap("yaw", "speed"), "yaw"),
        (scale(-1.0, "steer"), "turns against steer"),
        (lambda table: table.update(steer=np.roll(table["steer"], 173)), "not turn as it is steered"),
        (scale(3.6, "speed"), "km/h"),
    ],
    ids=["two_seconds", "constant", "x_and_y", "yaw_and_speed", "steer_flipped", "steer_elsewhere", "km_per_hour"],
)  # fmt: skip
@pytest.mark.usefixtures("few")
def test_no_verdict_and_the_reason(change, notice, log, tmp_path, capsys):
    code, report, _ = diagnosed(log, changed(log, tmp_path, change), tmp_path, capsys)
    assert code == 0
    assert report["verdict"] == ("undecided" if notice in TOO_LITTLE else "unexplained")
    assert (report["added"], report["unexplained"]["depends_on"]) == ([], [])
    assert notice in report["unexplained"]["expression"]
    assert not (tmp_path / "margin.toml").exists()


@pytest.mark.parametrize(
    ("change", "notice"),
    [
        (scale(180.0 / np.pi, "steer"), "looks like degrees"), (scale(180.0 / np.pi, "yaw"), "read as degrees"),
        (swap("target_speed", "steer"), "steer reaches"), (scale(1000.0, "t"), "looks like ms, not seconds"),
    ],
    ids=["steer_in_degrees", "yaw_in_degrees", "actions_swapped", "milliseconds"],
)  # fmt: skip
@pytest.mark.usefixtures("few")
def test_unusable_recordings_are_one_line_and_exit_code_2(change, notice, log, tmp_path, capsys):
    code, report, error = diagnosed(log, changed(log, tmp_path, change), tmp_path, capsys)
    assert (code, report) == (2, None)
    assert notice in error
    assert error.count("\n") == 1


def teleport(table):
    table["x"][200:] += 3.0
    table["y"][200:] -= 2.0


def lost(table):
    for name in ("x", "y", "yaw", "speed"):
        table[name][100] = np.nan


@pytest.mark.long
@pytest.mark.parametrize(("change", "kind"), [(teleport, "jump"), (lost, "not_a_number")], ids=["teleport", "nan_row"])
@pytest.mark.usefixtures("few")
def test_a_defect_is_cut_and_reported_and_does_not_change_the_answer(change, kind, log, tmp_path, capsys):
    code, report, _ = diagnosed(log, changed(log, tmp_path, change), tmp_path, capsys)
    assert (code, report["added"]) == (0, ["quadratic_drag"])
    assert abs(report["parameters"]["quadratic_drag.coefficient"]["value"] - 0.12) < 0.01
    assert kind in {item["kind"] for item in report["data_quality"]}
