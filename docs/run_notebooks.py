"""Runs the notebooks and writes what their cells show into them: ``python docs/run_notebooks.py [NOTEBOOK...]``.

Cells are run one after the other in one process, in a folder that is thrown away; jupyter runs the same files.
"""

from __future__ import annotations

import ast
import base64
import contextlib
import io
import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

__all__ = ["NOTEBOOKS", "run"]

NOTEBOOKS = sorted((Path(__file__).resolve().parent / "tutorials").glob("*.ipynb"))


def run(notebook: dict[str, Any], name: str) -> list[list[dict[str, Any]]]:
    """Runs the code cells in the working directory; returns the outputs of each: what it prints, and its last value."""
    names: dict[str, Any] = {"__name__": "__main__"}
    shown = []
    for number, cell in enumerate((cell for cell in notebook["cells"] if cell["cell_type"] == "code"), start=1):
        tree, out, value = ast.parse("".join(cell["source"])), io.StringIO(), None
        last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
        with contextlib.redirect_stdout(out):
            exec(compile(tree, f"{name}, code cell {number}", "exec"), names)
            if isinstance(last, ast.Expr):
                value = eval(compile(ast.Expression(last.value), f"{name}, code cell {number}", "eval"), names)
        outputs: list[dict[str, Any]] = []
        if out.getvalue():
            outputs.append({"name": "stdout", "output_type": "stream", "text": _lines(out.getvalue())})
        if value is not None:
            result = {"data": _representations(value), "execution_count": number, "metadata": {}}
            outputs.append({**result, "output_type": "execute_result"})
        shown.append(outputs)
    return shown


def _representations(value: Any) -> dict[str, Any]:
    """As jupyter asks an object for them."""
    found: dict[str, Any] = {"text/plain": _lines(repr(value))}
    if hasattr(value, "_repr_html_"):
        found["text/html"] = _lines(value._repr_html_())
    if hasattr(value, "_repr_png_"):
        found["image/png"] = base64.b64encode(value._repr_png_()).decode("ascii")
    return found


def _lines(text: str) -> list[str]:
    return text.splitlines(keepends=True)


def main(paths: list[Path]) -> None:
    """Runs each notebook and writes it again, with its output."""
    for path in paths:
        notebook = json.loads(path.read_text(encoding="utf-8"))
        before = Path.cwd()
        with tempfile.TemporaryDirectory() as folder:
            os.chdir(folder)
            shown = run(notebook, path.name)
            os.chdir(before)
        codes = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
        for number, (cell, outputs) in enumerate(zip(codes, shown, strict=True), start=1):
            cell |= {"execution_count": number, "outputs": outputs}
        path.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        sys.stdout.write(f"{path.name}: {len(codes)} cells\n")


if __name__ == "__main__":
    main([Path(name).resolve() for name in sys.argv[1:]] or NOTEBOOKS)
