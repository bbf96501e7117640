"""``safedpa experiment bad-data``: twenty bad files from one good log."""

from __future__ import annotations

import json
from pathlib import Path

import click

from safedpa.extras import needs
from safedpa_services.command_line.options import as_json_option

__all__ = ["command"]


@click.command(name="bad-data")
@click.argument("log", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), required=True, metavar="DIR", help="Folder for the files.")
@as_json_option
@needs("diagnosis")
def command(log: Path, out: Path, as_json: bool) -> None:
    """Spoil a good LOG of a car (CSV, native columns) in twenty ways.

    Frozen sensors, dead commands, wrong signs, late channels, other units, decimal commas and more: one file each, and
    what has to be said about it by compare and diagnose.
    """
    from safedpa.errors import InputError
    from safedpa_lab.hidden.bad_data import BAD, write_bad_files

    if not log.is_file():
        raise InputError(f"{log}: no such file; wanted a good log of a car as CSV")
    files = write_bad_files(log, out)
    if as_json:
        rows = [{"file": str(path), "kind": BAD[name].kind, "notice": BAD[name].notice} for name, path in files.items()]
        click.echo(json.dumps({"format": 1, "files": rows}))
        return
    for name, path in files.items():
        click.echo(f"{path}: {BAD[name].kind}, '... {BAD[name].notice} ...'")
