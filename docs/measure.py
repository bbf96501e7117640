"""Counts words and sentences of the documentation: ``python docs/measure.py``; ``--pages`` adds one row for each page.

Words are words and numbers, without the bars of tables and list marks; a generated part is counted apart. A sentence is
a piece of running text or of a table's cell, of at least three words. Code and headings are no sentences. Text of
notebooks counts as tutorials. Help of the command line and docstrings of the packages have rows of their own.
"""

from __future__ import annotations

import ast
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path

PAGES = Path(__file__).parent
PARTS = ("tutorials", "guides", "reference", "explanation", "evidence", "developers")
READ = PARTS[:3]
"""The parts that a user reads; their generated parts are looked up."""
LONG = 30
"""Words; more are hard to read at once."""
_GENERATED = r"<!-- generated.*?<!-- end -->"
_NOT_TEXT = (r"^```.*?^```$", r"<!--.*?-->", r"^#.*?$", r"^    .*?$")


def sentences(text: str, *, tables: bool = False) -> list[str]:
    """Sentences of the running text of a page, or of its tables."""
    for kind in _NOT_TEXT:
        text = re.sub(kind, "\n\n", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"!\[[^\]]*\]\([^)]*\)", "", text)
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"``?[^`]*``?", "CODE", text)
    rows = [line for line in text.split("\n") if line.startswith("|")]
    running = re.sub(r"^\|.*?$", "\n\n", text, flags=re.MULTILINE)
    blocks = re.split(r"\n\s*\n|\n(?=\s*(?:[-*]|\d+\.) )", running)
    if tables:
        blocks = [cell for row in rows for cell in re.split(r"(?<!\\)\|", row)]
    found = [
        part
        for block in blocks
        for part in re.split(r"(?<=[.!?;])[\"')*]*\s+(?=[\"'(*]*[A-Z])", " ".join(block.split()))
    ]
    return [part for part in found if len(part.split()) > 2]


def lengths(text: str) -> list[int]:
    """Words of each sentence, those of tables included."""
    return [len(one.split()) for tables in (False, True) for one in sentences(text, tables=tables)]


def word_count(text: str) -> int:
    """Words and numbers, without the bars of tables, list marks and comments."""
    return len(re.findall(r"\S*\w\S*", re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)))


def generated(text: str) -> int:
    """Words of the parts that ``docs/generate.py`` writes."""
    return word_count(" ".join(re.findall(_GENERATED, text, flags=re.DOTALL)))


def text_of(page: Path) -> str:
    """Markdown of a page; that of a notebook are its cells of text."""
    text = page.read_text(encoding="utf-8")
    if page.suffix != ".ipynb":
        return text
    cells = json.loads(text)["cells"]
    return "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")


def pages_of(part: str) -> list[Path]:
    """Pages and notebooks of a part; of ``""``, those next to the parts."""
    folder = PAGES / part
    return sorted(folder.rglob("*.md") if part else folder.glob("*.md")) + sorted(folder.glob("*.ipynb"))


def in_navigation() -> int:
    """Pages that the tabs of the site lead to."""
    nav = (PAGES.parent / "mkdocs.yml").read_text(encoding="utf-8").split("\nnav:\n")[1]
    return len(re.findall(r"[\w/-]+\.md$", nav, re.MULTILINE))


def helps() -> Iterator[str]:
    """Help of the command line."""
    import click

    from safedpa_services.command_line.group import safedpa

    context = click.Context(safedpa)
    for name in safedpa.list_commands(context):
        command = safedpa.get_command(context, name)
        assert command is not None
        yield command.help or ""
        yield from (item.help or "" for item in command.params if isinstance(item, click.Option))


def docstrings() -> Iterator[str]:
    """Docstrings of the packages, tests excluded."""
    for folder in ("shared", "services", "sim"):
        for path in sorted((PAGES.parent / folder).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                    yield ast.get_docstring(node) or ""
                elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
                    yield node.value.value if isinstance(node.value.value, str) else ""


def row(name: str, texts: list[str]) -> str:
    """Written and generated words, sentences, their mean length, and the share above thirty in %."""
    found = [length for text in texts for length in lengths(text)]
    count, made = max(len(found), 1), sum(map(generated, texts))
    mean, long = sum(found) / count, 100 * sum(one > LONG for one in found) / count
    return f"{name:40} {sum(map(word_count, texts)) - made:7d} {made:9d} {len(found):9d} {mean:5.1f} {long:14.1f}\n"


def main() -> None:
    """Prints one row for each part, the sums that a test limits, and the sentences of the product."""
    sys.stdout.write(f"{'part':40} written generated sentences  mean  above {LONG} (%)\n")
    parts = {part: [text_of(page) for page in pages_of(part)] for part in ("", *PARTS)}
    for part in PARTS:
        sys.stdout.write(row(part, parts[part]))
    if "--pages" in sys.argv:
        for page in (page for part in parts for page in pages_of(part)):
            sys.stdout.write(row(str(page.relative_to(PAGES)), [text_of(page)]))
    sys.stdout.write(row("tutorials, guides and reference", [text for part in READ for text in parts[part]]))
    sys.stdout.write(row("all pages", [text for part in parts.values() for text in part]))
    sys.stdout.write(row("help of the command line", list(helps())))
    sys.stdout.write(row("docstrings", list(docstrings())))
    sys.stdout.write(f"pages in the main navigation: {in_navigation()}\n")


if __name__ == "__main__":
    main()
