"""Safe plain-text output: text from the bus or from files cannot move the cursor, change colours or hide other text.

Without Rich, whose import takes longer than a short command; ``terminal.py`` is for tables and live views.
"""

from __future__ import annotations

import click

from safedpa.limits import readable

_LONGEST_LINE = 4000


def print_plain(text: str, *, err: bool = False) -> None:
    """Prints lines that contain foreign text; unprintable characters are replaced and long lines cut."""
    click.echo("\n".join(readable(line, _LONGEST_LINE) for line in text.split("\n")), err=err)
