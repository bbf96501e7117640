"""``safedpa diagnose`` and the workbench's Save give a margin of the logs' own steps, or say why there is none."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from safedpa.dynamics import fingerprint, load_model
from safedpa.effects import effect
from safedpa.records import load_run
from safedpa.records.run import Run, Stretch
from safedpa.safety import MarginCalibration
from safedpa_lab.hidden import Case, write_case
from safedpa_services.command_line.group import safedpa
from safedpa_services.workbench import jobs
from safedpa_services.workbench.session_files import saved


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    case = Case("test", 3, {"quadratic_drag": {"coefficient": 0.12}}, runs=3, seconds=20.0)
    return write_case(case, tmp_path_factory.mktemp("logs"))


def thinned(path: Path, every: int, out: Path) -> str:
    """The same drive as a logger writes it that is ``every`` times as slow."""
    head, *rows = path.read_text(encoding="utf-8").splitlines()
    out.write_text("\n".join([head, *rows[::every]]) + "\n", encoding="utf-8")
    return str(out)


def diagnosed(log, rates, folder, capsys, monkeypatch, *words: str) -> str:
    """The output for the log's runs, every n-th row of each."""
    monkeypatch.setattr("safedpa.diagnosis.diagnose.library_for", lambda _: [effect("car", "quadratic_drag")])
    paths = [thinned(path, every, folder / path.name) for path, every in zip(log.runs, rates, strict=True)]
    assert safedpa.run(["diagnose", str(log.model), *paths, "--out", str(folder / "out"), *words]) == 0
    return str(capsys.readouterr().out)


def test_slower_logs_give_a_margin_of_their_steps(log, tmp_path, capsys, monkeypatch) -> None:
    said = diagnosed(log, (2, 2, 2), tmp_path, capsys, monkeypatch)
    margin = MarginCalibration.load(tmp_path / "out" / "margin.toml")
    assert margin.period == pytest.approx(0.1)
    assert margin.fingerprint == fingerprint(load_model(str(tmp_path / "out" / "model.toml")))
    assert "The margin is of steps of 0.1 s, as the recordings have them" in said
    assert f"--margin {tmp_path / 'out' / 'margin.toml'} --rate 10\n" in said


def test_logs_of_several_rates_give_no_margin_and_the_reason(log, tmp_path, capsys, monkeypatch) -> None:
    margin = json.loads(diagnosed(log, (2, 4, 4), tmp_path, capsys, monkeypatch, "--json"))["margin"]
    assert not (tmp_path / "out" / "margin.toml").exists()
    line = margin.pop("said")
    assert line.startswith(
        "No margin was calibrated: got steps of 0.1 to 0.2 s, none of the model's own 0.05 s, wanted"
    )
    assert line.endswith("; the filter's settings stand in for it")
    assert margin == {"file": None, "period": None, "drive": None}


def every_nth(run: Run, every: int) -> Run:
    rows = slice(None, None, every)
    t = run.t[rows]
    return replace(run, t=t, states=run.states[rows], actions=run.actions[rows], stretches=(Stretch(0, len(t)),))


def kept(log, rates, folder) -> str:
    model = load_model(str(log.model))
    given = zip(log.runs, rates, strict=True)
    runs = [every_nth(load_run(path, model.system), every) for path, every in given]
    return saved(jobs.opened(model, runs, 1.0, lambda _: None)[-1].step, runs, model, folder, lambda _: None)


def test_the_workbench_saves_a_margin_of_the_logs_steps(log, tmp_path) -> None:
    said = kept(log, (4, 4, 4), tmp_path)
    assert MarginCalibration.load(tmp_path / "margin.toml").period == pytest.approx(0.2)
    assert f"and margin.toml: safedpa up --model {tmp_path / 'model.toml'} --margin" in said
    assert "--rate 5. The margin is of steps of 0.2 s, as the recordings have them" in said


def test_the_reason_for_a_missing_margin_is_printed(log, tmp_path) -> None:
    (tmp_path / "margin.toml").write_text("of an earlier model")
    said = kept(log, (2, 2, 4), tmp_path)
    assert not (tmp_path / "margin.toml").exists()
    assert ". No margin was calibrated: got steps of 0.1 to 0.2 s" in said
    assert said.endswith("; the filter's settings stand in for it")


def test_at_the_rate_of_the_model_the_output_is_unchanged(log, tmp_path) -> None:
    said = kept(log, (1, 1, 2), tmp_path)
    assert said.endswith(
        "The margin is of the model's own steps of 0.05 s; 199 steps of other lengths tell nothing of it."
    )
    assert "--rate" not in said
    assert kept(log, (1, 1, 1), tmp_path).endswith(f"--margin {tmp_path / 'margin.toml'}")
