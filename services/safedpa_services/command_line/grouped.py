"""A command whose ``--help`` shows its options under headings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import click

__all__ = ["Grouped"]


class Grouped(click.Command):
    """``groups``: heading to names of parameters; one may stand under several, and what is in none comes last."""

    def __init__(self, *arguments: Any, groups: Mapping[str, Sequence[str]], **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.groups = groups

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Writes a section for each heading."""
        records = {item.name: item.get_help_record(ctx) for item in self.get_params(ctx)}
        named = {name for names in self.groups.values() for name in names}
        rest = [name for name in records if name not in named]
        for heading, names in (*self.groups.items(), ("Options", rest)):
            rows = [row for row in (records.get(name) for name in names) if row is not None]
            if rows:
                with formatter.section(heading):
                    formatter.write_dl(rows)
