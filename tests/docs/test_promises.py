"""Every promise of the pages that were gone through names what holds it, and that is there."""

import json
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "docs"))

from promises import PAGES, Promise, promises_of, table, wrong_holders  # noqa: E402  # stands next to the pages


def test_something_holds_every_promise() -> None:
    assert PAGES
    found = {page.stem: list(promises_of(page)) for page in PAGES}
    assert [name for name, promises in found.items() if not promises] == [], "a page that promises nothing"
    every = [(name, promise) for name, promises in found.items() for promise in promises]
    assert [(name, promise.text) for name, promise in every if promise.open] == []
    assert [(name, promise.text, wrong) for name, promise in every if (wrong := wrong_holders(promise))] == []


def _written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> list[Promise]:
    monkeypatch.setattr("promises.ROOT", tmp_path)
    page = tmp_path / "page.md"
    page.write_text(text, encoding="utf-8")
    return list(promises_of(page))


@pytest.mark.parametrize("text", ["It never stops.", "- It takes 3 s.", "| it | 40 us |", "Nothing is lost."])
def test_a_promise_that_nothing_holds_is_noticed(text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (promise,) = _written(tmp_path, monkeypatch, f"# Page 1\n\nSome words.\n\n{text}\n")
    assert promise.open


def test_a_promise_with_a_test_or_marked_as_none_is_not_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (
        "It never stops.\n<!-- held: tests/docs/test_promises.py::test_it,\nsafedpa experiment safety -->\n\n"
        "It is 3 years old.\n<!-- no promise: history -->\n\n"
        "| collisions | 0 | `safedpa experiment safety` |\n| goals | 5 | the same |\n"
    )
    never, old, collisions, goals = _written(tmp_path, monkeypatch, text)
    assert never.held_by == ("tests/docs/test_promises.py::test_it", "safedpa experiment safety")
    assert old.no_promise == "history"
    assert collisions.held_by == goals.held_by == ("safedpa experiment safety",)
    assert not any(each.open for each in (never, old, collisions, goals))


def test_a_remark_below_a_heading_counts_for_its_section(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (
        "# Page\n\nIt takes 1 s.\n\n## A\n<!-- held: tests/docs -->\n\nIt never stops.\n\n- Nothing is lost.\n"
        "  <!-- held: tests/bus -->\n\n| it | 40 us |\n\n## B\n\nIt is 3 m long.\n"
    )
    found = [each.held_by for each in _written(tmp_path, monkeypatch, text)]
    assert found == [(), ("tests/docs",), ("tests/bus",), ("tests/docs",), ()]


@pytest.mark.parametrize(
    "holder",
    [
        "tests/docs/test_nothing.py",
        "tests/docs/test_promises.py::test_that_no one_wrote",
        "faith",
        "docs/evidence/claims.md",
    ],
)
def test_a_holder_that_is_not_there_is_named(holder: str) -> None:
    assert wrong_holders(Promise("README.md", "It never stops.", (holder,))) == [holder]


def test_a_test_that_is_there_holds() -> None:
    held = ("tests/docs/test_promises.py::test_a_test_that_is_there_holds", "tests/docs", "safedpa experiment safety")
    assert wrong_holders(Promise("README.md", "It never stops.", held)) == []


def test_the_table_shows_when_a_command_was_run_last() -> None:
    (row,) = [line for line in table().splitlines() if line.startswith("| claims | the demonstration in 20 scenes")]
    date = json.loads((ROOT / "docs" / "evidence" / "results" / "demo.json").read_text(encoding="utf-8"))["date"]
    assert row.endswith(f"| `safedpa experiment demo` | by command, last on {date} |")
