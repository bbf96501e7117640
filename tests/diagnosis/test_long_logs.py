"""Long logs: excerpts with bounded rows are spread over every run, and a hidden effect is still found."""

from __future__ import annotations

import json

import numpy as np
import pytest

from safedpa.compare.comparison import compare_model
from safedpa.compare.excerpt import excerpt
from safedpa.diagnosis.fit.readiness import prepared
from safedpa.dynamics import load_model
from safedpa.effects import effect
from safedpa.records import load_run
from safedpa_lab.experiments.long_logs import HIDDEN, LongLogs, write_long_logs
from safedpa_services.command_line.group import safedpa

LOGS = LongLogs(runs=3, seconds=60.0, period=0.02)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("long")
    return folder, write_long_logs(LOGS, folder, ("csv", "parquet", "mcap"))


def test_every_kind_of_file_holds_the_same_drive(written):
    folder, paths = written
    system = load_model(folder / "model.toml").system
    csv, parquet, mcap = (load_run(paths[kind][0], system) for kind in ("csv", "parquet", "mcap"))
    assert len(csv.t) == 3000
    for other in (parquet, mcap):
        rows = len(other.t)  # the last action of a recording was never reported
        assert rows >= 2999
        assert np.allclose(other.states, csv.states[:rows], atol=1e-9)
        assert np.allclose(other.actions, csv.actions[:rows], atol=1e-9)


@pytest.mark.long
def test_a_hidden_effect_is_found_in_a_small_part_of_the_rows(written, tmp_path, capsys, monkeypatch):
    folder, paths = written
    names = ("quadratic_drag", "rolling_resistance")
    monkeypatch.setattr("safedpa.diagnosis.diagnose.library_for", lambda _: [effect("car", name) for name in names])
    monkeypatch.setattr("safedpa.diagnosis.diagnose.prepared", lambda model, runs, _: prepared(model, runs, 3000))
    monkeypatch.setattr("safedpa.report.diagnosis_page.excerpt", lambda runs, _, horizon: excerpt(runs, 3000, horizon))
    runs = [str(path) for path in paths["csv"]]
    assert safedpa.run(["diagnose", str(folder / "model.toml"), *runs, "--out", str(tmp_path), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["added"] == ["quadratic_drag"]
    true = HIDDEN["quadratic_drag"]["coefficient"]
    assert abs(report["parameters"]["quadratic_drag.coefficient"]["value"] - true) < 0.05 * true
    thinned = [item for item in report["data_quality"] if item["kind"] == "thinned"]
    assert len(thinned) == 1
    assert 4_500 < thinned[0]["count"] < 6_500


@pytest.mark.parametrize("horizon", [1.0, 4.0])
def test_pieces_hold_the_horizon_and_are_spread_over_every_run(horizon, written):
    folder, paths = written
    system = load_model(folder / "model.toml").system
    runs = [load_run(path, system) for path in paths["parquet"]]
    used = excerpt(runs, 3000, horizon)
    assert len(used) == len(runs)
    for run in used:
        lengths = [run.t[part.stop - 1] - run.t[part.start] for part in run.stretches]
        assert min(lengths) >= max(5.0, 3.0 * horizon) - 0.05
        assert run.stretches[0].start == 0
    assert 2000 <= sum(len(part) for run in used for part in run.stretches) <= 4500


def test_windows_of_long_logs_start_farther_apart_and_a_finding_says_so(written, monkeypatch):
    folder, paths = written
    model = load_model(folder / "model.toml")
    runs = [load_run(path, model.system) for path in paths["parquet"]]
    whole = compare_model(model, runs)
    monkeypatch.setattr("safedpa.compare.comparison.MOST_WINDOWS", 600)
    part = compare_model(model, runs)
    assert len(part.windows) <= 610 < len(whole.windows)
    assert part.error.value == pytest.approx(whole.error.value, rel=0.1)
    assert {finding.kind for _, finding in part.findings} - {finding.kind for _, finding in whole.findings} == {
        "thinned"
    }


@pytest.mark.long
def test_the_experiment_measures_a_process_of_its_own(capsys):
    few = ["--runs", "1", "--seconds", "12", "--period", "0.05"]
    assert safedpa.run(["experiment", "long-logs", *few, "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [row["command"] for row in rows] == ["diagnose", "compare"]
    for row in rows:
        assert 50 < row["memory_mebibytes"] < 2048
        assert row["processor_seconds"] > 0.0
    assert safedpa.run(["experiment", "long-logs", "--runs", "0"]) == 2
