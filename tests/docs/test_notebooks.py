"""The notebooks run, and print what stands in them."""

import json
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "docs"))

from run_notebooks import NOTEBOOKS, run

pytestmark = pytest.mark.slow


def test_there_are_three() -> None:
    assert [path.stem for path in NOTEBOOKS] == ["calibrate_a_margin", "diagnose_a_log", "filter_your_own"]


@pytest.mark.long
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_and_holds_what_its_cells_print(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    notebook = json.loads(path.read_text(encoding="utf-8"))
    monkeypatch.chdir(tmp_path)
    printed = run(notebook, path.name)
    codes = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    retained = ["".join("".join(output["text"]) for output in cell["outputs"]) for cell in codes]
    rounded = path.stem == "diagnose_a_log"  # a fit's last digits are the processor's
    assert [bool(text) for text in printed] == [bool(text) for text in retained]
    assert rounded or printed == retained, "run python docs/run_notebooks.py"
    assert path.stat().st_size < 20_000
