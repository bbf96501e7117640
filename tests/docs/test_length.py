"""Pages are short, and so are their sentences; ``python docs/measure.py --pages`` shows which are not."""

import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parents[2] / "docs"
sys.path.insert(0, str(DOCS))

from measure import measured, sentences  # noqa: E402  # next to the pages


def test_evidence_and_developer_pages_stay_short() -> None:
    pages = [page for part in ("evidence", "developers") for page in (DOCS / part).rglob("*.md")]
    length, *_ = measured(pages)
    assert 0 < length <= 25_000


def test_sentences_are_short_on_average_and_hardly_ever_long() -> None:
    _, _, count, mean, long = measured(sorted(DOCS.rglob("*.md")))
    assert count > 1000
    assert mean <= 16
    assert long <= 2


PAGE = """# A title

One short sentence. And `safedpa up` is
another one.

| a | b |

```sh
ls . Files
```

- A short item.
"""


def test_code_tables_and_headings_are_no_sentences() -> None:
    assert sentences(PAGE) == ["One short sentence.", "And CODE is another one.", "- A short item."]
