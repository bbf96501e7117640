"""The site is built without a complaint, every link in it leads somewhere, and nothing of it is fetched."""

import importlib
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

pytestmark = [
    pytest.mark.long,
    pytest.mark.slow,
    pytest.mark.skipif(
        find_spec("material") is None or find_spec("mkdocstrings") is None,
        reason="mkdocs is not installed; say pip install 'safedpa[docs]'",
    ),
]


class Page(HTMLParser):
    """What a page refers to, what it fetches by itself, and where one may jump to in it."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.fetched: list[str] = []
        self.anchors: set[str] = set()
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = {name: value or "" for name, value in attrs}
        if "id" in found:
            self.anchors.add(found["id"])
        if tag == "a" and "href" in found:
            self.links.append(found["href"])
        if tag in ("img", "script", "iframe", "source", "video") and found.get("src"):
            self.fetched.append(found["src"])
        if tag == "link" and found.get("rel") not in ("canonical", "next", "prev"):
            self.fetched.append(found.get("href", ""))


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory, repository: Path) -> Path:
    folder = tmp_path_factory.mktemp("site") / "site"
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", folder]
    plain = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=repository, capture_output=True, text=True, check=False, env=plain)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, Page]:
    return {path: Page(path) for path in sorted(site.rglob("*.html"))}


def _inside(pages: dict[Path, Page], which: str) -> Iterator[tuple[Path, str]]:
    for path, page in pages.items():
        if path.name != "404.html":
            yield from ((path, target) for target in getattr(page, which))


def test_every_link_leads_to_a_page_and_to_a_place_in_it(pages: dict[Path, Page]) -> None:
    broken = []
    for path, target in _inside(pages, "links"):
        parts = urlsplit(target)
        if parts.scheme in ("http", "https", "mailto"):
            continue
        to = (path.parent / unquote(parts.path)).resolve() if parts.path else path
        to = to / "index.html" if to.is_dir() else to
        anchored = not parts.fragment or to not in pages or unquote(parts.fragment) in pages[to].anchors
        top = parts.fragment in ("", "__skip", "__drawer")
        if not to.exists() or not (anchored or top):
            broken.append(f"{path.name}: {target}")
    assert not broken


def test_nothing_is_fetched_from_elsewhere(pages: dict[Path, Page], site: Path) -> None:
    for path, target in _inside(pages, "fetched"):
        if target.startswith("data:"):
            continue
        assert not urlsplit(target).scheme, f"{path.name} fetches {target}"
        assert not target.startswith("//"), f"{path.name} fetches {target}"
        assert (path.parent / urlsplit(target).path).exists(), f"{path.name}: {target}"
    for sheet in site.rglob("*.css"):
        assert not re.search(r"(@import|url\()\s*[\"']?(https?:)?//", sheet.read_text(encoding="utf-8")), sheet


def test_the_search_finds_pages_opened_as_files(site: Path) -> None:
    text = (site / "search" / "search_index.js").read_text(encoding="utf-8")
    entries = json.loads(text.removeprefix("var __index = "))["docs"]
    for phrase, page in (
        ("slack", "glossary.html"),
        ("systemd", "install.html"),
        ("SafetyFilter", "reference/python/safety"),
    ):
        assert any(phrase in entry["text"] + entry["title"] and page in entry["location"] for entry in entries), phrase


def test_the_tabs_hold_45_pages_and_the_first_page_leads_to_all_others(site: Path, repository: Path) -> None:
    tabs = (repository / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:\n")[2]
    assert tabs.count(".md\n") <= 45
    docs = repository / "docs"
    linked = (docs / "index.md").read_text(encoding="utf-8")
    for part in ("tutorials", "guides", "reference", "explanation"):
        for page in sorted((docs / part).glob("*.md")):
            assert f"({page.relative_to(docs)})" in linked, page
    for part in ("evidence", "developers", "reference/python"):  # a first page of their own leads to them
        assert f"{part}/index.md" in linked
        first = (docs / part / "index.md").read_text(encoding="utf-8")
        pages = (page.relative_to(docs / part) for page in (docs / part).rglob("*.md"))
        assert [page for page in pages if page.name != "index.md" and f"({page})" not in first] == []
    built = {path.relative_to(site).with_suffix("").as_posix() for path in site.rglob("*.html")}
    assert {"index", "reference/glossary", "reference/python/safety", "tutorials/diagnose_a_log", "CHANGELOG"} <= built


def test_the_reference_holds_every_public_name(site: Path, repository: Path) -> None:
    for page in sorted((repository / "docs" / "reference" / "python").glob("*.md")):
        if page.stem == "index":
            continue
        text = (site / "reference" / "python" / f"{page.stem}.html").read_text(encoding="utf-8")
        shown = set(re.findall(r'id="safedpa\.[\w.]*?(\w+)"', text))
        lazily = {"GymnasiumSafetyFilter", "GymnasiumVectorSafetyFilter"}  # imported when they are asked for
        package = "safedpa" if page.stem == "api" else f"safedpa.{page.stem}"
        public = [name for name in getattr(importlib.import_module(package), "__all__", []) if name[0] != "_"]
        assert set(public) - lazily <= shown, page
    assert "compare_model" in (site / "reference" / "python" / "diagnosis.html").read_text(encoding="utf-8")


def test_diagrams_are_painted_without_a_script(site: Path, repository: Path) -> None:
    texts = [page.read_text(encoding="utf-8") for page in (repository / "docs").rglob("*.md")]
    drawn = sum(text.count("```mermaid") for text in texts)
    shown = [
        (page, name)
        for page in site.rglob("*.html")
        for name in re.findall(r'src="([^"]*diagram-[0-9a-f]+\.svg)"', page.read_text(encoding="utf-8"))
    ]
    assert len(shown) == drawn > 1
    for page, name in shown:
        picture = (page.parent / name).resolve()
        assert picture.exists(), f"{name}: run python docs/draw_diagrams.py"
        svg = picture.read_text(encoding="utf-8")
        assert svg.count("<text") > 5
        assert "foreignObject" not in svg, "a picture of its own shows no part of a page"
    assert not any("language-mermaid" in page.read_text(encoding="utf-8") for page in site.rglob("*.html"))
