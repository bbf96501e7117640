"""The examples and the notebooks pass mypy, so an editor knows the type of each result."""

import doctest
import json
import subprocess
import sys
from pathlib import Path
from textwrap import indent

import pytest

import safedpa

ROOT = Path(__file__).resolve().parents[2]
OPTIONS = "# mypy: allow-untyped-defs, allow-untyped-calls\n"
"""What a user writes in an example needs no annotations; what safedpa gives has them. In the files themselves: with
options of the command, mypy would check the whole package again instead of using what ``make types`` remembers."""


@pytest.mark.long
def test_the_examples_and_the_notebooks_pass_mypy(tmp_path: Path) -> None:
    pytest.importorskip("mypy")
    lines = [OPTIONS, "import numpy as np", "", "import safedpa"]
    public = (getattr(safedpa, name) for name in safedpa.__all__ if name != "__version__")
    for found in (one for item in public for one in doctest.DocTestFinder().find(item, module=False) if one.examples):
        lines.append(f"def {found.name.replace('.', '_')}_example() -> None:")
        lines.append(indent("".join(example.source for example in found.examples), "    "))
    (tmp_path / "examples.py").write_text("\n".join(lines))
    for path in (ROOT / "docs" / "tutorials").glob("*.ipynb"):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        codes = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
        (tmp_path / f"{path.stem}.py").write_text(OPTIONS + "\n\n".join(codes))
    command = [sys.executable, "-m", "mypy", *sorted(tmp_path.glob("*.py"))]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
