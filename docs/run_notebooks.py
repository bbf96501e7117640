"""Runs the notebooks and writes what their cells print into them: ``python docs/run_notebooks.py [NOTEBOOK...]``.

Cells are run one after the other in one process, in a folder that is thrown away; jupyter runs the same files.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

__all__ = ["NOTEBOOKS", "run"]

NOTEBOOKS = sorted((Path(__file__).resolve().parent / "notebooks").glob("*.ipynb"))


def run(notebook: dict[str, Any], name: str) -> list[str]:
    """Runs the code cells in the working directory; returns what each printed."""
    names: dict[str, Any] = {"__name__": "__main__"}
    printed = []
    for number, cell in enumerate(cell for cell in notebook["cells"] if cell["cell_type"] == "code"):
        out = io.StringIO()
        with contextlib.redirect_stdout(out):
            exec(compile("".join(cell["source"]), f"{name}, code cell {number}", "exec"), names)
        printed.append(out.getvalue())
    return printed


def main(paths: list[Path]) -> None:
    """Runs each notebook and writes it again, with its output."""
    for path in paths:
        notebook = json.loads(path.read_text(encoding="utf-8"))
        before = Path.cwd()
        with tempfile.TemporaryDirectory() as folder:
            os.chdir(folder)
            printed = run(notebook, path.name)
            os.chdir(before)
        codes = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
        for number, (cell, text) in enumerate(zip(codes, printed, strict=True), start=1):
            stream = {"name": "stdout", "output_type": "stream", "text": text.splitlines(keepends=True)}
            cell |= {"execution_count": number, "outputs": [stream] if text else []}
        path.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        sys.stdout.write(f"{path.name}: {len(codes)} cells\n")


if __name__ == "__main__":
    main([Path(name).resolve() for name in sys.argv[1:]] or NOTEBOOKS)
