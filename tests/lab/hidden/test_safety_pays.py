"""A small part of the experiment: the diagnosed model knows what is hidden and needs less margin."""

from __future__ import annotations

import json

import pytest

from safedpa.effects import effect
from safedpa_services.command_line.group import safedpa


@pytest.mark.long
def test_the_diagnosed_model_needs_less_margin(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr("safedpa.diagnosis.diagnose.library_for", lambda _: [effect("car", "steering_offset")])
    out = tmp_path / "found.json"
    arguments = ["--hidden", "steering_offset", "--seeds", "1", "--seconds", "2", "--drives", "2"]
    arguments += ["--drive-seconds", "20", "--processes", "1", "--out", str(out), "--json"]
    assert safedpa.run(["experiment", "safety-pays", *arguments]) == 0
    result = json.loads(capsys.readouterr().out)
    kept = json.loads(out.read_text(encoding="utf-8"))
    assert kept.pop("provenance")["command"].startswith("safedpa experiment safety-pays --hidden steering_offset")
    assert result == kept
    rows = {row["model"]: row for row in result["rows"]}
    assert rows["diagnosed"]["effects"] == ["steering_offset"]
    assert rows["diagnosed"]["epsilon"]["obstacle"] < 0.7 * rows["incomplete"]["epsilon"]["obstacle"]
    assert all(row["episodes"] == 1 for row in result["rows"])


@pytest.mark.parametrize("arguments", [["--hidden", "chairs"], ["--seeds", "0"], ["--out", "/no/where/x.json"]])
def test_bad_options_are_one_line(arguments, capsys):
    assert safedpa.run(["experiment", "safety-pays", *arguments]) == 2
    shown = capsys.readouterr()
    assert (shown.out, shown.err.count("\n")) == ("", 1)
