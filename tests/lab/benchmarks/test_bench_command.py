"""The command: what it lists, refuses, and finds in a quick run. No times are asserted."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from safedpa_lab.benchmarks.rows import ROWS
from safedpa_services.command_line.group import safedpa

pytestmark = pytest.mark.slow


def test_the_rows_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert safedpa.run(["bench", "list"]) == 0
    said = capsys.readouterr().out
    assert all(name in said for name in ROWS)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--quick", "--full"], "choose one"),
        (["--only", "filters"], "filter"),
        (["--data", "nowhere"], "--data nowhere: no such folder"),
    ],
)
def test_what_makes_no_sense_is_refused(arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert safedpa.run(["bench", "all", *arguments]) == 2
    assert words in capsys.readouterr().err


@pytest.mark.long
def test_a_quick_run_has_every_part(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, page = tmp_path / "speed.json", tmp_path / "speed.md"
    rows = ("adaptation", "batch", "point-steps")
    only = [word for name in rows for word in ("--only", name)]
    pictures = ["--pictures", str(tmp_path)]
    assert safedpa.run(["bench", "all", "--quick", *only, "--json", str(file), "--markdown", str(page), *pictures]) == 0
    document = json.loads(file.read_text(encoding="utf-8"))
    assert tuple(document["rows"]) == rows
    said = capsys.readouterr().out
    for name, row in document["rows"].items():
        assert "failed" not in row, row
        assert name in said
        assert f"## {name}" in page.read_text(encoding="utf-8")
        assert row["targets"]
        assert all(entry["figures"][row["figure"]] > 0.0 for entry in row["ours"])
        assert all(entry["figures"] or entry["missing"] for entry in row["peers"])
        if row["figure"] == "p50":
            assert all({"p50", "p99", "p999"} <= set(entry["figures"]) for entry in row["ours"])
    assert (tmp_path / "speed.png").exists()
    assert (tmp_path / "speed_growth.png").exists()
