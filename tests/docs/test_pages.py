"""Commands in pages are understood by the command line; the README is short; the glossary has its pictures."""

import re
import shlex
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import click
import pytest

from safedpa_services.command_line.group import COMMANDS, safedpa

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
SYNTAX = re.compile(r"[A-Z]{2,}(\.\.\.)?|\.\.\.|\[|\|")
"""A line that says what a command takes, no command to type: MODEL, RUN..., [--json]."""
CLAIMED = tomllib.loads((ROOT / "docs" / "evidence" / "claims.toml").read_text(encoding="utf-8"))
"""By page, below ``docs``: headings with the commands and tests of what they claim."""
FAST = ("safedpa effects --robot car", "safedpa --version", "safedpa up --help")


def _blocks(text: str) -> Iterator[str]:
    """Lines of indented blocks, and of fenced ones for a shell."""
    fence = ""
    for line in text.splitlines():
        if line.startswith("```"):
            fence = "" if fence else line
            continue
        if fence in ("```sh", "```bash", "```shell", "```console") or (not fence and line.startswith("    ")):
            yield line.strip()


def _commands() -> Iterator[tuple[str, str]]:
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        name = str(page.relative_to(ROOT))
        for line in _blocks(text):
            whole = line.split("   #")[0].split("  # ")[0].strip()
            if re.match(r"(/opt/safedpa/bin/)?safedpa\b", whole):
                yield name, whole.removeprefix("/opt/safedpa/bin/")
        for found in re.findall(r"`(safedpa [a-z][^`]*)`", text):
            yield name, found
    for page, claims in CLAIMED.items():
        yield from ((page, item) for all_of in claims.values() for item in all_of if item.startswith("safedpa "))


LONGEST = 1500
"""Words of running text on a page; tables, code and what is generated are looked up, remarks are not seen."""


def _running_text(text: str) -> str:
    for kind in (r"^```.*?^```", r"^<!-- generated.*?<!-- end -->", r"<!--.*?-->"):
        text = re.sub(kind, " ", text, flags=re.DOTALL | re.MULTILINE)
    return "\n".join(line for line in text.split("\n") if not line.lstrip().startswith("|") and line[:4] != "    ")


def test_each_page_can_be_read_in_one_go() -> None:
    pages = [page for page in PAGES if page.parent.name not in ("results", "python")]
    phrase = {page.stem: len(_running_text(page.read_text(encoding="utf-8")).split()) for page in pages}
    assert phrase
    assert {name: count for name, count in phrase.items() if count >= LONGEST} == {}


FOUND = sorted(set(_commands()))


def _parsed(phrase: list[str], *, is_whole: bool) -> None:
    """Parses as the command line would, and runs nothing. Raises click's error for what it does not understand.

    A name alone, ``safedpa calibrate`` in a sentence, is a command to type only if it ``is_whole``.
    """
    group: click.Command = safedpa
    context = click.Context(safedpa, info_name="safedpa")
    while isinstance(group, click.Group) and phrase and not phrase[0].startswith("-"):
        command = group.get_command(context, phrase[0])
        assert command is not None
        group, phrase = command, phrase[1:]
        context = click.Context(command, info_name=command.name, parent=context)
    if phrase[:1] == ["--version"]:
        return
    plain = [word for word in phrase if word not in ("-h", "--help", "...")]
    given, _, _ = group.make_parser(context).parse_args(list(plain))
    is_whole = plain == phrase and (bool(phrase) or is_whole) and not any(map(SYNTAX.search, phrase))
    for item in group.params:
        value = given.get(item.name or "")
        if is_whole and item.required and value in (None, ()):
            raise click.UsageError(f"{item.name} is missing")
        if isinstance(item.type, click.Choice) and isinstance(value, str) and not SYNTAX.search(value):
            item.type.convert(value, item, context)


def test_the_pages_hold_commands() -> None:
    assert len(FOUND) > 100
    assert {command.split()[1] for _, command in FOUND if len(command.split()) > 1} >= set(COMMANDS) - {"go", "reject"}


@pytest.mark.long
def test_every_command_of_every_page_is_understood() -> None:
    wrong = []
    for page, command in FOUND:
        plainly = re.sub(r"\$\([^)]*\)", "FILE", command)
        phrase = shlex.split(re.split(r" (?:\||>|&&|;|&) ?", plainly)[0].replace("\\", ""))[1:]
        plain = [word if word == "..." else word.strip("[]") for word in phrase if word != "\u2026"]
        try:
            _parsed(plain, is_whole=page in CLAIMED)
        except click.ClickException as error:
            wrong.append(f"{page}: {command}: {error.format_message()}")
    assert wrong == []


@pytest.mark.parametrize("command", FAST)
def test_the_fast_ones_run(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert safedpa.run(command.split()[1:]) == 0
    assert capsys.readouterr().out


README_LEADS_TO = (
    "tutorials/start", "guides/diagnosis", "guides/own-system", "guides/run-a-fleet", "evidence/claims",
    "reference/glossary", "guides/troubleshooting", "index",
)  # fmt: skip


def test_the_readme_is_short_and_leads_on() -> None:
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 120
    text = "\n".join(lines)
    for page in README_LEADS_TO:
        assert f"(docs/{page}.md)" in text, page


@pytest.mark.parametrize("page", ["index", "tutorials/gallery", *README_LEADS_TO[4:]])
def test_a_page_of_the_front_is_short(page: str) -> None:
    assert len((ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8").split()) < 1500


def test_each_picture_of_the_glossary_is_drawn_by_its_program(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is an extra")
    sys.path.insert(0, str(ROOT / "docs"))
    from draw_glossary import FOLDER, PICTURES, draw

    page = (ROOT / "docs" / "reference" / "glossary.md").read_text(encoding="utf-8")
    retained = {path.stem for path in FOLDER.glob("*.svg")}
    assert retained == set(PICTURES) == set(re.findall(r"\(\.\./pictures/glossary/(\w+)\.svg\)", page))
    assert draw("h", tmp_path).read_text(encoding="utf-8").startswith("<?xml")
