"""``safedpa experiment differential-drive``: does the filter keep it from hitting anything?"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from safedpa.errors import InputError
from safedpa.extras import needs
from safedpa_lab.commands.positive import check_positive
from safedpa_lab.provenance.record import write_result

__all__ = ["command"]


@click.command(name="differential-drive")
@click.option("--drives", type=int, default=50, show_default=True, help="scenes for each of 4 worlds and 2 policies")
@click.option("--first-seed", type=int, default=0, show_default=True, help="of the scenes kept for evaluation")
@click.option("--seconds", type=float, default=20.0, show_default=True, help="of driving in each")
@click.option("--processes", type=int, default=2, show_default=True)
@click.option("--out", type=click.Path(path_type=Path), help="write the result there as JSON as well")
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
@needs("sim")
def command(**options: Any) -> None:
    """Drives of the differential drive in lockstep, with the filter and every fourth without, in four worlds.

    plain; loaded: 40 % of its mass on board, on carpet; worn: wheels smaller and unlike, farther apart; slippery:
    little grip and slow motors. One policy heads straight for its goal, the other goes round what is in the way.
    """
    from safedpa_lab.experiments.seeds import seeds_for
    from safedpa_lab.experiments.wheels import wheels_experiment
    from safedpa_services.progress import progress

    check_positive(options, "drives", "seconds", "processes")
    out = options["out"]
    if out is not None and not out.absolute().parent.is_dir():
        raise InputError(f"--out {out}: folder {out.parent} does not exist; create it")
    seeds = seeds_for("evaluation", options["drives"], options["first_seed"])
    with progress("experiment differential-drive") as report_progress:
        found = wheels_experiment(seeds, options["seconds"], options["processes"], report_progress)
    result = {"experiment": "differential-drive", **found}
    if out is not None:
        write_result(out, result)
    if options["as_json"]:
        click.echo(json.dumps(result))
        return
    for row in result["rows"]:
        on, off = row["filter_on"], row["filter_off"]
        click.echo(
            f"{row['world']:9} {row['policy']:12} {on['drives']} drives: {on['drives_with_a_collision']} with a "
            f"collision, {on['goals']} goals; without the filter {off['drives_with_a_collision']} of {off['drives']}"
        )
