"""Errors by run and state: what a mean over states and runs hides is reported."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from safedpa.compare.comparison import compare_model
from safedpa.compare.summary import as_json, run_sentence, worse_sentence
from safedpa.diagnosis.diagnose import diagnose
from safedpa.effects import effect
from safedpa_lab.hidden import Case, write_case
from safedpa_services.command_line.group import safedpa


@pytest.fixture
def runs(plain, drive):
    return [drive(plain, 20.0, seed, name=f"drive_{seed}") for seed in range(3)]


def turned(run):
    """The same, with a heading that drifts away."""
    states = run.states.copy()
    states[:, 2] += 0.3 * run.t
    return replace(run, states=states)


def test_the_error_of_each_run_and_state_is_reported(plain, runs):
    comparison = compare_model(plain, [*runs[:2], turned(runs[2])], 1.0)
    document = as_json(comparison)
    assert list(document["explained"]) == [factor.variable for factor in comparison.factors]
    assert len(document["explained"]) > 1
    errors = {run["name"]: run["per_state"] for run in document["runs"]}
    assert errors["drive_2"]["yaw"] > 10.0 * errors["drive_0"]["yaw"]
    assert set(errors["drive_0"]) == {"x", "y", "yaw", "speed"}
    assert "far worse in drive_2" in run_sentence(comparison)
    assert run_sentence(comparison) in document["summary"]


def test_a_state_that_gets_worse_in_one_run_is_named(plain, runs, with_effect):
    """A model whose steering is a little off: better on the run that has it, worse on the others."""
    biased = with_effect(plain, "steering_offset", angle=0.05)
    before, after = (compare_model(model, runs, 1.0) for model in (plain, biased))
    told = worse_sentence(before, after)
    assert "yaw in drive_0" in told
    assert "no state gets worse in any run" in worse_sentence(after, before)


def test_the_command_compares_with_an_earlier_model(tmp_path, capsys):
    log = write_case(Case("test", 3, {"quadratic_drag": {"coefficient": 0.12}}, runs=2, seconds=10.0), tmp_path)
    later = tmp_path / "later.toml"
    extra = '\n[[effects]]\nname = "steering_offset"\nangle = 0.2\n'
    later.write_text(log.model.read_text(encoding="utf-8") + extra, encoding="utf-8")
    arguments = ["compare", str(later), *map(str, log.runs), "--before", str(log.model), "--out", str(tmp_path / "out")]
    assert safedpa.run(arguments) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "what gets worse: yaw in" in told or "what gets worse: " in told
    assert "Error by run and state" in told
    assert safedpa.run([*arguments, "--json"]) == 0
    assert "gets worse" in json.loads(capsys.readouterr().out)["change"]


@pytest.mark.long
def test_a_diagnosis_reports_states_that_got_worse(plain, runs, with_effect, drive, monkeypatch):
    """Two runs with an offset of the steer and one with the opposite: the mean falls, the third run's yaw suffers."""
    monkeypatch.setattr("safedpa.diagnosis.diagnose.library_for", lambda _: [effect("car", "steering_offset")])
    offset, other = (with_effect(plain, "steering_offset", angle=angle) for angle in (0.06, -0.01))
    random = np.random.default_rng(1)
    mixed = [drive(offset, 25.0, seed, name=f"drive_{seed}") for seed in range(5)]
    mixed.append(drive(other, 25.0, 9, name="other"))
    noisy = [
        replace(r, states=r.states + random.normal(0.0, (0.002, 0.002, 0.003, 0.015), r.states.shape)) for r in mixed
    ]
    report = diagnose(plain, noisy)
    assert report.added == ("steering_offset",)
    assert {(item.run, item.state) for item in report.worse} >= {("other", "yaw")}
    assert report.worse[0].after > report.worse[0].before
