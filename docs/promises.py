"""What README and pages promise, and what holds each promise.

A promise is a paragraph, an item of a list or a table in which a number stands, or a word that leaves no exception. It
is covered by a test or a command that is named in it, or in a remark below it that a reader of the page does not see:
``<!-- held: tests/safety/test_verdict.py::test_it, safedpa experiment safety -->``. A remark right below a heading
applies to everything below it that has none of its own. What only sounds like a promise says so: ``<!-- no
promise: what the reader does himself -->``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

__all__ = ["PAGES", "ROOT", "Promise", "promises_of", "table", "wrong_holders"]

ROOT = Path(__file__).resolve().parents[1]
NOT_SWEPT = (
    "asyncapi", "commands", "design", "diagnosis-speed", "filter-speed", "filter-speed-work", "fleet-speed",
    "fleet-work", "gallery", "glossary", "code-map", "index", "network-speed", "paper", "promises", "speed", "versions",
)  # fmt: skip
"""Pages that tell why (and ``decisions-*``), lead elsewhere, or hold figures of speed, which are those of a machine."""
_FOUND = sorted(
    (page for page in (ROOT / "docs").rglob("*.md") if page.parent.name not in ("results", "python")),
    key=lambda page: page.stem,
)
SWEPT = tuple(page for page in _FOUND if page.stem not in NOT_SWEPT and not page.stem.startswith("decisions-"))
PAGES = (ROOT / "README.md", *SWEPT)
_LONGEST = 120
"""Letters of a promise in the table."""
_TEXT = (
    "always", "at least", "at most", "bit for bit", "cannot", "each", "every", "everything", "exactly", "keeps",
    "never", "no", "no_one", "none", "nothing", "only", "refused", "refuses", "same", "whatever",
)  # fmt: skip
_PROMISES = re.compile(rf"\d|\b(?:{'|'.join(_TEXT)})\b", re.IGNORECASE)
_HELD = re.compile(r"<!-- held:\s(.*?)\s-->", re.DOTALL)
_NONE = re.compile(r"<!-- no promise:\s(.*?)\s-->", re.DOTALL)
_RUN = r"(?:tests/|safedpa (?:compare|experiment|bench|replay)|python deploy/|python -m safedpa_lab|make test)"
_NAMED = re.compile(rf"`(?:pytest )?({_RUN}[^`]*)`")
_RESULT = re.compile(r"\(results/([\w-]+)\.(?:json|md)\)")
_SILENT = (r"^```.*?^```\n", r"<!-- generated.*?<!-- end -->", r"^---\n.*?^---\n")


@dataclass(frozen=True)
class Promise:
    """A paragraph that promises something, and what holds it."""

    page: str
    text: str
    held_by: tuple[str, ...]
    no_promise: str = ""
    """Why it is none, or nothing."""
    results: tuple[str, ...] = ()
    """Files that it leads to, below docs/evidence/results."""

    @property
    def open(self) -> bool:
        """Nothing holds it, and nothing marks it as no promise."""
        return not self.held_by and not self.no_promise


def promises_of(page: Path) -> Iterator[Promise]:
    """Every paragraph, item and table of a page that promises something, in order."""
    text = page.read_text(encoding="utf-8")
    for kind in _SILENT:
        text = re.sub(kind, "", text, flags=re.DOTALL | re.MULTILINE)
    name = str(page.relative_to(ROOT))
    sections: dict[int, str] = {}
    for block in re.split(r"\n\s*\n|\n(?=(?:- |\d+\. ))", text):
        if block.startswith("#"):
            level = len(block) - len(block.lstrip("#"))
            own = "\n".join(match.group() for match in _HELD.finditer(block))
            sections = {above: notice for above, notice in sections.items() if above < level} | {level: own}
        elif not block.startswith(("    ", "![")):
            rows = _rows(block) if block.startswith("|") else [block]
            section = next((notice for _, notice in sorted(sections.items(), reverse=True) if notice), "")
            yield from _of(name, [row if _HELD.search(row) else f"{row}\n{section}" for row in rows])


def _of(page: str, blocks: list[str]) -> Iterator[Promise]:
    last: tuple[str, ...] = ()
    for block in blocks:
        phrase, none = _plain(block), _NONE.search(block)
        if _PROMISES.search(phrase):
            held = [" ".join(one.split()) for whole in _HELD.findall(block) for one in re.split(r",\s+", whole)]
            same = block.split("\n")[0].endswith("| the same |")
            last = last if same and last else (*held, *_NAMED.findall(block))
            yield Promise(page, phrase, last, none.group(1) if none else "", tuple(_RESULT.findall(block)))


def _rows(block: str) -> list[str]:
    """Of a table, without its head; a remark below it applies to every row."""
    lines = block.split("\n")
    below = "\n".join(line for line in lines if not line.startswith("|"))
    rows = [line for line in lines if line.startswith("|")]
    head = 2 if len(rows) > 1 and set(rows[1]) <= set("|-: ") else 0
    return [f"{row}\n{below}" for row in rows[head:]]


def wrong_holders(promise: Promise) -> list[str]:
    """What it names and is not there: a file, or a test in it. Commands are compared with the command line
    elsewhere."""
    wrong = []
    for holder in promise.held_by:
        if holder.startswith("tests/"):
            file, _, test = holder.split(" ")[0].partition("::")
            path = ROOT / file
            if not path.exists() or (test and f"def {test.partition('[')[0]}(" not in path.read_text(encoding="utf-8")):
                wrong.append(holder)
        elif not holder.startswith(("safedpa ", "make ", "python ")):
            wrong.append(holder)
    return wrong


def table() -> str:
    """Every promise of the pages gone through, with what holds it, when that is run, and the day of its result.

    Of promises in a row that the same holds, the first is shown, and how many follow.
    """
    rows = ["| page | promise | held by | run |", "|---|---|---|---|"]
    for page in PAGES:
        reported = [each for each in promises_of(page) if not each.no_promise]
        for _, alike in groupby(reported, lambda each: (each.held_by, each.results)):
            first, *others = alike
            begun = first.text.strip("| -").replace("|", "/")
            begun = begun if len(begun) <= _LONGEST else begun[:_LONGEST].rsplit(" ", 1)[0] + " ..."
            more = f" *and {len(others)} more*" if others else ""
            held = ", ".join(f"`{holder}`" for holder in first.held_by)
            rows.append(f"| {page.stem} | {begun}{more} | {held} | {_when(first)} |")
    return "\n".join(rows)


def _when(promise: Promise) -> str:
    """Tests with every change; a command on the day that its file of results bears."""
    reported = ["with every change"] if any(holder.startswith("tests/") for holder in promise.held_by) else []
    if any(not holder.startswith("tests/") for holder in promise.held_by):
        days = sorted({day for name in promise.results if (day := _day(name))})
        reported.append(f"by command, last on {', '.join(days)}" if days else "by command")
    return "; ".join(reported)


def _day(name: str) -> str:
    path = ROOT / "docs" / "evidence" / "results" / f"{name}.json"
    document = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    return str(document.get("provenance", document).get("date", ""))[:10]


def _plain(markdown: str) -> str:
    """Words alone, one space between: links become what they show, remarks and marks of emphasis and code go."""
    text = re.sub(r"<!--.*?-->", "", markdown, flags=re.DOTALL)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)
    return re.sub(r"\s+", " ", re.sub(r"[*`>]", "", text)).strip()
