"""The pages of a comparison and of a diagnosis, and the sentences that stand on them."""

import csv
import json
import os
import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.comparison.comparison import PREDICTORS, HorizonError, PerRunError, compare_model, with_distinct_names
from safedpa.comparison.excerpt import first_seconds, subsample_runs
from safedpa.comparison.rollout_error import RolloutError, rollout_error
from safedpa.comparison.summary import (
    as_json,
    most_influential_factor,
    naive_sentence,
    run_sentence,
    state_sentence,
    where_sentence,
    worse_sentence,
    worst_bins,
)
from safedpa.comparison.where import Bin, Cell, Factor
from safedpa.comparison.windows import windows_of
from safedpa.dynamics import load_model, save_model
from safedpa.errors import RecordingError
from safedpa.records import write_csv
from safedpa.records.run import Finding, Run, Stretch
from safedpa.report.comparison_figures import time_figure
from safedpa.report.comparison_page import compare_page
from safedpa.report.diagnosis_page import before_after_figure, falling_figure, map_figure, report_page, write_report
from safedpa.report.diagnosis_recording import write_recording
from safedpa.report.diagnosis_story import parameters_text, report_text, step_text
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
    assert (shown.out, shown.err.count("\n")) == ("", 1)
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
    assert (document["robot"], document["horizon"]) == ("car", 0.8)
    assert document["parameters"] == {"base.wheelbase": 0.3, "base.drive_gain": 3.0, "base.tracked_point": 0.0}
    assert document["per_state"].keys() == {"x", "y", "yaw", "speed"}
    assert document["error"] == pytest.approx(np.mean(list(document["per_state"].values())))
    assert {item["variable"] for item in document["where"]} == {"x", "y", "yaw", "speed", "throttle", "steer", "time"}
    assert all(("run" in item) == (item["variable"] == "time") for item in document["where"])
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


def embedded(text):
    return json.loads(re.search(r'id="data">(.*?)</script>', text, re.S).group(1))


def asks_no_one(text):
    assert re.search(r"<(script|img|link|iframe|source)[^>]+(src|href)\s*=", text.replace("\n", " ")[:30000]) is None
    own = text[: text.index("plotly.js v")] + text[text.index('<script type="application/json"') :]
    assert not re.search("https?://", own)
    assert "default-src 'none'" in own


def test_comparison_page_loads_nothing_from_other_hosts(files, tmp_path):
    model, paths = files
    assert _run("compare", model, *paths, "--out", tmp_path, "--json") == 0
    text = (tmp_path / "compare.html").read_text()
    assert len(text) < 6e6
    asks_no_one(text)
    data = embedded(text)
    assert [figure["id"] for figure in data["figures"]] == ["horizon", "where", "time", "place", "residuals"]
    for figure in data["figures"] + data["overlays"]:
        axes = {key: axis for key, axis in figure["layout"].items() if re.fullmatch(r"[xy]axis\d*", key)}
        assert axes
        assert all(axis["title"]["text"] for axis in axes.values())
        units = [axis["title"]["text"] for key, axis in axes.items() if key.startswith("x")]
        assert all(re.search(r"\[.+\]$", text) for text in units)
    labels = [figure["label"].split(":")[0] for figure in data["overlays"]]
    assert sorted(set(labels)) == ["95 % quantile", "best", "median", "worst"]


def test_page_escapes_texts_from_files(plain, drive):
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
    assert measured["x"][-1] == pytest.approx(windows.states[windows.end[chosen[0][1]], 0], rel=1e-4, abs=1e-4)


def test_diverging_predictions_are_reported(plain, with_effect, drive):
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


def test_the_pendulum_page_has_no_position_figure(tmp_path):
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


def test_run_names_distinguish_files(plain, drive, tmp_path):
    run = drive(plain, 5.0)
    pairs = ([tmp_path / "a" / "log.csv", tmp_path / "b" / "log.csv"], ["one.csv", "two.csv"])
    named = [[item.name for item in with_distinct_names([run, run], pair)] for pair in pairs]
    assert named == [["a", "b"], ["one", "two"]]
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
    assert "cannot be created" in _bad(capsys, "compare", model, *paths, "--out", blocked / "inside")
    predict = ("predict", model, paths[0], "--horizon", 1, "--out", tmp_path / "nowhere" / "out.csv")
    assert "is not an existing folder" in _bad(capsys, *predict)
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
    assert "is not writable" in _bad(capsys, "compare", model, *paths, "--out", closed)


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


def candidate(stage, name, error, decision="rejected", **more):
    return {
        "stage": stage, "effect": name, "parameters": {"coefficient": {"value": 0.2, "std": 0.004, "unit": "1/m"}},
        "heldout_error": error, "score": 5.0, "indistinguishable_from": [], "decision": decision,
        "reason": f"{name} does what it does",
    } | more  # fmt: skip


@pytest.fixture
def diagnosed(plain, with_effect, drive):
    """(document, runs, models): quadratic drag was missing and was found, steering lag as well."""
    drag = with_effect(plain, "quadratic_drag", coefficient=0.2)
    both = with_effect(drag, "steering_lag", time_constant=0.2)
    runs = [replace(drive(both, 30.0, seed=seed), name=f"run {seed}") for seed in (1, 2)]
    runs[0] = replace(runs[0], findings=(Finding("jump", "x jumped <once> & was cut"),))
    names, models = ["quadratic_drag", "steering_lag"], [plain, drag, both]
    stages = []
    for number, model in enumerate(models):
        error = rollout_error(model, windows_of(runs, 1.0))
        per_state = dict(zip(plain.system.state_names, error.per_state.tolist(), strict=True))
        own = {"effects": names[:number], "heldout_error": error.value, "per_state": per_state}
        stages.append({**own, "runs_improved": "2/2" if number else ""})
    errors = [stage["heldout_error"] for stage in stages]
    document = {
        "format": 1, "robot": "car", "verdict": "effect_missing", "added": names, "stages": stages,
        "candidates": [
            candidate(0, names[0], errors[1], "accepted", indistinguishable_from=["viscous_drag"]),
            candidate(0, "viscous_drag", errors[1] * 1.01, "suspected", indistinguishable_from=[names[0]]),
            *[candidate(0, f"other_{number}", errors[0]) for number in range(8)],
            candidate(1, names[1], errors[2], "accepted"),
            candidate(1, "other_1", None, score=None),
            candidate(2, "other_2", errors[2]),
        ],
        "where": [{"variable": "speed", "low": 2.0, "high": 3.0, "error": 0.4, "share": 0.4, "samples": 12}],
        "unexplained": {"depends_on": ["x", "y"], "expression": "speed' = -0.3 [x > 1]", "share": 0.42},
        "next_experiment": {"manoeuvre": "Coast down", "separates": ["a", "b"], "why": "They differ there"},
        "data_quality": [{"run": "run 1", "kind": "jump", "message": "x jumped <once> & was cut"}],
    }  # fmt: skip
    return document, runs, models


def test_the_page_contains_all_sentences_and_tables(diagnosed, tmp_path):
    document, runs, models = diagnosed
    path = write_report(document, runs, models, tmp_path, "my model")
    text = path.read_text(encoding="utf-8")
    phrase = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", text[: text.index("plotly.js v")]))
    assert path.name == "report.html"
    first, last = document["stages"][0]["heldout_error"], document["stages"][-1]["heldout_error"]
    for expected in (
        f"The model lacks quadratic_drag and steering_lag. With them the error on data that was not used for fitting "
        f"falls from {first:.3g} to {last:.3g}, by {100 * (1 - last / first):.0f} %.",
        "42 % of the residual depends on x and y",
        "What is missing besides quadratic_drag?",
        "coefficient 0.200 ± 0.004 1/m",
        "quadratic_drag (accepted) and viscous_drag",
        "4 more candidates",
        "Quadratic_drag does what it does. Cannot be distinguished from viscous_drag.",
        "Coast down It separates a from b. They differ there",
        "It is a formula that fits, not a physical effect",
        "x jumped &lt;once&gt; &amp; was cut",
    ):
        assert expected in phrase
    assert [figure["id"] for figure in embedded(text)["figures"]] == ["falling", "where", "residuals", "maps"]
    for figure in embedded(text)["figures"]:
        assert f'id="{figure["id"]}"' in text


def test_diagnosis_page_loads_nothing_from_other_hosts(diagnosed):
    document, runs, models = diagnosed
    text = report_page({**document, "added": ["</script><b>x", "y"]}, runs, models, "<model>")
    assert len(text) < 6e6
    asks_no_one(text)
    assert text.count("</script") == 4
    assert "&lt;model&gt;" in text


def test_the_error_bars_decrease_with_each_stage(diagnosed):
    document, _, _ = diagnosed
    bars = [trace for trace in falling_figure(document)["data"] if trace["type"] == "bar"]
    assert len(bars) == 5
    assert bars[0]["y"] == sorted(bars[0]["y"], reverse=True)
    np.testing.assert_allclose(bars[0]["y"], [stage["heldout_error"] for stage in document["stages"]], rtol=1e-4)
    shown = [trace["text"][0] for trace in falling_figure(document)["data"] if trace.get("mode") == "text"]
    first, last = document["stages"][0]["heldout_error"], document["stages"][-1]["heldout_error"]
    assert f"−{100 * (1 - last / first):.0f} %" in shown[2]


def test_figures_show_less_error_after(diagnosed):
    _, runs, models = diagnosed
    before, after = compare_model(models[0], runs), compare_model(models[-1], runs)
    for figure in (before_after_figure(before, after), map_figure(before, after)):
        traces = [trace for trace in figure["data"] if trace["type"] in ("bar", "heatmap")]
        half = len(traces) // 2
        pairs = zip(traces[:half], traces[half:], strict=True)
        if traces[0]["type"] == "bar":
            pairs = zip(traces[::2], traces[1::2], strict=True)
        for one, other in pairs:
            old, new = (np.array(item.get("z", item["y"]), dtype=float) for item in (one, other))
            assert old.shape == new.shape
            assert np.nanmean(new) < 0.2 * np.nanmean(old)
    heat = [trace for trace in map_figure(before, after)["data"] if trace["type"] == "heatmap"]
    assert len({trace["zmax"] for trace in heat}) == 1
    assert [trace["showscale"] for trace in heat] == [True, *[False] * (len(heat) - 1)]


def test_nothing_missing_is_a_page_too(diagnosed):
    document, runs, models = diagnosed
    bare = {
        **document, "verdict": "nothing_missing", "added": [], "stages": document["stages"][:1], "unexplained": None,
        "candidates": [candidate(0, "viscous_drag", document["stages"][0]["heldout_error"])], "next_experiment": None,
        "data_quality": [],
    }  # fmt: skip
    text = report_page(bare, runs, models[:1], "complete")
    for expected in ("Nothing is missing", "None is needed", "All rows were used", "What does the given model lack?"):
        assert expected in text
    assert "Missing effects" not in text
    assert "after" not in {trace.get("name") for trace in embedded(text)["overlays"][0]["data"]}
    unexplained = {**bare, "verdict": "unexplained", "unexplained": document["unexplained"]}
    assert "none of the 0 effects tried explains it" in report_text(unexplained).lead


def test_a_stage_lists_what_it_changed():
    names = [["drag"], ["drag", "lag", "offset"], ["lag", "offset"], ["lag", "offset"]]
    stages = [{"effects": effects} for effects in names]
    reported = [step_text(before, stage) for before, stage in zip([None, *stages], stages, strict=False)]
    assert reported == ["given model", "+ lag + offset", "− drag", "refitted"]


def test_values_that_are_not_finite_leave_gaps(diagnosed):
    document, runs, models = diagnosed
    stages = [{**document["stages"][0], "heldout_error": None, "per_state": {"x": None, "y": 1.0}}]
    lost = candidate(0, "drag", None, parameters={"coefficient": {"value": None, "std": None, "unit": "1/m"}})
    broken = {**document, "stages": stages, "added": [], "candidates": [lost], "verdict": "unexplained"}
    assert "coefficient nan 1/m" in report_page(broken, runs, models[:1], "broken")


def test_the_page_shows_the_parameters_of_the_last_fit(diagnosed):
    document, _, _ = diagnosed
    last = {"quadratic_drag.coefficient": {"value": 0.19, "std": 0.002, "unit": "1/m"}}
    found = report_text({**document, "parameters": last}).found
    assert found[0].parameters == [("coefficient", "0.190", "0.002", "1/m")]
    assert found[1].parameters == [("coefficient", "0.200", "0.004", "1/m")]


def test_parameters_are_written_with_deviation_and_unit():
    entry = {"value": 0.1234, "std": None, "unit": "1"}
    angle = {"value": -2.0, "std": 0.01, "unit": "rad"}
    assert parameters_text({"gain": entry, "angle": angle}) == "gain 0.1234, angle -2.00 ± 0.01 rad"


def test_a_pendulum_has_a_page_and_a_recording_without_a_plane(tmp_path):
    model = load_model("dfki_pendulum")
    states = np.zeros((600, 2))
    states[0] = 2.0, 0.0
    torque = 0.4 * np.sin(0.05 * np.arange(600))[:, None]
    for row in range(599):
        states[row + 1] = model.step(states[row], torque[row])
    t = np.arange(600) * 0.005
    run = Run("swing", model.system, t, states, torque, (Stretch(0, 600),))
    stage = {"effects": [], "heldout_error": 0.5, "per_state": {"angle": 0.5, "rate": 0.5}, "runs_improved": ""}
    document = {
        "verdict": "nothing_missing", "added": [], "stages": [stage], "candidates": [], "where": [], "horizon": 0.5,
        "unexplained": None, "next_experiment": None, "data_quality": [],
    }  # fmt: skip
    assert "angle [rad]" in report_page(document, [run], [model], "pendulum")
    assert write_recording(document, [run], [model], tmp_path).stat().st_size > 1000


def test_the_recording_plays_the_stages_in_order(diagnosed, tmp_path):
    document, runs, models = diagnosed
    path = write_recording(document, runs, models, tmp_path)
    assert path.name == "diagnosis.rrd"
    content = path.read_bytes()
    assert len(content) < 5e6
    for name in ("plane/measured", "plane/predicted", "plane/robot", "states/speed/measured", "story", "error"):
        assert f"/{name}".encode() in content
    given, improved = (_rows(path, f"/states/speed/{kind}") for kind in ("given", "improved"))
    assert 0 < given < improved


def _rows(path, ending):
    """How many rows a recording holds of the entities that end so, however its writer batched them."""
    from rerun.chunk import RrdReader

    chunks = list(RrdReader(path).stream())
    return sum(chunk.num_rows for chunk in chunks if str(chunk.entity_path).endswith(ending))


def test_long_logs_are_shown_in_part(diagnosed, monkeypatch):
    document, runs, models = diagnosed
    long = replace(runs[1], stretches=(Stretch(0, 250), Stretch(260, 600)))
    shown = subsample_runs([runs[0], long], 300)
    assert [run.stretches[0].start for run in shown] == [0, 0]
    assert 200 <= sum(len(part) for run in shown for part in run.stretches) <= 400
    assert subsample_runs(runs, 1200) == runs
    slow = subsample_runs([replace(runs[0], t=10.0 * runs[0].t)], 150)[0]
    assert [(part.start, part.stop) for part in slow.stretches] == [(start, start + 20) for start in range(0, 600, 80)]
    far = subsample_runs([replace(runs[0], t=10.0 * runs[0].t)], 150, horizon=20.0)[0]
    assert {len(part) for part in far.stretches} == {120}
    many = subsample_runs(runs * 50, 600)
    assert len(many) < 10
    assert 500 <= sum(len(part) for run in many for part in run.stretches) <= 1200
    heading = first_seconds([long], 13.52)[0]
    assert [(part.start, part.stop) for part in heading.stretches] == [(0, 250), (260, 271)]
    monkeypatch.setattr(
        "safedpa.report.diagnosis_page.subsample_runs", lambda runs, _, horizon: subsample_runs(runs, 600, horizon)
    )
    assert "excerpt of 25 % of the recordings" in report_page(document, runs * 2, models, "long")


def test_a_recording_that_cannot_be_written_raises_an_error(diagnosed, tmp_path):
    document, runs, models = diagnosed
    with pytest.raises(RecordingError):
        write_recording(document, runs, models, tmp_path / "absent" / "folder")


def test_open_questions_are_on_the_page(diagnosed):
    document, runs, models = diagnosed
    number = {"value": 0.31, "std": 0.1, "unit": "1/s"}
    near = {
        "effect": "viscous_drag", "parameters": {"viscous_drag.coefficient": number}, "heldout_fall": 0.24,
        "score": 2.1, "smallest_detectable": {}, "drive": "coast down", "reason": "likely, not proven",
    }  # fmt: skip
    size = {
        "effect": "payload", "parameter": "mass_ratio", "unit": "1", "smallest": None, "ordinary": 0.3,
        "only_with": ["base.speed_gain"], "drive": "weigh it",
    }  # fmt: skip
    lost = {"stage": 1, "run": "drive 2", "state": "yaw", "before": 0.2, "after": 0.5}
    opened = {
        **document, "verdict": "undecided", "added": [], "stages": document["stages"][:1], "candidates": [],
        "unexplained": None, "closest": [near], "detectable": [size], "worse": [lost],
    }  # fmt: skip
    text = report_page(opened, runs, models[:1], "open")
    for expected in (
        "Undecided: not enough data to decide", "viscous_drag", "24 %", "coast down", "not detectable",
        "only as a sum with base.speed_gain", "yaw in drive 2 (0.2 to 0.5)",
    ):  # fmt: skip
        assert expected in text


def factor(variable: str, kind: str, explained: float, *errors: float) -> Factor:
    bins = (Bin(variable, "m/s", 0.0, 1.0, error, error / 0.5, 0.25, 3, {"x": 0.125}, None) for error in errors)
    return Factor(variable, "m/s", kind, explained, tuple(bins))


def run_error(name: str, **errors: float) -> PerRunError:
    values: dict[str, Any] = dict.fromkeys(PerRunError.__dataclass_fields__, 0.0)
    values |= {"name": name, "per_state": errors, "no_change": dict.fromkeys(errors, 1.0)}
    return PerRunError(**values)


def errors_of(*values: float) -> dict[str, RolloutError]:
    return {
        name: RolloutError(value, np.array([value, 2.0 * value]), np.array([0.5, 4.0]))
        for name, value in zip(PREDICTORS, values, strict=True)
    }


def comparison(**changes: Any) -> Any:
    variables = tuple(SimpleNamespace(name=name, unit="m") for name in ("x", "y"))
    system = SimpleNamespace(name="cart", state_names=("x", "y"), state=variables)
    windows = type("Windows", (), {"horizon": 1.0, "system": system, "__len__": lambda _: 60})()
    horizons = (HorizonError(0.5, errors_of(0.25, 0.75, 1.5)), HorizonError(1.0, errors_of(0.5, 1.0, 2.0)))
    usual: dict[str, Any] = {
        "model": SimpleNamespace(
            effects=(SimpleNamespace(name="drag"), SimpleNamespace(name="tow")),
            settings={"base.a": SimpleNamespace(value=1.0), "drag.c": SimpleNamespace(value=2.0)},
        ),
        "windows": windows, "horizons": horizons, "horizon": 1.0, "error": horizons[-1].errors["model"],
        "errors": np.array([[0.1, -0.5], [0.2, -0.25], [0.3, -2.0]]),
        "factors": (factor("speed", "state", 0.5, 0.75, 2.0), factor("u", "action", 0.25, 1.0, 0.25, 1.5),
                    factor("x", "position", 0.125, 3.0)),
        "cells": (Cell(0.0, 1.0, 2.0, 3.0, 0.5, 0.25, 7), Cell(1.0, 2.0, 2.0, 3.0, np.inf, 0.75, 5)),
        "runs": (run_error("a", x=0.25, y=0.5), run_error("b", x=0.25, y=0.25), run_error("c", x=2.0, y=0.5)),
        "findings": (("a", Finding("gap", "a gap", 2)), ("c", Finding("jump", "a jump", 3))),
    }  # fmt: skip
    return SimpleNamespace(**usual | changes)


def test_the_document_holds_everything_that_was_found() -> None:
    found = comparison()
    document = as_json(found)
    assert {key: document[key] for key in ("format", "robot", "effects", "parameters", "horizon", "windows")} == {
        "format": 1, "robot": "cart", "effects": ["drag", "tow"], "parameters": {"base.a": 1.0, "drag.c": 2.0},
        "horizon": 1.0, "windows": 60,
    }  # fmt: skip
    sentences = (where_sentence, state_sentence, naive_sentence, run_sentence)
    assert document["summary"] == [sentence(found) for sentence in sentences]
    assert (document["error"], document["per_state"]) == (0.5, {"x": 0.5, "y": 1.0})
    assert document["scale"] == {"x": 0.5, "y": 4.0}

    def row(value: float) -> dict[str, Any]:
        return {"error": value, "per_state": {"x": value, "y": 2 * value}, "rms": {"x": value / 2, "y": 8 * value}}

    assert document["naive"] == {"no_change": row(1.0), "constant_velocity": row(2.0)}
    assert document["horizons"] == [
        {"seconds": 0.5, "model": row(0.25), "no_change": row(0.75), "constant_velocity": row(1.5)},
        {"seconds": 1.0, "model": row(0.5), "no_change": row(1.0), "constant_velocity": row(2.0)},
    ]
    assert [(item["variable"], item["error"]) for item in document["where"]] == [
        ("x", 3.0), ("speed", 2.0), ("u", 1.5), ("u", 1.0), ("speed", 0.75), ("u", 0.25),
    ]  # fmt: skip
    assert [item.error for item in worst_bins(found)] == [item["error"] for item in document["where"]]
    assert document["where"][1] == {
        "variable": "speed", "unit": "m/s", "low": 0.0, "high": 1.0, "error": 2.0, "ratio": 4.0, "share": 0.25,
        "samples": 3, "bias": {"x": 0.125},
    }  # fmt: skip
    assert document["explained"] == {"speed": 0.5, "u": 0.25, "x": 0.125}
    assert document["place"] == [
        {"x_low": 0.0, "x_high": 1.0, "y_low": 2.0, "y_high": 3.0, "error": 0.5, "share": 0.25, "samples": 7},
        {"x_low": 1.0, "x_high": 2.0, "y_low": 2.0, "y_high": 3.0, "error": None, "share": 0.75, "samples": 5},
    ]
    assert [(item["name"], item["per_state"]) for item in document["runs"]] == [
        ("a", {"x": 0.25, "y": 0.5}), ("b", {"x": 0.25, "y": 0.25}), ("c", {"x": 2.0, "y": 0.5}),
    ]  # fmt: skip
    assert all(set(item) == set(PerRunError.__dataclass_fields__) for item in document["runs"])
    quality = [(item["run"], item["kind"], item["count"]) for item in document["data_quality"]]
    assert quality == [("a", "gap", 2), ("c", "jump", 3)]


@pytest.mark.parametrize(
    ("explained", "named"),
    [((0.5, 0.25, 0.125), "speed"), ((0.5, 0.4, 0.125), "speed"), ((0.4, 0.5, 0.125), "u"),
     ((0.25, 0.5, 0.125), "u"), ((0.25, 0.25, 0.4), "speed"), ((0.2, 0.1, 0.4), "x"),
     ((-0.5, -0.75, 0.06), "x"), ((-0.5, -0.75, 0.04), "speed")],
)  # fmt: skip
def test_position_and_time_must_explain_1_5_times_as_much_and_0_05_more_to_be_named(explained, named):
    kinds = (("speed", "state"), ("u", "action"), ("x", "position"))
    made = [factor(*kind, share, 1.0) for kind, share in zip(kinds, explained, strict=True)]
    assert (
        most_influential_factor(comparison(factors=tuple(sorted(made, key=lambda item: -item.explained)))).variable
        == named
    )


def test_the_sentences_state_shares_sides_and_sizes() -> None:
    """The state y is off by 1.0 times 4 m; its median of -0.5 m is less than 0.3 of that."""
    share = "its error there is 2.00, 4.0 times the average of 0.50 (25 % of the squared error in 5 % of the windows)"
    assert share in where_sentence(comparison())
    notice = state_sentence(comparison())
    assert notice.startswith("The state predicted worst is y: off by 4 m after 1 s (no bias to one side), 1.00 times")
    biased = state_sentence(comparison(errors=np.array([[0.0, -1.0], [0.0, -1.5], [0.0, -2.0]])))
    assert "(median 1.5 m too low)" in biased


@pytest.mark.parametrize(
    ("errors", "verdict"),
    [((0.5, 1.0, 2.0), "better than both"), ((1.5, 1.0, 2.0), "better than one of them only"),
     ((1.5, 2.0, 1.0), "better than one of them only"), ((3.0, 1.0, 2.0), "worse than both")],
)  # fmt: skip
def test_the_model_is_compared_with_predictors_without_physics(errors: tuple[float, ...], verdict: str) -> None:
    found = comparison(horizons=(HorizonError(0.5, errors_of(9.0, 9.0, 9.0)), HorizonError(1.0, errors_of(*errors))))
    notice = naive_sentence(found)
    model, still, steady = errors
    assert f"error is {model:.2f}; predicting no change gives {still:.2f}, constant velocity {steady:.2f}" in notice
    assert notice.endswith(f": {verdict}.")


@pytest.mark.parametrize(
    ("runs", "odd", "lost"),
    [
        ({"a": 0.25, "b": 0.25, "c": 2.0}, "X is far worse in c than in other runs: 2.00, where the median is 0.25",
         "x in c (2.00)"),
        ({"a": 0.75, "b": 0.25, "c": 0.25}, "X is far worse in a than in other runs: 0.75, where the median is 0.25",
         ""),
        ({"a": 1.5, "b": 0.75, "c": 1.25}, "", "x in a (1.50), x in c (1.25)"),
        ({"a": 2.0, "b": 2.0}, "", ""), ({"a": 0.25, "b": 0.5}, "", ""), ({"a": 2.0}, "", ""), ({}, "", ""),
    ],
)  # fmt: skip
def test_a_run_that_stands_out_or_is_worse_than_no_change_is_named(runs: dict[str, float], odd: str, lost: str) -> None:
    notice = run_sentence(comparison(runs=tuple(run_error(name, x=error) for name, error in runs.items())))
    text = "; ".join(part for part in (odd, f"worse than predicting no change: {lost}" if lost else "") if part)
    assert notice == (text[0].upper() + text[1:] + "." if text else "")


@pytest.mark.parametrize("runs", [(run_error("a"), run_error("b")), (run_error("a", x=2.0, y=0.25),)])
def test_no_sentence_is_made_about_runs_without_change_or_about_a_single_run(runs: Any) -> None:
    assert run_sentence(comparison(runs=runs)) == ""


@pytest.mark.parametrize(
    ("after", "reported"),
    [((0.25, 0.25), ""), ((0.26, 0.25), ""), ((0.27, 0.25), "x in a (0.25 to 0.27)"),
     ((0.3, 0.5), "x in b (0.25 to 0.5), x in a (0.25 to 0.3)")],
)  # fmt: skip
def test_states_that_get_worse_are_named_most_first(after: tuple[float, float], reported: str) -> None:
    before = comparison(runs=(run_error("a", x=0.25), run_error("b", x=0.25)))
    later = comparison(runs=tuple(run_error(name, x=x) for name, x in zip("ab", after, strict=True)))
    notice = worse_sentence(before, later)
    assert notice.endswith(f"worse: {reported}." if reported else "no state gets worse in any run.")
