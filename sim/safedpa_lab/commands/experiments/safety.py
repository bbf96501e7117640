"""``safedpa experiment safety``: random scenes with every load, with the filter and without."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from safedpa.extras import needs
from safedpa_lab.commands.positive import check_positive
from safedpa_lab.provenance.record import write_result

__all__ = ["command"]


@click.command(name="safety")
@click.option("--seeds", type=int, default=100, show_default=True, help="scenes per load")
@click.option("--first-seed", type=int, default=0, show_default=True)
@click.option("--seconds", type=float, default=20.0, show_default=True, help="of driving in each episode")
@click.option("--model", default="car", show_default=True, help="model file, or the name of one that ships")
@click.option("--settings", default="car", show_default=True, help="settings of the filter: a file or a name")
@click.option("--processes", type=int, default=2, show_default=True)
@click.option("--out", type=click.Path(path_type=Path), help="write the result there as JSON as well")
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
@needs("sim")
def command(**options: Any) -> None:
    """Collisions with the filter and without.

    Random scenes with every load, each driven both ways.
    """
    from safedpa.safety.defaults import settings_named
    from safedpa_lab.experiments.safety import safety_experiment
    from safedpa_services.progress import progress

    check_positive(options, "seeds", "seconds", "processes")
    seeds = range(options["first_seed"], options["first_seed"] + options["seeds"])
    settings = settings_named(options["settings"])
    with progress("experiment safety") as report_progress:
        result = safety_experiment(
            seeds, options["seconds"], options["model"], settings, options["processes"], report_progress
        )
    result = {"experiment": "safety", "seeds": [seeds.start, seeds.stop - 1], **result}
    if options["out"]:
        write_result(options["out"], result)
    if options["as_json"]:
        click.echo(json.dumps(result))
    else:
        _report(result)


def _report(result: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    first, last = result["seeds"]
    table = Table(title=f"seeds {first} to {last}, {result['seconds']:g} s each", box=None)
    for column in ("load", "episodes", "collisions with filter", "without", "goals with", "without", "changed"):
        table.add_column(column, justify="left" if column == "load" else "right")
    for row in result["rows"]:
        on, off = row["filter_on"], row["filter_off"]
        table.add_row(
            row["load"],
            str(on["episodes"]),
            f"{on['collisions']} in {on['episodes'] - on['safe_episodes']}",
            f"{off['collisions']} in {off['episodes'] - off['safe_episodes']}",
            str(on["goals"]),
            str(off["goals"]),
            f"{100 * on['intervention_share']:.0f} %",
        )
    Console().print(table)
