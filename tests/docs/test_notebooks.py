"""The notebooks run, and print what stands in them."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "docs"))

from run_notebooks import NOTEBOOKS, run

pytestmark = pytest.mark.slow


def test_there_are_three() -> None:
    assert [path.stem for path in NOTEBOOKS] == ["calibrate_a_margin", "diagnose_a_log", "filter_your_own"]


def code_cells(path: Path) -> list[dict[str, Any]]:
    notebook = json.loads(path.read_text(encoding="utf-8"))
    return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]


def texts(outputs: list[dict[str, Any]]) -> list[str]:
    return ["".join(output.get("text", output.get("data", {}).get("text/plain", []))) for output in outputs]


def test_six_lines_lead_from_a_csv_file_to_a_plotted_effect_with_a_name() -> None:
    cells = code_cells(next(path for path in NOTEBOOKS if path.stem == "diagnose_a_log"))
    cell, shown = next(
        (cell, output["data"]) for cell in cells for output in cell["outputs"] if "image/png" in output.get("data", {})
    )
    lines = [line for line in "".join(cell["source"]).splitlines() if line.strip()]
    assert lines[0] == "import safedpa"
    assert len(lines) <= 6
    assert shown["image/png"].startswith("iVBOR")


def test_the_readme_shows_the_lines_of_the_notebook() -> None:
    readme = (NOTEBOOKS[0].parents[2] / "README.md").read_text(encoding="utf-8")
    cells = code_cells(next(path for path in NOTEBOOKS if path.stem == "diagnose_a_log"))
    assert "".join(cells[1]["source"]).strip() in readme


@pytest.mark.long
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_and_holds_what_its_cells_show(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    shown = run(json.loads(path.read_text(encoding="utf-8")), path.name)
    retained = [cell["outputs"] for cell in code_cells(path)]
    rounded = path.stem == "diagnose_a_log"  # a fit's last digits are the processor's
    assert [len(outputs) for outputs in shown] == [len(outputs) for outputs in retained]
    assert rounded or [texts(outputs) for outputs in shown] == [texts(outputs) for outputs in retained], (
        "run python docs/run_notebooks.py"
    )
    assert all(len(text) <= 2000 for outputs in shown for text in texts(outputs)), "a cell shows a few lines"
    assert path.stat().st_size < 100_000
