"""``safedpa experiment``: each experiment with options of its own, and nothing else accepted."""

from __future__ import annotations

import json

import pytest

from safedpa_lab.commands.experiment import EXPERIMENTS
from safedpa_services.command_line.group import safedpa


def run(*arguments):
    return safedpa.run(["experiment", *map(str, arguments)])


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_has_a_help(name, capsys):
    assert run(name, "--help") == 0
    shown = capsys.readouterr().out
    assert f"experiment {name}" in shown
    assert "--json" in shown


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["safty"], "did you mean 'safety'"),
        (["safety", "--suite", "none"], "--suite"),
        (["safety", "--seeds", 0], "wanted more than 0"),
    ],
)
def test_what_does_not_belong_is_refused(arguments, told, capsys):
    assert run(*arguments) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert told in shown.err
    assert shown.err.count("\n") == 1


def test_the_safety_experiment_prints_one_document(tmp_path, capsys):
    out = tmp_path / "safety.json"
    assert run("safety", "--seeds", 1, "--seconds", 0.5, "--out", out, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    kept = json.loads(out.read_text())
    assert kept.pop("provenance")["command"] == "safedpa experiment safety --seeds 1 --seconds 0.5"
    assert found == kept
    assert found["seeds"] == [0, 0]
    assert {row["filter_on"]["episodes"] for row in found["rows"]} == {1}
