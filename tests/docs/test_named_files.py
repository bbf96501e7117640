"""Files and modules that pages and docstrings name are there: what is renamed or joined takes its name along."""

import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SOURCES = [path for folder in ("shared", "services", "sim") for path in sorted((ROOT / folder).rglob("*.py"))]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *(page for page in sorted((ROOT / "docs").rglob("*.md")) if page.parent.name != "results"),
]
"""Records of what was measured (``docs/evidence/results``) name what was there then."""
FILE = re.compile(r"(?<![\w/.*-])(?:\.\./)*((?:[\w.-]+/)*\w+\.py)\b")
DOTTED = re.compile(r"(?<![\w/.-])safedpa(?:_services|_sim|_lab)?(?:\.[A-Za-z_]\w*)+")
OF_A_READER = re.compile(r"(my_\w+/\w+|my_\w+|[A-Z]+)\.py")
OTHERS = {"safedpa.commands", "safedpa.facts", "safedpa.target", "safedpa.fish", "safedpa.robots.NAME"}
"""Entry points, a unit of systemd, a completion, whichever robot: no modules."""


def _modules() -> dict[str, Path]:
    found: dict[str, Path] = {}
    for path in SOURCES:
        parts = path.relative_to(ROOT).with_suffix("").parts[1:]
        for end in range(1, len(parts)):
            found.setdefault(".".join(parts[:end]), path.parents[len(parts) - end - 1] / "__init__.py")
        found[".".join(parts)] = path
    return found


MODULES = _modules()
FILES = {f"/{path.relative_to(ROOT)}" for path in ROOT.rglob("*.py") if not {".venv", "build"} & set(path.parts)}


def _unknown_files(text: str) -> list[str]:
    named = (name for name in FILE.findall(text) if not OF_A_READER.fullmatch(name))
    return [name for name in named if not any(path.endswith(f"/{name}") for path in FILES)]


def _unknown_names(text: str) -> Iterator[str]:
    for name in DOTTED.findall(text):
        module = name
        while module not in MODULES:
            module = module.rpartition(".")[0]
        first = name.removeprefix(module).strip(".").partition(".")[0]
        path = MODULES[module]
        if first and name not in OTHERS and not (path.exists() and re.search(rf"\b{first}\b", path.read_text("utf-8"))):
            yield name


def test_what_each_page_names_is_there() -> None:
    assert PAGES
    texts = {page.stem: page.read_text(encoding="utf-8") for page in PAGES}
    unknown = {name: [*_unknown_files(text), *_unknown_names(text)] for name, text in texts.items()}
    assert {name: found for name, found in unknown.items() if found} == {}


def test_what_docstrings_name_is_there() -> None:
    named = {path: " ".join(re.findall(r"``([^`]+)``", path.read_text(encoding="utf-8"))) for path in SOURCES}
    found = {str(path): list(_unknown_names(text)) for path, text in named.items()}
    assert {path: names for path, names in found.items() if names} == {}


def test_what_is_gone_is_noticed() -> None:
    assert _unknown_files("`margin.py`, `safety/margins/conformal.py`, `my_robot.py`, `safety/gone.py`") == [
        "safety/gone.py"
    ]
    notice = (
        "safedpa.safety.margins.conformal, safedpa.safety.margins.conformal.OnlineMargin.update, "
        "safedpa.safety.gone, safedpa.gone.margin"
    )
    assert list(_unknown_names(notice)) == ["safedpa.safety.gone", "safedpa.gone.margin"]
