"""Pages are short, and so are their sentences; ``python docs/measure.py --pages`` shows which are not."""

import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parents[2] / "docs"
sys.path.insert(0, str(DOCS))

from measure import (  # noqa: E402  # next to the pages
    LONG,
    PARTS,
    READ,
    docstrings,
    generated,
    helps,
    in_navigation,
    lengths,
    pages_of,
    sentences,
    text_of,
    word_count,
)

TEXTS = [text_of(page) for part in ("", *PARTS) for page in pages_of(part)]


def test_tutorials_guides_and_written_reference_stay_short() -> None:
    pages = [text_of(page) for part in READ for page in pages_of(part)]
    written = sum(map(word_count, pages)) - sum(map(generated, pages))
    assert 10_000 < written <= 30_000


def test_all_pages_together_stay_short() -> None:
    assert 10_000 < sum(word_count(text) for text in TEXTS) <= 60_000


def test_the_main_navigation_is_short() -> None:
    assert 10 < in_navigation() <= 45


def test_sentences_are_short_on_average_and_hardly_ever_long() -> None:
    running = [len(one.split()) for text in TEXTS for one in sentences(text)]
    of_all = [length for text in TEXTS for length in lengths(text)]
    assert len(of_all) > len(running) > 1000
    for found in (running, of_all):
        assert sum(found) / len(found) <= 16
        assert sum(one > LONG for one in found) / len(found) <= 0.02


def test_help_and_docstrings_have_short_sentences() -> None:
    for texts in (helps(), docstrings()):
        found = [length for text in texts for length in lengths(text)]
        assert len(found) > 100
        assert sum(found) / len(found) <= 16
        assert sum(one > LONG for one in found) / len(found) <= 0.02


PAGE = """# A title

One short sentence. And `safedpa up` is
another one.

| a | A cell of words. The next one. |

```sh
ls . Files
```

- A short item.
"""


def test_code_and_headings_are_no_sentences_and_cells_of_tables_are_found_apart() -> None:
    assert sentences(PAGE) == ["One short sentence.", "And CODE is another one.", "- A short item."]
    assert sentences(PAGE, tables=True) == ["A cell of words.", "The next one."]
