"""Counts words per part of the documentation, and the length of its sentences: ``python docs/measure.py``.

A sentence is a piece of running text that ends with a full stop, a question mark, an exclamation mark or a colon at the
end of a paragraph. Code, tables, headings and generated parts count as words of the part, but not as sentences.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

PAGES = Path(__file__).parent
PARTS = ("tutorials", "guides", "reference", "explanation", "evidence", "developers")
LONG = 30
"""Words; more are hard to read at once."""
_NOT_TEXT = (r"^```.*?^```$", r"<!-- generated.*?<!-- end -->", r"<!--.*?-->", r"^#.*?$", r"^\|.*?$", r"^    .*?$")


def sentences(text: str) -> list[str]:
    """Sentences of the running text of a page."""
    for kind in _NOT_TEXT:
        text = re.sub(kind, "\n\n", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"!\[[^\]]*\]\([^)]*\)", "", text)
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"`[^`]*`", "CODE", text)
    blocks = re.split(r"\n\s*\n|\n(?=\s*(?:[-*]|\d+\.) )", text)
    found = [
        part
        for block in blocks
        for part in re.split(r"(?<=[.!?])[\"')*]*\s+(?=[\"'(*]*[A-Z])", " ".join(block.split()))
    ]
    return [part for part in found if len(part.split()) > 2]


def measured(pages: list[Path]) -> tuple[int, int, int, float, float]:
    """Length of the text, generated parts of it, sentences, mean length, and the share above thirty in %."""
    texts = [page.read_text(encoding="utf-8") for page in pages]
    lengths = [len(sentence.split()) for text in texts for sentence in sentences(text)]
    count = max(len(lengths), 1)
    length, generated = (sum(map(_length_of, parts)) for parts in (texts, map(_generated, texts)))
    return length, generated, len(lengths), sum(lengths) / count, 100 * sum(one > LONG for one in lengths) / count


def _length_of(text: str) -> int:
    """Words and numbers, without the bars of tables, list marks and comments."""
    return len(re.findall(r"\S*\w\S*", re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)))


def _generated(text: str) -> str:
    return " ".join(re.findall(_NOT_TEXT[1], text, flags=re.DOTALL))


def main() -> None:
    """Prints one row for each part and one for all of them; with ``--pages`` also one for each page."""
    rows = [(part, sorted((PAGES / part).rglob("*.md"))) for part in PARTS]
    every = [*PAGES.glob("*.md"), *(page for _, pages in rows for page in pages)]
    if "--pages" in sys.argv:
        rows += [(str(page.relative_to(PAGES)), [page]) for page in every]
    sys.stdout.write(f"{'part':44} words generated sentences mean above {LONG} (%)\n")
    for name, pages in [*rows, ("all", every)]:
        length, generated, count, mean, long = measured(pages)
        sys.stdout.write(f"{name:44} {length:5d} {generated:9d} {count:9d} {mean:4.1f} {long:12.1f}\n")


if __name__ == "__main__":
    main()
