"""The project writes the field's vocabulary: ``dictionary.txt`` and ``words.toml`` list what it does not write.

    python tests/architecture/test_words.py [PATH ...]     each finding below PATH as FILE:LINE; then counts by folder

Identifiers are checked by their parts, texts (comments, docstrings, literals, pages, help, styles) by words and
phrases.
"""

import io
import re
import subprocess
import sys
import tokenize
import tomllib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
HERE = Path(__file__).parent
LIST = tomllib.loads((HERE / "words.toml").read_text("utf-8"))
DICTIONARY = dict(line.split("->") for line in (HERE / "dictionary.txt").read_text("utf-8").splitlines())
SAFETY = "shared/safedpa/safety/"
TEXTS = (
    ".md",
    ".cpp",
    ".mjs",
    ".toml",
    ".yml",
    ".yaml",
    ".js",
    ".css",
    ".html",
    ".cfg",
    ".sh",
    ".ipynb",
    "Makefile",
    "Dockerfile",
)
NOT_OURS = ("docs/evidence/results/", "docs/pictures/", "constraints.txt")
"""Measured results and drawings are made by code; their texts come from it."""

WORDS = re.compile(rf"\b({'|'.join(DICTIONARY)})\b", re.IGNORECASE)
PHRASES = re.compile("|".join(f"(?:{phrase})" for phrase in LIST["phrases"]).replace(" ", r"\s+"), re.IGNORECASE)
PARTS = {*DICTIONARY, *LIST["identifiers"]}
SAFETY_PARTS = PARTS | set(LIST["safety"])
NAMES = re.compile(r"(?:``[^`\n]+``|`[^`\n]+`|https?://\S+)")


def parts(name: str) -> list[str]:
    """``LastWish_of`` is last, wish, of."""
    return re.findall(r"[a-z]+", re.sub(r"([A-Z])", r"_\1", name).lower() if not name.isupper() else name.lower())


def in_text(text: str) -> Iterator[tuple[int, str]]:
    """Line offset and match of each word and phrase in a text; names in backquotes are identifiers."""
    plain = NAMES.sub(lambda found: " " * len(found[0]), text)
    joined = re.sub(r"\n[ \t]*(?:# ?)?", lambda found: " " * len(found[0]), plain)
    for pattern in (WORDS, PHRASES):
        for found in pattern.finditer(joined):
            yield text.count("\n", 0, found.start()), found[0]


def in_python(source: str, safety: bool) -> Iterator[tuple[int, str]]:
    """Line and name, word or phrase of each finding in Python source."""
    forbidden, comments = SAFETY_PARTS if safety else PARTS, []
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        line = token.start[0]
        if token.type == tokenize.NAME:
            if forbidden.intersection(parts(token.string)):
                yield line, token.string
        elif token.type == tokenize.COMMENT:
            comments.append((line, token.string))
        elif token.type == tokenize.STRING:
            yield from ((line + offset, found) for offset, found in in_text(token.string))
    for line, comment in comments:
        yield from ((line, found) for _, found in in_text(comment))


def files() -> list[str]:
    """What git tracks, or will."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\n")


def findings(prefixes: tuple[str, ...] = ("",)) -> Iterator[tuple[str, int, str]]:
    """File, line and finding, of the files whose paths begin so."""
    for name in files():
        path = ROOT / name
        ours = name.startswith(prefixes) and not name.startswith(NOT_OURS) and name not in LIST["exempt"]["files"]
        if not ours or not path.is_file():
            continue
        if name.endswith(".py"):
            found = in_python(path.read_text("utf-8"), name.startswith(SAFETY))
        elif name.endswith(TEXTS):
            found = ((line + 1, match) for line, match in in_text(path.read_text("utf-8")))
        else:
            continue
        yield from ((name, line, match) for line, match in found)


@pytest.mark.parametrize("folder", ["shared", "services", "sim", "deploy", "docs", "tests", ""])
def test_no_word_of_the_list_is_written(folder: str) -> None:
    rest = [f"{name}:{line}: {found}" for name, line, found in findings((f"{folder}/",) if folder else ("",))]
    if not folder:
        rest = [text for text in rest if "/" not in text.split(":")[0]]
    assert not rest, f"{len(rest)} findings, such as {rest[:10]}; tests/architecture/words.toml has what to write"


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("last_wish = 1", ["last_wish"]),
        ("class WishMessage: pass", ["WishMessage"]),
        ("swish = trailer = toldo = 1", []),
        ('x = "The model was told\\n   once."', ["told"]),
        ("x = 1  # somebody waits", ["somebody"]),
        ("x = '''all conditions are\n    kept'''", ["conditions are\n    kept".replace("\n    ", "     ")]),
        ("x = '``told`` is a name'", []),
        ("x = 'kept files are listed'", []),
    ],
)
def test_identifiers_are_checked_by_parts_and_texts_by_words(source: str, found: list[str]) -> None:
    assert [match for _, match in in_python(source, safety=False)] == found


if __name__ == "__main__":
    every = list(findings(tuple(sys.argv[1:]) or ("",)))
    for name, line, match in every:
        print(f"{name}:{line}: {match}")
    by_folder = Counter("/".join(name.split("/")[:3]) for name, _, _ in every)
    print(*(f"{count:6} {folder}" for folder, count in by_folder.most_common()), sep="\n")
    print(f"{len(every)} findings")
