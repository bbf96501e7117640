"""Every command, option, default and page that the program had at the commit of ``abilities.json`` is still there.

The file also lists what has been renamed since then.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import pytest

from safedpa_services.command_line.group import safedpa

ROOT = Path(__file__).parents[2]
LISTED = json.loads((Path(__file__).parent / "abilities.json").read_text("utf-8"))
SIMPLE = (bool, int, float, str)


def described(item: click.Parameter) -> dict[str, Any]:
    """A row of the list."""
    with click.Context(click.Command("any")) as context:
        default = item.get_default(context)
    option = isinstance(item, click.Option)
    kind = item.type.to_info_dict()
    row: dict[str, Any] = {
        "names": [*item.opts, *item.secondary_opts] if option else [item.name],
        "type": kind["param_type"],
        "default": str(default) if isinstance(default, Path) else default if isinstance(default, SIMPLE) else None,
    }
    if option and item.multiple:  # type: ignore[attr-defined]
        row["repeatable"] = True
    if item.required:
        row["required"] = True
    return row | ({"choices": [str(one) for one in kind["choices"]]} if "choices" in kind else {})


def commands(group: click.Group, prefix: str = "") -> Iterator[tuple[str, click.Command]]:
    """Every command below a group, with its name as it is typed."""
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        if isinstance(command, click.Group):
            yield from commands(command, f"{prefix}{name} ")
        else:
            yield f"{prefix}{name}", command


@pytest.fixture(scope="module")
def present() -> dict[str, list[dict[str, Any]]]:
    return {name: [described(item) for item in command.params] for name, command in commands(safedpa)}


def test_every_command_is_there(present: dict[str, Any]) -> None:
    assert sorted(set(LISTED["commands"]) - set(present)) == []


@pytest.mark.parametrize("name", sorted(LISTED["commands"]))
def test_the_options_of_each_command_are_there_with_their_defaults(name: str, present: dict[str, Any]) -> None:
    rows = [
        row | {"names": [LISTED["renamed options"].get(n, n) for n in row["names"]]} for row in LISTED["commands"][name]
    ]
    assert [row for row in rows if not any(_offers(item, row) for item in present[name])] == []


def _offers(present: dict[str, Any], listed: dict[str, Any]) -> bool:
    """Whether a parameter is as it is listed; a choice may have become wider."""
    return set(listed.get("choices", ())) <= set(present.get("choices", ())) and (
        present | {"choices": None} == listed | {"choices": None}
    )


def test_every_page_of_the_documentation_is_there() -> None:
    pages = [LISTED["moved documents"].get(page, page) for page in LISTED["documents"]]
    assert len(pages) > 100
    assert [page for page in pages if not (ROOT / page).is_file()] == []
