"""Lines of plain text for people: names and sentences of others move no cursor, colour nothing and hide nothing."""

from __future__ import annotations

import click

from safedpa.limits import readable

__all__ = ["print_plain"]

_LONGEST_LINE = 4000


def print_plain(text: str, *, err: bool = False) -> None:
    """Prints lines that others had a part in."""
    click.echo("\n".join(readable(line, _LONGEST_LINE) for line in text.split("\n")), err=err)
