"""``safedpa experiment car-curves``: the car experiment made harder until its methods break."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import click

from safedpa.extras import needs
from safedpa_lab.commands.car_family import with_family
from safedpa_lab.commands.folder import made_folder

__all__ = ["command"]


@click.command(name="car-curves")
@with_family
@click.option(
    "--sweep",
    "sweeps",
    multiple=True,
    help="only this one (passage, row, load, towing, speed, friction, noise, delay, delay_untold); may be repeated",
)
@click.option("--method", "methods", multiple=True, help="only this one; may be repeated; four when left out")
@click.option("--episodes", type=int, default=100, show_default=True, help="of each method at each value")
@click.option("--first-seed", type=int, default=1000, show_default=True, help="of the episodes' scenes")
@click.option("--drives", type=int, default=6, show_default=True, help="recorded drives of each load, for the margins")
@click.option("--processes", type=int, default=2, show_default=True)
@click.option("--out", type=click.Path(path_type=Path), help="folder for tables, JSON, picture and finished episodes")
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
@needs("train")
def command(**options: Any) -> None:
    """The car made harder one thing at a time, until each method breaks.

    Narrower passages, heavier loads, a load hitched or let go on the way, speed, grip, noise, delay; success and safety
    of each method at each value, on the same scenes, and whether SafeDPA differs from the others. Margins are
    calibrated once, as in 'experiment car'. With --out a run that was cut off goes on where it stopped.
    """
    from safedpa_lab.experiments.car_curves import CarCurves, car_curves
    from safedpa_lab.experiments.car_curves_report import curves_markdown, write_curves
    from safedpa_lab.experiments.car_family import family_named
    from safedpa_services.progress import progress

    curves = CarCurves(
        models=options["models"] or family_named(options["family"]).models,
        **{name: options[name] for name in ("family", "methods", "episodes", "first_seed", "drives", "processes")},
        **{name: options[name] for name in ("sweeps", "out") if options[name]},
        date=time.strftime("%Y-%m-%d"),
    )
    curves.drivable()  # before there is a folder: what cannot be run shall leave none
    made_folder(options["out"])
    with progress("experiment car-curves") as report_progress:
        result = car_curves(curves, report_progress)
    if options["out"] is not None:
        write_curves(result, options["out"])
    click.echo(json.dumps(result) if options["as_json"] else curves_markdown(result))
