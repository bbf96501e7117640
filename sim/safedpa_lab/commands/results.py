"""``safedpa results``: which results are older than the code that made them."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import click


@click.group(name="results")
def command() -> None:
    """The provenance of results."""


_MOST_NAMED = 5
"""Packages that are named for a result; ``--json`` has all."""


@command.command(name="check")
@click.argument("folder", type=click.Path(path_type=Path), default=Path("docs/evidence/results"))
@click.option("--strict", is_flag=True, help="exit with 1 if a result is not made by the current code")
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
def _check(folder: Path, strict: bool, as_json: bool) -> int:
    """Which results are older than the code that made them.

    Each file holds its command, date, commit and a digest of each package that it uses; comments and docstrings do not
    count. Packages that differ now are listed.
    """
    from safedpa_lab.provenance.check import standings

    found = list(standings(folder))
    if as_json:
        click.echo(json.dumps({"results": [{**asdict(each), "reported": each.reported} for each in found]}))
    else:
        for each in found:
            click.echo(f"{each.name:32} {(each.date or 'no date')[:10]:10}  {each.reported}")
            if each.command:
                click.echo(f"{'':34}{each.command}")
            if each.changed:
                more = len(each.changed) - _MOST_NAMED
                rest = f" and {more} more" if more > 0 else ""
                click.echo(f"{'':34}differ: {', '.join(each.changed[:_MOST_NAMED])}{rest}")
        reported = sum(each.is_current for each in found)
        click.echo(f"{reported} of {len(found)} were made by the current code")
        dated = [each for each in found if each.date]
        if dated:
            oldest = min(dated, key=lambda each: each.date or "")
            click.echo(f"the oldest is {oldest.name}, of {(oldest.date or '')[:10]}")
    return int(strict and not all(each.is_current for each in found))
