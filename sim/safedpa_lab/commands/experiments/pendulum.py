"""``safedpa experiment pendulum``: the paper's inverted pendulum in the wind."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import click

from safedpa.extras import needs
from safedpa_lab.commands.folder import made_folder

__all__ = ["command"]


@click.command(name="pendulum")
@click.option(
    "--models",
    type=click.Path(path_type=Path),
    default=Path("learned/pendulum"),
    show_default=True,
    help="folder of the learned models; what is not in it is looked for among those that ship",
)
@click.option("--directions", type=int, default=48, show_default=True, help="of the wind, evenly around")
@click.option("--episodes", type=int, default=5, show_default=True, help="of each method and direction")
@click.option(
    "--sweep-episodes",
    type=int,
    default=1,
    show_default=True,
    help="of each method and direction at each wind, torque bound, edge and noise; 0: none",
)
@click.option(
    "--drives", type=int, default=120, show_default=True, help="of each question and round that calibrate a margin"
)
@click.option("--seed", type=int, default=0, show_default=True, help="of what is counted; below 100: for development")
@click.option("--processes", type=int, default=1, show_default=True)
@click.option("--out", type=click.Path(path_type=Path), help="folder for tables, JSON and figures")
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
@needs("train")
def command(**options: Any) -> None:
    """SafeDPA and its baselines on the inverted pendulum in the wind.

    First question: random torques through the filter, within 45 degrees. Second: upright the long way round, past a
    hazard. In every wind direction, each filter with a margin of its own, and with SafeDPA's; then both made harder by
    wind, torque bound, edges and noise. Margins, RMA-P's penalty and what is counted have seeds apart.
    """
    from safedpa_lab.experiments.pendulum import PendulumExperiment, pendulum_experiment
    from safedpa_lab.experiments.pendulum_report import markdown_of, write_report
    from safedpa_services.progress import progress

    out, as_json = options.pop("out"), options.pop("as_json")
    experiment = PendulumExperiment(**options, date=time.strftime("%Y-%m-%d"))
    made_folder(out)
    with progress("experiment pendulum") as report_progress:
        result = pendulum_experiment(experiment, report_progress)
    if out is not None:
        write_report(result, out)
    click.echo(json.dumps(result) if as_json else markdown_of(result))
