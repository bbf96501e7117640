"""``safedpa experiment sensing-margins``: how far what is told falls short of what is there, over whole drives."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from safedpa.errors import InputError, did_you_mean
from safedpa.extras import needs
from safedpa_lab.commands.positive import check_positive
from safedpa_lab.provenance.record import KEY, provenance, write_result

__all__ = ["command"]


@click.command(name="sensing-margins")
@click.option("--drives", type=int, default=100, show_default=True, help="to calibrate on; 99 at least for 99 %")
@click.option("--fresh", type=int, default=100, show_default=True, help="to count on")
@click.option("--seconds", type=float, default=8.0, show_default=True, help="of driving in each")
@click.option("--coverage", type=float, default=0.99, show_default=True, help="of steps, and of drives")
@click.option("--scene", "scenes", multiple=True, help="one kind of scene, once or more  [people, rooms, steps-out]")
@click.option("--processes", type=int, default=2, show_default=True)
@click.option(
    "--record", type=click.Path(path_type=Path), help="keep each drive there; what it holds is not driven again"
)
@click.option("--out", type=click.Path(path_type=Path), help="write the result there as JSON as well")
@click.option("--page", type=click.Path(path_type=Path), help="write a page of the result there, as Markdown")
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
@needs("sim")
def command(**options: Any) -> None:
    """Calibrate the margin of what a laser tells: noise, age, lost rays, wrong odometry, on fresh drives counted."""
    from safedpa_lab.experiments.sensing_margins import SCENES, margins_of_sensing
    from safedpa_lab.experiments.sensing_margins_page import margins_page
    from safedpa_services.progress import progress

    _check(options)
    with progress("experiment sensing-margins") as report_progress:
        found = margins_of_sensing(
            options["drives"],
            options["fresh"],
            options["seconds"],
            options["coverage"],
            options["processes"],
            report_progress,
            options["record"],
            options["scenes"] or SCENES,
        )
    result = {"experiment": "sensing-margins", **found}
    if options["out"] is not None:
        write_result(options["out"], result)
    page = margins_page({**result, KEY: provenance()})
    if options["page"] is not None:
        options["page"].write_text(page, encoding="utf-8")
    click.echo(json.dumps(result) if options["as_json"] else page)


def _check(options: dict[str, Any]) -> None:
    """Raises InputError naming the option that cannot be."""
    from safedpa_lab.experiments.sensing_scenes import SCENES

    check_positive(options, "drives", "fresh", "seconds", "processes")
    for given in options["scenes"]:
        if given not in SCENES:
            raise InputError(f"--scene {given}: {did_you_mean(given, SCENES)}")
    for name in ("out", "page", "record"):
        path = options[name]
        if path is not None and not path.absolute().parent.is_dir():
            raise InputError(f"--{name} {path}: folder {path.parent} does not exist; create it")
