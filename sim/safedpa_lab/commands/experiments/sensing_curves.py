"""``safedpa experiment sensing-curves``: a laser among people, made harder until it breaks."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from safedpa.errors import InputError
from safedpa.extras import needs
from safedpa_lab.commands.positive import check_positive
from safedpa_lab.provenance.record import KEY, provenance, write_result

__all__ = ["command"]


@click.command(name="sensing-curves")
@click.option("--seeds", type=int, default=12, show_default=True, help="drives of each value")
@click.option("--first-seed", type=int, default=1000, show_default=True)
@click.option("--seconds", type=float, default=20.0, show_default=True, help="of driving in each")
@click.option("--processes", type=int, default=2, show_default=True)
@click.option(
    "--record", type=click.Path(path_type=Path), help="keep each drive there; what it holds is not driven again"
)
@click.option("--out", type=click.Path(path_type=Path), help="write the result there as JSON as well")
@click.option("--page", type=click.Path(path_type=Path), help="write a page of the result there, as Markdown")
@click.option("--picture", type=click.Path(path_type=Path), help="draw the curves there, as PNG")
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
@needs("sim")
def command(**options: Any) -> None:
    """A laser among people, made harder: faster people, noisier, older and narrower scans."""
    from safedpa_lab.experiments.sensing_curves import curves_experiment, curves_page, draw_curves
    from safedpa_services.progress import progress

    check_positive(options, "seeds", "seconds", "processes")
    for name in ("out", "page", "record", "picture"):
        path = options[name]
        if path is not None and not path.absolute().parent.is_dir():
            raise InputError(f"--{name} {path}: folder {path.parent} does not exist; create it")
    seeds = range(options["first_seed"], options["first_seed"] + options["seeds"])
    with progress("experiment sensing-curves") as report_progress:
        found = curves_experiment(seeds, options["seconds"], options["processes"], report_progress, options["record"])
    result = {"experiment": "sensing-curves", **found}
    if options["out"] is not None:
        write_result(options["out"], result)
    if options["page"] is not None:
        options["page"].write_text(curves_page({**result, KEY: provenance()}), encoding="utf-8")
    if options["picture"] is not None:
        draw_curves(result, options["picture"])
    if options["as_json"]:
        click.echo(json.dumps(result))
        return
    for row in result["rows"]:
        click.echo(
            f"{row['curve']:13} {row['value']:.3g}: {row['drives']} drives, the car moved into something in "
            f"{row['drives_in_which_the_car_moved_into_something']}; {row['goals_a_minute']:.1f} goals a minute"
        )
