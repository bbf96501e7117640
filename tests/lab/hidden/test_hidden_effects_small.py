"""A small part of the hidden-effects experiment: diagnosed by the product, judged by the sealed truth."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from safedpa_lab.experiments.hidden_effects import run_cases
from safedpa_lab.hidden import cases_of
from safedpa_services.command_line.group import safedpa

pytestmark = pytest.mark.slow

ORDINARY = {case.name.split("-")[1]: case for case in cases_of("ordinary", 24)}


def short(case, runs=4, seconds=20.0):
    return replace(case, runs=runs, seconds=seconds)


@pytest.fixture(scope="module")
def outcomes():
    """A few cases of each kind, in half the time that the experiment drives."""
    chosen = [short(ORDINARY[name]) for name in ("rolling_resistance", "steering_offset", "steering_lag")]
    chosen += [short(cases_of("none", 1)[0]), short(cases_of("none_hard", 1)[0])]
    return run_cases(chosen)


@pytest.mark.long
def test_each_hidden_effect_is_named_and_nothing_else(outcomes):
    for outcome in outcomes[:3]:
        assert outcome.added == outcome.hidden, outcome
        assert outcome.error_ratio < 1.1
        assert all(abs(value) < 4.0 for value in outcome.deviations)


@pytest.mark.long
def test_nothing_is_named_where_nothing_is_hidden(outcomes):
    for outcome in outcomes[3:]:
        assert outcome.right, outcome


@pytest.mark.long
def test_the_command_prints_one_document(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("safedpa_lab.experiments.hidden_effects.cases_of", lambda *_: [short(cases_of("none", 1)[0])])
    out = tmp_path / "found.json"
    arguments = ["--suite", "none", "--cases", "1", "--processes", "1", "--out", str(out)]
    assert safedpa.run(["experiment", "hidden-effects", *arguments, "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    kept = json.loads(out.read_text())
    assert kept.pop("provenance")["command"] == "safedpa experiment hidden-effects --cases 1 --suite none"
    assert shown == kept
    assert shown["suites"][0]["right"]["of"] == 1
    assert safedpa.run(["experiment", "hidden-effects", *arguments]) == 0
    assert "none" in capsys.readouterr().out


@pytest.mark.parametrize("arguments", [["--cases", "0"], ["--suite", "no"], ["--seed", "-1"], ["--out", "/no/where"]])
def test_bad_options_are_one_line(arguments, capsys):
    assert safedpa.run(["experiment", "hidden-effects", *arguments]) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.count("\n") == 1
