"""Arguments and options that several commands share."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import click

Command = TypeVar("Command", bound=Callable[..., Any])

PATH = click.Path(path_type=Path)
"""A file or folder, given to the command as a ``pathlib.Path``."""

runs_argument = click.argument("runs", metavar="RUN...", nargs=-1, required=True)
columns_option = click.option(
    "--columns", help="Column map (TOML), or the name of a shipped one, such as dart_car_columns."
)
effects_option = click.option(
    "--effects",
    "--robot-file",
    "effects",
    type=PATH,
    metavar="FILE.py",
    help="Python file with your own effects, systems and robots.",
)
recordings_option = click.option(
    "--out", type=PATH, default=Path("runs"), show_default=True, help="folder for recordings"
)
force_option = click.option("--force", is_flag=True, help="Allow replacing an input file or an earlier result.")
as_json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON document and nothing else.")


def horizon_option(default: float | None = 1.0) -> Callable[[Command], Command]:
    """Returns the option ``--horizon`` in seconds; required if there is no default."""
    shown: dict[str, Any] = {"required": True} if default is None else {"default": default, "show_default": True}
    return click.option("--horizon", type=float, metavar="SECONDS", help="How far to predict.", **shown)


def folder_option(what: str) -> Callable[[Command], Command]:
    """Returns the option ``--out``: the folder for ``what``."""
    return click.option(
        "--out",
        type=PATH,
        default=None,
        metavar="DIR",
        help=f"Folder for {what}; default: a new one, named after model and time.",
    )


def run_options(command: Command) -> Command:
    """Adds RUN..., --columns, --horizon, --effects and --json, in this order on the help page."""
    for option in (as_json_option, effects_option, horizon_option(), columns_option, runs_argument):
        command = option(command)
    return command


class GroupedCommand(click.Command):
    """A command whose help groups its options.

    ``groups`` maps a heading to names of parameters. A parameter may be in several groups; those in none come last.
    """

    def __init__(self, *arguments: Any, groups: Mapping[str, Sequence[str]], **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.groups = groups

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Writes one section per heading."""
        records = {item.name: item.get_help_record(ctx) for item in self.get_params(ctx)}
        named = {name for names in self.groups.values() for name in names}
        rest = [name for name in records if name not in named]
        for heading, names in (*self.groups.items(), ("Options", rest)):
            rows = [row for row in (records.get(name) for name in names) if row is not None]
            if rows:
                with formatter.section(heading):
                    formatter.write_dl(rows)
