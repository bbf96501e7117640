"""Logs that are long, thinned or at other rates."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from safedpa.comparison.excerpt import subsample_runs
from safedpa.diagnosis.fit.data_checks import prepare_runs
from safedpa.dynamics import fingerprint, load_model
from safedpa.effects import effect
from safedpa.records import load_run
from safedpa.records.run import Run, Stretch
from safedpa.safety import MarginCalibration
from safedpa_lab.experiments.diagnosis.long_logs import HIDDEN, LongLogs, write_long_logs
from safedpa_lab.hidden import Case, write_case
from safedpa_services.command_line.group import safedpa
from safedpa_services.workbench.session import jobs
from safedpa_services.workbench.session.files import save_model_files

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
    monkeypatch.setattr("safedpa.diagnosis.diagnose.prepare_runs", lambda model, runs: prepare_runs(model, runs, 3000))
    monkeypatch.setattr(
        "safedpa.report.diagnosis_page.subsample_runs", lambda runs, _, horizon: subsample_runs(runs, 3000, horizon)
    )
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
    used = subsample_runs(runs, 3000, horizon)
    assert len(used) == len(runs)
    for run in used:
        lengths = [run.t[part.stop - 1] - run.t[part.start] for part in run.stretches]
        assert min(lengths) >= max(5.0, 3.0 * horizon) - 0.05
        assert run.stretches[0].start == 0
    assert 2000 <= sum(len(part) for run in used for part in run.stretches) <= 4500


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


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    case = Case("test", 3, {"quadratic_drag": {"coefficient": 0.12}}, runs=3, seconds=20.0)
    return write_case(case, tmp_path_factory.mktemp("logs"))


def thinned(path: Path, every: int, out: Path) -> str:
    """The same drive as a logger writes it that is ``every`` times as slow."""
    head, *rows = path.read_text(encoding="utf-8").splitlines()
    out.write_text("\n".join([head, *rows[::every]]) + "\n", encoding="utf-8")
    return str(out)


def diagnosed(log, rates, folder, capsys, monkeypatch, *phrase: str) -> str:
    """The output for the log's runs, every n-th row of each."""
    monkeypatch.setattr("safedpa.diagnosis.diagnose.library_for", lambda _: [effect("car", "quadratic_drag")])
    paths = [thinned(path, every, folder / path.name) for path, every in zip(log.runs, rates, strict=True)]
    assert safedpa.run(["diagnose", str(log.model), *paths, "--out", str(folder / "out"), *phrase]) == 0
    return str(capsys.readouterr().out)


@pytest.mark.long
def test_slower_logs_give_a_margin_of_their_steps(log, tmp_path, capsys, monkeypatch) -> None:
    notice = diagnosed(log, (2, 2, 2), tmp_path, capsys, monkeypatch)
    margin = MarginCalibration.load(tmp_path / "out" / "margin.toml")
    assert margin.period == pytest.approx(0.1)
    assert margin.fingerprint == fingerprint(load_model(str(tmp_path / "out" / "model.toml")))
    assert "The margin is valid for steps of 0.1 s, as in the recordings" in notice
    assert f"--margin {tmp_path / 'out' / 'margin.toml'} --rate 10\n" in notice


def test_logs_of_several_rates_give_no_margin_and_the_reason(log, tmp_path, capsys, monkeypatch) -> None:
    margin = json.loads(diagnosed(log, (2, 4, 4), tmp_path, capsys, monkeypatch, "--json"))["margin"]
    assert not (tmp_path / "out" / "margin.toml").exists()
    line = margin.pop("notice")
    assert line.startswith("No margin was calibrated: got steps of 0.1 to 0.2 s, none of the model's own 0.05 s, ")
    assert line.endswith("; the filter uses epsilon of its settings instead")
    assert margin == {"file": None, "period": None, "drive": None}


def every_nth(run: Run, every: int) -> Run:
    rows = slice(None, None, every)
    t = run.t[rows]
    return replace(run, t=t, states=run.states[rows], actions=run.actions[rows], stretches=(Stretch(0, len(t)),))


def retained(log, rates, folder) -> str:
    model = load_model(str(log.model))
    given = zip(log.runs, rates, strict=True)
    runs = [every_nth(load_run(path, model.system), every) for path, every in given]
    version = jobs.first_versions(model, runs, 1.0, lambda _: None)[-1]
    return save_model_files(version.step, runs, model, folder, lambda _: None)


def test_the_workbench_saves_a_margin_of_the_logs_steps(log, tmp_path) -> None:
    notice = retained(log, (4, 4, 4), tmp_path)
    assert MarginCalibration.load(tmp_path / "margin.toml").period == pytest.approx(0.2)
    assert f"and margin.toml: safedpa up --model {tmp_path / 'model.toml'} --margin" in notice
    assert "--rate 5. The margin is valid for steps of 0.2 s, as in the recordings" in notice


def test_the_reason_for_a_missing_margin_is_printed(log, tmp_path) -> None:
    (tmp_path / "margin.toml").write_text("of an earlier model")
    notice = retained(log, (2, 2, 4), tmp_path)
    assert not (tmp_path / "margin.toml").exists()
    assert ". No margin was calibrated: got steps of 0.1 to 0.2 s" in notice
    assert notice.endswith("; the filter uses epsilon of its settings instead")


def test_at_the_rate_of_the_model_the_output_is_unchanged(log, tmp_path) -> None:
    notice = retained(log, (1, 1, 2), tmp_path)
    assert notice.endswith("is valid for the model's period of 0.05 s; 199 steps of other lengths were not used.")
    assert "--rate" not in notice
    assert retained(log, (1, 1, 1), tmp_path).endswith(f"--margin {tmp_path / 'margin.toml'}")
