"""``safedpa experiment all``: every figure that the pages quote, made again; goes on where it was cut off."""

from __future__ import annotations

import json
from pathlib import Path

import click

from safedpa.errors import InputError, SafedpaError
from safedpa.extras import needs
from safedpa_services.command_line.options import as_json_option
from safedpa_services.lines import print_plain

__all__ = ["command"]


@click.command(name="all")
@click.option(
    "--out", type=click.Path(path_type=Path), metavar="DIR", help="a folder for each result; it may hold some"
)
@click.option("--only", multiple=True, metavar="NAME", help="this part alone; may be repeated")
@click.option("--data", type=click.Path(path_type=Path), metavar="DIR", help="recordings of real robots, for real-logs")
@click.option("--small", is_flag=True, help="short versions, to see that all run; their figures mean nothing")
@click.option("--list", "listed", is_flag=True, help="print the parts and about how long they take, and run none")
@as_json_option
@needs("sim", "diagnosis")
def command(
    out: Path | None, only: tuple[str, ...], data: Path | None, small: bool, listed: bool, as_json: bool
) -> None:
    """Run every experiment whose figures the pages quote, one after the other.

    What was made by the code of today is left as it is, so a run that was cut off goes on, and after a change of code
    only what depends on it is made again. DIR/all.json holds how long each part took; exit code 1 where one failed.
    """
    from safedpa_lab.experiments.everything import PARTS, chosen, make

    if listed:
        for part in PARTS:
            click.echo(f"{part.name:20} {part.minutes:5g} min  safedpa experiment {' '.join(part.phrase)}")
        return
    if out is None:
        raise InputError("experiment all: got no --out, wanted a folder for the results")
    if data is not None and not data.is_dir():
        raise InputError(f"--data {data}: got no folder, wanted that of the recordings")
    parts = chosen(only, data)
    out.mkdir(parents=True, exist_ok=True)
    place = {part.name: number for number, part in enumerate(parts, 1)}
    account = make(
        parts,
        out.absolute(),
        data,
        small=small,
        report_progress=lambda part, notice: print_plain(
            f"{place[part.name]} of {len(parts)}: {part.name}: {notice}", err=True
        ),
    )
    if as_json:
        click.echo(json.dumps(account))
    failed = [name for name, reported in account.items() if reported["exit_code"] != 0]
    if failed:
        raise SafedpaError(f"experiment all: {', '.join(failed)} failed; the logs lie in {out}")
