"""Each heading of the pages that claims something is listed in ``docs/evidence/claims.toml`` with what tests it."""

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
CLAIMS: dict[str, dict[str, list[str]]] = tomllib.loads((DOCS / "evidence" / "claims.toml").read_text(encoding="utf-8"))
PARTS = ("tutorials", "guides", "reference", "explanation", "evidence")
LISTS = {"index.md", "gallery.md", "commands.md", "glossary.md", "versions.md"}
"""Pages that lead elsewhere, explain terms or are generated from the command line."""
FINE = ("README.md", "guides/barriers.md", "guides/column-maps.md", "guides/safety.md")
"""Pages that everybody reads first: an entry at the title covers no section below it."""
CLAIMING = re.compile(
    r"\d|\b(always|at least|at most|bit for bit|cannot|each|every|everything|exactly|never|no|none|nothing|only|"
    r"refused|refuses|same)\b",
    re.IGNORECASE,
)
COMMANDS = ("safedpa ", "make ", "python ", "deploy/")


def read(page: str) -> str:
    return (ROOT / page if page == "README.md" else DOCS / page).read_text(encoding="utf-8")


def plain(markdown: str) -> str:
    shown = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", markdown)
    return " ".join(re.sub(r"[*`>]", "", shown).split())


def sections(text: str) -> Iterator[tuple[list[str], str]]:
    """Headings above each section, from the title down, and its text without code and without generated tables."""
    for hidden in (r"^```.*?^```$", r"<!-- generated.*?<!-- end -->"):
        text = re.sub(hidden, "", text, flags=re.DOTALL | re.MULTILINE)
    parts = re.split(r"^(#{1,6} .+)$", text, flags=re.MULTILINE)
    above: dict[int, str] = {}
    for heading, section in zip(parts[1::2], parts[2::2], strict=True):
        level = len(heading) - len(heading.lstrip("#"))
        above = {other: name for other, name in above.items() if other < level} | {level: plain(heading.lstrip("# "))}
        yield list(above.values()), section


def unmapped(text: str, entries: dict[str, list[str]]) -> list[str]:
    """Headings of sections that claim something, while neither they nor one above them has an entry."""
    return [
        names[-1]
        for names, section in sections(text)
        if CLAIMING.search(plain(section)) and not any(name in entries for name in names)
    ]


def parts_of_page(text: str) -> str:
    """The same page without its title's level: each section has to have an entry of its own or of a section above."""
    title = re.search(r"^# .+$", text, re.MULTILINE)
    return text if title is None else text[title.end() :]


def stale(text: str, entries: dict[str, list[str]]) -> list[str]:
    """Entries that are neither a heading of the page nor the first cell of a row."""
    names = {above[-1] for above, _ in sections(text)}
    names |= {plain(line.strip("| ").split(" | ")[0]) for line in text.splitlines() if line.startswith("|")}
    return [key for key in entries if key not in names]


def exists(holder: str) -> bool:
    """A command is compared with the command line in test_pages."""
    if holder.startswith("results/"):
        return (DOCS / "evidence" / holder).is_file()
    if not holder.startswith("tests/"):
        return holder.startswith(COMMANDS)
    file, _, test = holder.partition("::")
    path = ROOT / file
    return path.exists() and (not test or f"def {test.partition('[')[0]}(" in path.read_text(encoding="utf-8"))


def pages() -> list[str]:
    found = [path for part in PARTS for path in sorted((DOCS / part).glob("*.md")) if path.name not in LISTS]
    return ["README.md", *(str(path.relative_to(DOCS)) for path in found)]


@pytest.mark.parametrize("page", pages())
def test_each_claiming_heading_of_a_page_is_mapped(page: str) -> None:
    assert unmapped(read(page), CLAIMS.get(page, {})) == []


@pytest.mark.parametrize("page", FINE)
def test_each_section_of_a_page_that_is_read_first_has_an_entry_of_its_own(page: str) -> None:
    assert unmapped(parts_of_page(read(page)), CLAIMS[page]) == []


@pytest.mark.parametrize("page", sorted(CLAIMS))
def test_each_entry_names_a_heading_or_row_and_what_exists(page: str) -> None:
    assert stale(read(page), CLAIMS[page]) == []
    assert {
        key: missing for key, all_of in CLAIMS[page].items() if (missing := [x for x in all_of if not exists(x)])
    } == {}
    assert [
        key for key, all_of in CLAIMS[page].items() if not any(x.startswith(("tests/", *COMMANDS)) for x in all_of)
    ] == []


def test_pages_carry_no_comments_that_map_claims() -> None:
    marked = [path.name for path in DOCS.rglob("*.md") if re.search(r"<!-- (held|no promise)", path.read_text("utf-8"))]
    assert marked == []


@pytest.mark.parametrize("claim", ["It never stops.", "- It takes 3 s.", "| it | 40 us |", "Nothing is lost."])
def test_a_claim_without_an_entry_is_noticed(claim: str) -> None:
    text = f"# Page 1\n\nSome text.\n\n## A `part`\n\n{claim}\n"
    assert unmapped(text, {}) == ["A part"]
    assert unmapped(text, {"A part": []}) == unmapped(text, {"Page 1": []}) == []


def test_an_entry_of_what_is_gone_is_noticed() -> None:
    assert stale("# Page\n\n| a goal | 3 |\n", {"Page": [], "a goal": [], "another": []}) == ["another"]


@pytest.mark.parametrize(
    "holder",
    ["tests/docs/test_nothing.py", "tests/docs/test_claims.py::test_that_no one_wrote", "faith", "results/none.json"],
)
def test_a_holder_that_does_not_exist_is_noticed(holder: str) -> None:
    assert not exists(holder)
    assert exists("tests/docs/test_claims.py::test_a_holder_that_does_not_exist_is_noticed")
