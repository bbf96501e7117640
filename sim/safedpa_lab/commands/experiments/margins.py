"""``safedpa experiment margins``: the margins that ship, over whole drives, and how often they hold."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import click

from safedpa.extras import needs
from safedpa_lab.provenance.record import write_result

__all__ = ["command"]


@click.command(name="margins")
@click.option("--robot", "robots", multiple=True, help="name of a margin that ships; default: all of them")
@click.option(
    "--drives",
    type=int,
    default=200,
    show_default=True,
    help="to calibrate each kind of margin on; 0 with --kind shipped: none",
)
@click.option("--fresh", type=int, default=200, show_default=True, help="to count on, for each kind of margin")
@click.option("--skip", type=int, default=0, show_default=True, help="evaluation seeds to leave out before those")
@click.option(
    "--kind",
    "kinds",
    multiple=True,
    help="behind which margin: conformal (of a step), drive, shipped; default: conformal, drive",
)
@click.option("--seconds", type=float, default=0.0, help="of a drive; default: as each robot has it")
@click.option("--coverage", type=float, default=0.99, show_default=True, help="of steps, and of drives")
@click.option("--processes", type=int, default=2, show_default=True)
@click.option("--minutes", type=float, default=0.0, help="begin no drive after so long; run again to go on")
@click.option("--out", type=click.Path(path_type=Path), required=True, help="folder that keeps every drive")
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
@needs("sim")
def command(**options: Any) -> None:
    """Calibrate the margins of the shipped robots on whole drives, and count what they cover on fresh ones."""
    from safedpa_lab.experiments.margin_drives import DRIVERS
    from safedpa_lab.experiments.margins import KINDS, MarginCases, margins_experiment
    from safedpa_lab.experiments.margins_report import margins_page
    from safedpa_services.progress import progress

    as_json = options.pop("as_json")
    options["robots"] = options["robots"] or tuple(DRIVERS)
    options["kinds"] = options["kinds"] or KINDS
    with progress("experiment margins") as report_progress:
        result = margins_experiment(MarginCases(**options), report_progress)
    out = options["out"]
    write_result(out / "margins.json", result)
    page = margins_page(result, _asked(options), time.strftime("%Y-%m-%d"))
    (out / "margins.md").write_text(page, encoding="utf-8")
    if as_json:
        click.echo(json.dumps(result))
        return
    click.echo(page)
    click.echo(f"margins: {out}/ROBOT/margin.toml; this page: {out}/margins.md")
    if result["missing"]:
        click.echo(f"{result['missing']} drives are missing; run the same command again to go on")


def _asked(options: dict[str, Any]) -> str:
    """The command that makes the same again."""
    chosen = [f"--robot {name}" for name in options["robots"]]
    chosen += [f"--drives {options['drives']}", f"--fresh {options['fresh']}"]
    chosen += [f"--skip {options['skip']}"] if options["skip"] else []
    chosen += [f"--kind {kind}" for kind in options["kinds"]]
    return f"safedpa experiment margins {' '.join(chosen)} --out FOLDER"
