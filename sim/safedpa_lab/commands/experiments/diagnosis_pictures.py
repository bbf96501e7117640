"""``safedpa experiment diagnosis-pictures``: the pictures of docs/diagnosis.md."""

from __future__ import annotations

import json
from pathlib import Path

import click

from safedpa.errors import InputError

__all__ = ["command"]

_PICTURES = ("missing", "undecided", "rehearse", "condition")


@click.command(name="diagnosis-pictures")
@click.option("--data", type=click.Path(path_type=Path), required=True, metavar="DIR", help="see docs/real-logs.md")
@click.option("--picture", "names", type=click.Choice(_PICTURES), multiple=True, help="default: all")
@click.option("--out", type=click.Path(path_type=Path), required=True, metavar="DIR", help="an existing folder")
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
def command(data: Path, names: tuple[str, ...], out: Path, as_json: bool) -> None:
    """Draw what teaches how to read a diagnosis.

    missing: a real pendulum and its candidates. undecided: what twelve seconds of a real car's drive could show.
    rehearse: effects hidden in the pendulum's own commands. condition: a simulated carpet and where it was found.
    """
    from safedpa_lab.experiments.diagnosis_pictures import PICTURES, diagnosis_pictures
    from safedpa_services.progress import progress

    for what, folder in (("--data", data), ("--out", out)):
        if not folder.is_dir():
            raise InputError(f"{what} {folder}: got no folder that exists; make it, or name another one")
    with progress("experiment diagnosis-pictures") as report_progress:
        drawn = diagnosis_pictures(data, out, names or PICTURES, report_progress)
    if as_json:
        click.echo(json.dumps({"pictures": [str(path) for path in drawn]}))
        return
    for path in drawn:
        click.echo(str(path))
