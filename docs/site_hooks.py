"""What the site needs beyond the pages: notebooks as pages, and links that lead out of the folder of pages.

mkdocs calls these functions while it builds; ``make docs`` runs it.
"""

from __future__ import annotations

import ast
import json
import re
import sys
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

sys.path.insert(0, str(Path(__file__).parent))
from draw_diagrams import FENCE, picture_of

__all__ = ["notebook_as_markdown", "on_files", "on_page_markdown"]

ROOT = Path(__file__).resolve().parents[1]
ALONGSIDE = ("CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md", "CODE_OF_CONDUCT.md")
"""Pages that lie where people look for them first, and are shown on the site, too."""


def on_files(files: Files, *, config: Any) -> Files:
    """Adds the pages next to the folder, and each notebook as a page."""
    for name in ALONGSIDE:
        text = (ROOT / name).read_text(encoding="utf-8").replace("](docs/", "](").replace("](LICENSE", "](../LICENSE")
        files.append(File.generated(config, name, content=text))
    for found in [file for file in files if file.src_uri.endswith(".ipynb")]:
        text = notebook_as_markdown(json.loads(Path(found.abs_src_path).read_text(encoding="utf-8")))
        files.remove(found)
        page = File.generated(config, found.src_uri.replace(".ipynb", ".md"), content=text)
        files.append(page)
    return files


def on_page_markdown(markdown: str, *, page: Any, config: Any, files: Files) -> str:
    """Diagrams become pictures; links to notebooks lead to their pages, one out of the folder becomes its path."""
    del config, files
    if page.file.src_uri.startswith("reference/python/"):
        markdown += "".join(f"\n::: {path}\n" for path in _shadowed(Path(page.file.src_uri).stem))
    depth = page.file.src_uri.count("/")
    out = "../" * (depth + 1)
    markdown = FENCE.sub(lambda found: f"![diagram]({'../' * depth}pictures/{picture_of(found[1])})\n", markdown)
    markdown = markdown.replace(".ipynb)", ".md)")
    for name in ALONGSIDE:
        markdown = markdown.replace(f"]({out}{name})", f"]({'../' * depth}{name})")
    return re.sub(rf"\[([^\]]+)\]\({re.escape(out)}([^)]+)\)", _outside, markdown)


def _shadowed(package: str) -> list[str]:
    """Public names of a package that one of its modules bears as well: read as that module, they would be left out."""
    folder = ROOT / "shared" / "safedpa" / package
    if not folder.is_dir():
        return []
    imports = ast.walk(ast.parse((folder / "__init__.py").read_text(encoding="utf-8")))
    found = [(node.module, alias.name) for node in imports if isinstance(node, ast.ImportFrom) for alias in node.names]
    return [f"{module}.{name}" for module, name in found if (folder / f"{name}.py").exists()]


def _outside(found: re.Match[str]) -> str:
    text, path = found[1], found[2]
    return text if path in text else f"{text} (`{path}`)"


def notebook_as_markdown(notebook: dict[str, Any]) -> str:
    """Cells as Markdown: text as it is, code fenced, printed output as a block of its own, pictures inline."""
    parts = []
    for cell in notebook["cells"]:
        text = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(text)
            continue
        parts.append(f"```python\n{text}\n```")
        for output in cell.get("outputs", []):
            data = output.get("data", {})
            if "image/png" in data:
                parts.append(f"![what the cell draws](data:image/png;base64,{''.join(data['image/png']).strip()})")
            printed = "".join(output.get("text", data.get("text/plain", [])))
            if printed and "image/png" not in data:
                parts.append(f"```text\n{printed.rstrip()}\n```")
    return "\n\n".join(parts) + "\n"
