"""``safedpa diagnose`` and ``safedpa add`` as a person runs them, and bad data."""

from __future__ import annotations

import json

import numpy as np
import pytest

from safedpa.diagnosis.diagnose import diagnose
from safedpa.dynamics import load_model
from safedpa.effects import effect
from safedpa.errors import InputError
from safedpa.records import load_run
from safedpa.records.run import Run, Stretch
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
