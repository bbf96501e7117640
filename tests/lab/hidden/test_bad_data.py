"""Each of twenty bad files is noticed with the right sentence, and nothing is named because of it."""

import json
from dataclasses import replace

import pytest

from safedpa.diagnosis.diagnose import diagnose
from safedpa.dynamics import load_model
from safedpa.effects import effect
from safedpa.errors import RunError
from safedpa.records import load_run
from safedpa.records.column_map.file import parse_column_map
from safedpa_lab.experiments.diagnosis.hidden_effects import run_cases
from safedpa_lab.hidden import Case, cases_of, write_case
from safedpa_lab.hidden.bad_data import BAD, write_bad_files
from safedpa_services.command_line.group import safedpa

LIBRARY = ("understeer", "rolling_resistance", "drive_dead_zone", "drive_delay", "viscous_drag")


@pytest.fixture(scope="module", params=["speed_servo", "throttle"])
def good(request, tmp_path_factory):
    """Logs of a car in which nothing is hidden, and the bad files made from the first."""
    folder = tmp_path_factory.mktemp(request.param)
    log = write_case(Case("test", 11, {}, drive=request.param, runs=2, seconds=40.0), folder)
    return log, write_bad_files(log.runs[0], folder / "bad")


@pytest.mark.long
def test_an_export_with_text_columns_is_spoiled_as_well(good, tmp_path):
    log, files = good
    lines = log.runs[0].read_text(encoding="utf-8").splitlines()
    export = tmp_path / "drive.csv"
    export.write_text("\n".join([f"{lines[0]},status", *(f"{line},passed" for line in lines[1:])]), encoding="utf-8")
    assert {name: path.read_text() for name, path in write_bad_files(export, tmp_path / "bad").items()} == {
        name: path.read_text() for name, path in files.items()
    }


def noticed(name, good):
    """(kinds, sentences) of the messages about a bad file; None for kinds where it is refused."""
    log, files = good
    model = load_model(log.model)
    try:
        runs = [load_run(files[name], model.system)]
    except RunError as error:
        return None, str(error)
    if BAD[name].kind == "same_recording":
        report = diagnose(model, [load_run(log.runs[0], model.system), *runs])
        return [item["kind"] for item in report.data_quality], " ".join(i["message"] for i in report.data_quality)
    return [item.kind for item in runs[0].findings], " ".join(item.message for item in runs[0].findings)


@pytest.mark.parametrize("name", BAD)
def test_each_is_noticed_with_the_right_sentence(name, good, monkeypatch):
    _, files = good
    if name not in files:
        pytest.skip("a car with a speed servo has no command of which 1 is all")
    monkeypatch.setattr("safedpa.diagnosis.diagnose.library_for", lambda _: [])
    kinds, notice = noticed(name, good)
    bad = BAD[name]
    assert bad.notice in notice
    if bad.kind == "refused":
        assert kinds is None
        assert notice.count("\n") == 0
    else:
        assert bad.kind in kinds


def test_a_good_log_is_left_alone(good):
    log, _ = good
    model = load_model(log.model)
    for path in log.runs:
        run = load_run(path, model.system)
        assert ([item.kind for item in run.findings], len(run.stretches)) == ([], 1)


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("name", ["frozen_speed", "dead_steer", "drive_flipped", "speed_late", "two_rates"])
def test_no_effect_is_named_because_of_it(name, good, monkeypatch):
    log, files = good
    model = load_model(log.model)
    own = [item for item in LIBRARY if set(effect("car", item).needs) <= set(model.system.action_names)]
    monkeypatch.setattr("safedpa.diagnosis.diagnose.library_for", lambda _: [effect("car", item) for item in own])
    runs = [load_run(path, model.system) for path in (files[name], log.runs[1])]
    report = diagnose(model, runs)
    assert report.added == ()
    severe = name in ("drive_flipped", "speed_late")
    assert report.verdict == ("unexplained" if severe else "nothing_missing")


def mapped(model, head="", **columns):
    """A column map of the names as they are, but for the columns that are given."""
    names = ("t", *model.system.state_names, *model.system.action_names)
    lines = "\n".join(f"{name} = {columns.get(name, json.dumps(name))}" for name in names)
    return parse_column_map(f'format = 1\nrobot = "car"\n{head}\n[columns]\n{lines}\n')


def test_what_comes_late_is_aligned_and_what_was_cut_is_kept_on_request(good):
    log, files = good
    model = load_model(log.model)
    late = mapped(model, speed='{ from = "speed", shift = 0.3 }')
    assert "time_offset" not in {item.kind for item in load_run(files["speed_late"], model.system, late).findings}
    keep = mapped(model, 'keep = ["frozen"]')
    cut, retained = (load_run(files["frozen_speed"], model.system, item) for item in (None, keep))
    assert len(cut.t) < len(retained.t)
    assert any("kept, as the map says" in item.message for item in retained.findings)


def test_the_command_writes_them(good, tmp_path, capsys):
    log, _ = good
    assert safedpa.run(["experiment", "bad-data", str(log.runs[0]), "--out", str(tmp_path / "bad")]) == 0
    reported = capsys.readouterr().out
    assert len(list((tmp_path / "bad").iterdir())) >= 19
    assert all(path.stem in reported for path in (tmp_path / "bad").iterdir())
    assert safedpa.run(["experiment", "bad-data", str(log.runs[0]), "--out", str(tmp_path / "reported"), "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["files"]
    assert {row["file"] for row in rows} == {str(path) for path in (tmp_path / "reported").iterdir()}
    assert all(row["kind"] and row["notice"] for row in rows)


def test_a_suite_has_each_fault_in_one_run_of_three_where_nothing_is_hidden():
    cases = cases_of("bad", 20, seed=1)
    assert {case.fault for case in cases} == set(BAD)
    assert len(BAD) == 20
    assert all(not case.effects and case.runs == 3 for case in cases)


def test_a_file_that_is_refused_names_nothing():
    (case,) = (case for case in cases_of("bad", 20, seed=1) if case.fault == "milliseconds")
    (outcome,) = run_cases([replace(case, seconds=20.0)])
    assert (outcome.verdict, outcome.added, outcome.right) == ("refused", (), True)


def test_the_copy_is_written_next_to_the_log(tmp_path):
    (case,) = (case for case in cases_of("bad", 20, seed=1) if case.fault == "same_twice")
    assert len(write_case(replace(case, seconds=20.0), tmp_path).runs) == 4
