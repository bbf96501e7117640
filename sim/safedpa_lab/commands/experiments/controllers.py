"""``safedpa experiment controllers``: goals, collisions and time of the controllers on the same scenes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from safedpa.extras import needs
from safedpa_lab.commands.positive import check_positive
from safedpa_lab.provenance.record import write_result

__all__ = ["command"]


@click.command(name="controllers")
@click.option("--controller", "controllers", multiple=True, help="which; may be given again; default: all that can")
@click.option("--seeds", type=int, default=20, show_default=True, help="scenes per load")
@click.option("--first-seed", type=int, default=200, show_default=True)
@click.option("--seconds", type=float, default=20.0, show_default=True, help="of driving in each scene")
@click.option("--model", default="car", show_default=True, help="model file, or the name of one that ships")
@click.option("--settings", default="car", show_default=True, help="settings of the filter: a file or a name")
@click.option("--out", type=click.Path(path_type=Path), help="write the result there as JSON as well, after each scene")
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
@needs("sim")
def command(**options: Any) -> None:
    """Goals reached, collisions and milliseconds a nominal action.

    Random scenes with every load, through the real filter, for each controller.
    """
    from safedpa.dynamics import LearnedBase, load_model
    from safedpa.safety.defaults import settings_named
    from safedpa_lab.experiments.controllers import controllers_experiment
    from safedpa_services.progress import progress

    check_positive(options, "seeds", "seconds")
    model, seeds = load_model(options["model"]), range(options["first_seed"], options["first_seed"] + options["seeds"])
    learned = isinstance(model.base, LearnedBase) and model.base.weights.has("policy")
    controllers = options["controllers"] or ("goal_seeker", "planner", *(("learned",) if learned else ()))
    with progress("experiment controllers") as report_progress:

        def keep(done: int, count: int, so_far: dict[str, Any]) -> None:
            report_progress(done, count)
            if options["out"]:
                write_result(options["out"], so_far)

        result = controllers_experiment(
            model, settings_named(options["settings"]), controllers, seeds, options["seconds"], keep
        )
    if options["as_json"]:
        click.echo(json.dumps(result))
    else:
        _report(result)


def _report(result: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"{len(result['seeds'])} scenes per load, {result['seconds']:g} s each", box=None)
    for column in ("load", "controller", "goals", "drives with a goal", "collisions", "changed", "ms p50", "ms p99"):
        table.add_column(column, justify="left" if column in ("load", "controller") else "right")
    for row in result["rows"]:
        table.add_row(
            row["load"],
            row["controller"],
            str(row["goals"]),
            f"{row['drives_with_a_goal']}/{row['drives']}",
            str(row["collisions"]),
            f"{100 * row['changed_share']:.0f} %",
            f"{row['milliseconds_p50']:.2f}",
            f"{row['milliseconds_p99']:.2f}",
        )
    Console().print(table)
