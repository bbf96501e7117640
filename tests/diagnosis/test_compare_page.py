"""The page, its JSON and the two commands, as a person and a program meet them."""

from __future__ import annotations

import csv
import json
import os
import re
from dataclasses import replace

import numpy as np
import pytest

from safedpa.compare.comparison import compare_model, with_distinct_names
from safedpa.compare.summary import as_json
from safedpa.dynamics import load_model, save_model
from safedpa.records import write_csv
from safedpa.records.run import Finding, Run, Stretch
from safedpa.report.comparison_figures import time_figure
from safedpa.report.comparison_page import compare_page
from safedpa.report.overlays import chosen_windows, overlay_figures
from safedpa_services.command_line.group import safedpa


@pytest.fixture
def files(plain, with_effect, drive, tmp_path):
    """(model file, two run files): a plain model and runs with drag."""
    truth = with_effect(plain, "quadratic_drag", coefficient=0.2)
    save_model(plain, tmp_path / "plain.toml")
    paths = []
    for seed in (1, 2):
        paths.append(tmp_path / f"run_{seed}.csv")
        write_csv(drive(truth, 30.0, seed=seed), paths[-1])
    return str(tmp_path / "plain.toml"), [str(path) for path in paths]


def _run(*arguments):
    return safedpa.run([str(argument) for argument in arguments])


def _bad(capsys, *arguments):
    """Exit code 2 and one line; returns the line."""
    assert _run(*arguments) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.count("\n") == 1
    return shown.err


def test_predict_writes_the_table_of_the_contract(files, tmp_path, capsys):
    model, (path, _) = files
    out = tmp_path / "out.csv"
    assert _run("predict", model, path, "--horizon", 0.5, "--out", out) == 0
    assert capsys.readouterr().out == ""
    with out.open() as file:
        header, *lines = list(csv.reader(file))
    assert header == ["start_t", "t", "x", "y", "yaw", "speed"]
    table = np.array(lines, dtype=float)
    measured = np.genfromtxt(path, delimiter=",", names=True)
    starts = measured["t"][:-1:10]
    np.testing.assert_array_equal(np.unique(table[:, 0]), starts)
    for start in starts:
        own = table[table[:, 0] == start]
        later = measured["t"][(measured["t"] > start) & (measured["t"] <= start + 0.525)]
        np.testing.assert_array_equal(own[:, 1], later)
    loaded = load_model(model)
    names = ("x", "y", "yaw", "speed")
    state = np.array([measured[name][10] for name in names])
    for row in range(10, 20):
        action = np.array([measured["throttle"][row], measured["steer"][row]])
        period = float(measured["t"][row + 1] - measured["t"][row])
        state, _ = loaded.advance(state, action, (), period=period)
        shown = table[(table[:, 0] == measured["t"][10]) & (table[:, 1] == measured["t"][row + 1])][0, 2:]
        np.testing.assert_allclose(shown, state, atol=1e-9)


def test_compare_prints_one_document(files, tmp_path, capsys):
    model, paths = files
    assert _run("compare", model, *paths, "--horizon", 0.8, "--out", tmp_path / "new" / "folder", "--json") == 0
    shown = capsys.readouterr()
    assert shown.err == ""
    document = json.loads(shown.out)
    assert document == json.loads((tmp_path / "new" / "folder" / "compare.json").read_text())
    assert {
        "format", "robot", "effects", "parameters", "horizon", "windows", "summary", "error", "per_state", "scale",
        "naive", "horizons", "where", "explained", "place", "runs", "data_quality",
    } == set(document)  # fmt: skip
    assert document["robot"] == "car"
    assert document["horizon"] == 0.8
    assert document["parameters"] == {"base.wheelbase": 0.3, "base.drive_gain": 3.0, "base.tracked_point": 0.0}
    assert document["per_state"].keys() == {"x", "y", "yaw", "speed"}
    assert document["error"] == pytest.approx(np.mean(list(document["per_state"].values())))
    assert document["naive"].keys() == {"no_change", "constant_velocity"}
    assert document["horizons"][-1]["model"]["error"] == document["error"]
    assert {item["variable"] for item in document["where"]} == {"x", "y", "yaw", "speed", "throttle", "steer", "time"}
    for item in document["where"]:
        assert {"variable", "unit", "low", "high", "error", "ratio", "share", "samples", "bias"} <= set(item)
        assert ("run" in item) == (item["variable"] == "time")
    assert [run["name"] for run in document["runs"]] == ["run_1", "run_2"]
    assert document["error"] < document["naive"]["no_change"]["error"]


def test_compare_prints_a_readable_page_width(files, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    model, paths = files
    assert _run("compare", model, *paths, "--out", tmp_path) == 0
    shown = capsys.readouterr()
    assert shown.err == ""
    assert "The model fails most at speed" in " ".join(shown.out.split())
    for text in ("no change", "constant velocity", "Where it is worst", "Data quality", "compare.html"):
        assert text in shown.out
    assert max(map(len, shown.out.split("Page:")[0].splitlines())) <= 80


def test_page_asks_no_other_host(files, tmp_path):
    model, paths = files
    assert _run("compare", model, *paths, "--out", tmp_path, "--json") == 0
    text = (tmp_path / "compare.html").read_text()
    assert len(text) < 6e6
    assert re.search(r"<(script|img|link|iframe|source)[^>]+(src|href)\s*=", text.replace("\n", " ")[:20000]) is None
    own = text[: text.index("plotly.js v")] + text[text.index('<script type="application/json"') :]
    assert "http://" not in own
    assert "https://" not in own
    assert "default-src 'none'" in own
    data = json.loads(re.search(r'id="data">(.*?)</script>', text, re.S).group(1))
    assert [figure["id"] for figure in data["figures"]] == ["horizon", "where", "time", "place", "residuals"]
    for figure in data["figures"] + data["overlays"]:
        axes = {key: axis for key, axis in figure["layout"].items() if re.fullmatch(r"[xy]axis\d*", key)}
        assert axes
        assert all(axis["title"]["text"] for axis in axes.values())
        units = [axis["title"]["text"] for key, axis in axes.items() if key.startswith("x")]
        assert all(re.search(r"\[.+\]$", text) for text in units)
    labels = [figure["label"].split(":")[0] for figure in data["overlays"]]
    assert sorted(set(labels)) == ["95 % quantile", "best", "median", "worst"]


def test_page_escapes_what_comes_from_files(plain, drive):
    run = replace(drive(plain, 10.0), name="</script><b>x", findings=(Finding("jump", "<i>odd</i> & more"),))
    text = compare_page(compare_model(plain, [run]), "<model>")
    assert text.count("</script") == 4
    assert "</script><b>x" not in text
    assert "<i>odd" not in text
    assert "&lt;model&gt;" in text
    assert "&lt;i&gt;odd&lt;/i&gt; &amp; more" in text


def test_chosen_windows_go_from_worst_to_best(plain, with_effect, drive):
    truth = with_effect(plain, "understeer", gradient=0.05)
    comparison = compare_model(plain, [drive(truth, 60.0)])
    chosen = chosen_windows(comparison)
    errors = {kind: [comparison.window_errors[i] for k, i in chosen if k == kind] for kind, _ in chosen}
    assert list(errors) == ["worst", "95 % quantile", "median", "best"]
    assert min(errors["worst"]) >= max(errors["median"]) > max(errors["best"])
    assert errors["worst"][0] == comparison.window_errors.max()
    for kind in errors:
        starts = sorted(comparison.windows.t[comparison.windows.start[i]] for k, i in chosen if k == kind)
        assert (np.diff(starts) > comparison.horizon).all()
    for figure in overlay_figures(comparison):
        yaw = next(trace["y"] for trace in figure["data"] if trace["yaxis"] == "y2" and trace["name"] == "model")
        assert abs(yaw[0]) <= np.pi + 1e-3
    figure = overlay_figures(comparison)[0]
    measured = next(trace for trace in figure["data"] if trace["name"] == "measured")
    windows = comparison.windows
    end = windows.end[chosen[0][1]]
    assert measured["x"][-1] == pytest.approx(windows.states[end, 0], rel=1e-4, abs=1e-4)


def test_predictions_without_bound_are_reported(plain, with_effect, drive):
    """Numbers that are not finite become null in JSON, a finding in the list, and no warning."""
    wild = with_effect(plain, "quadratic_drag", coefficient=2.0)
    run = drive(plain, 20.0)
    states = run.states.copy()
    states[100:, 3] = 1e4
    comparison = compare_model(wild, [replace(run, states=states)], 1.0)
    assert "diverged" in [finding.kind for _, finding in comparison.findings]
    json.dumps(as_json(comparison), allow_nan=False)
    compare_page(comparison, "wild")


def test_a_run_in_which_nothing_happens_is_reported(plain, drive):
    run = drive(plain, 10.0)
    still = replace(run, states=np.tile(run.states[0], (len(run.t), 1)), actions=np.zeros_like(run.actions))
    comparison = compare_model(plain, [still])
    document = as_json(comparison)
    assert document["summary"][0].startswith("Nothing changes in these runs")
    assert document["error"] is None
    assert "constant_state" in [finding.kind for _, finding in comparison.findings]
    json.dumps(document, allow_nan=False)
    compare_page(comparison, "still")


def test_the_pendulum_has_a_page_without_a_place(tmp_path):
    model = load_model("dfki_pendulum")
    t = np.arange(400) * 0.01
    states = np.zeros((400, 2))
    states[0] = 2.0, 0.0
    for row in range(399):
        states[row + 1] = model.step(states[row], np.array([0.1])) if row < 200 else states[row]
    run = Run("swing", model.system, t, states, np.full((400, 1), 0.1), (Stretch(0, 200), Stretch(200, 400)))
    text = compare_page(compare_model(model, [run], 0.3), "pendulum")
    assert 'id="place"' not in text
    assert "angle [rad]" in text


def test_of_many_runs_the_worst_are_drawn_over_time(plain, with_effect, drive):
    good = [drive(plain, 6.0, seed=seed, name=f"good {seed}") for seed in range(8)]
    truth = with_effect(plain, "viscous_drag", coefficient=0.5)
    bad = [drive(truth, 6.0, seed=seed, name=f"bad {seed}") for seed in range(8)]
    comparison = compare_model(plain, good + bad)
    names = [note["text"] for note in time_figure(comparison)["layout"]["annotations"]]
    assert len(names) == 12
    assert {f"<b>bad {seed}</b>" for seed in range(8)} <= set(names)
    assert "here the 12 runs with the largest error" in compare_page(comparison, "many")


def test_short_and_uneven_runs_are_reported(plain, drive):
    runs = [drive(plain, 20.0, jitter=0.6, name="uneven"), drive(plain, 0.5, name="short")]
    kinds = {(run, finding.kind) for run, finding in compare_model(plain, runs).findings}
    assert kinds == {("uneven", "irregular_sampling"), ("short", "too_short")}
    json.dumps(as_json(compare_model(plain, runs)), allow_nan=False)


def test_names_tell_files_apart(plain, drive, tmp_path):
    run = drive(plain, 5.0)
    named = with_distinct_names([run, run], [tmp_path / "a" / "log.csv", tmp_path / "b" / "log.csv"])
    assert [item.name for item in named] == ["a", "b"]
    named = with_distinct_names([run, run], ["one.csv", "two.csv"])
    assert [item.name for item in named] == ["one", "two"]
    assert with_distinct_names([run], ["x/log.csv"])[0].name == "log"


@pytest.mark.parametrize("horizon", ["0", "-1", "nan", "inf", "1000", "0.001"])
def test_a_bad_horizon_is_one_line(files, tmp_path, capsys, horizon):
    model, paths = files
    assert "horizon" in _bad(capsys, "compare", model, *paths, "--horizon", horizon, "--out", tmp_path)
    out = tmp_path / "out.csv"
    assert "horizon" in _bad(capsys, "predict", model, paths[0], "--horizon", horizon, "--out", out)
    assert not out.exists()


def test_bad_input_is_one_line(files, tmp_path, capsys):
    model, paths = files
    blocked = tmp_path / "file"
    blocked.write_text("")
    assert "cannot be made a folder" in _bad(capsys, "compare", model, *paths, "--out", blocked / "inside")
    assert "no folder" in _bad(
        capsys, "predict", model, paths[0], "--horizon", 1, "--out", tmp_path / "nowhere" / "out.csv"
    )
    _bad(capsys, "compare", "dfki_pendulum", *paths, "--out", tmp_path)
    _bad(capsys, "compare", "car", *paths, "--out", tmp_path)
    _bad(capsys, "compare", model, tmp_path / "absent.csv", "--out", tmp_path)
    empty = tmp_path / "empty.csv"
    empty.write_text("t,x,y,yaw,speed,throttle,steer\n")
    _bad(capsys, "compare", model, empty, "--out", tmp_path)
    _bad(capsys, "compare", model, *paths, "--columns", "absent_map", "--out", tmp_path)
    assert not (tmp_path / "compare.html").exists()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission_is_one_line(files, tmp_path, capsys):
    model, paths = files
    closed = tmp_path / "closed"
    closed.mkdir(mode=0o500)
    assert "must not be written to" in _bad(capsys, "compare", model, *paths, "--out", closed)


def test_own_effects_are_loaded(files, tmp_path, capsys):
    model, paths = files
    own = tmp_path / "my_effects.py"
    own.write_text(
        "from safedpa.effects import Parameter, RateEffect, Stage\n"
        "class Magnet(RateEffect):\n"
        "    name, robot, stage = 'magnet_under_test', 'car', Stage.RESISTANCE\n"
        "    equation = signature = source = 'test'\n"
        "    parameters = (Parameter('pull', 'm/s2', 0.0, 5.0, 1.0),)\n"
        "    def modify(self, rates, parameters, context):\n"
        "        return {**rates, 'speed': rates['speed'] - parameters['pull']}\n"
    )
    with open(model, "a") as file:
        file.write("\n[[effects]]\nname = 'magnet_under_test'\npull = 2.0\n")
    assert "magnet_under_test" in _bad(capsys, "compare", model, *paths, "--out", tmp_path)
    assert _run("compare", model, *paths, "--out", tmp_path, "--json", "--effects", own) == 0
    assert json.loads(capsys.readouterr().out)["effects"] == ["magnet_under_test"]
