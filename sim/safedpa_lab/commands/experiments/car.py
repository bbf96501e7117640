"""``safedpa experiment car``: the paper's car experiment."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import click

from safedpa.errors import InputError
from safedpa.extras import needs
from safedpa_lab.commands.car_family import with_family
from safedpa_lab.commands.folder import made_folder

__all__ = ["command"]


@click.command(name="car")
@with_family
@click.option("--episodes", type=int, default=100, show_default=True, help="of each method and configuration")
@click.option("--first-seed", type=int, default=0, show_default=True, help="of the episodes' scenes")
@click.option("--method", "methods", multiple=True, help="only this one; may be repeated")
@click.option("--load", "loads", multiple=True, help="only this configuration (none, box, ...); may be repeated")
@click.option(
    "--part",
    "parts",
    multiple=True,
    help="only this part (table, errors, latent, equal-margin); may be repeated",
)
@click.option(
    "--equal-margin-episodes",
    type=int,
    default=50,
    show_default=True,
    help="of each filter and configuration with SafeDPA's margin for all; at most --episodes",
)
@click.option(
    "--margin",
    default="conformal",
    show_default=True,
    help="of every filter: each model's own conformal or theorem (99 %), or one number in m for all",
)
@click.option("--settings", default="car", show_default=True, help="settings of the filter: a file or a name")
@click.option("--drives", type=int, default=6, show_default=True, help="recorded drives of each kind and load")
@click.option("--drive-ticks", type=int, default=400, show_default=True, help="length of each, in periods of 0.05 s")
@click.option("--processes", type=int, default=2, show_default=True)
@click.option("--out", type=click.Path(path_type=Path), help="folder for table, JSON, figures and finished cells")
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
@needs("train")
def command(**options: Any) -> None:
    """SafeDPA and its ablations on the car.

    Success and safety in four configurations, with each filter's own margin and with SafeDPA's for all, and whether
    SafeDPA differs from each other method; prediction errors with and without tuning, latents, margins. Methods
    whose models are not there are left out, and named. What is not in --models is looked for among the models that
    ship, for the family best alone. With --out a run that was broken off goes on where it stopped.
    """
    from safedpa_lab.experiments.car import CarExperiment, car_experiment
    from safedpa_lab.experiments.car_family import family_named
    from safedpa_lab.experiments.car_report import markdown_of, write_report
    from safedpa_services.progress import progress

    experiment = CarExperiment(
        models=options["models"] or family_named(options["family"]).models,
        **{name: options[name] for name in ("family", "episodes", "first_seed", "methods", "settings", "processes")},
        **{name: options[name] for name in ("drives", "drive_ticks", "out", "equal_margin_episodes")},
        **{name: options[name] for name in ("loads", "parts") if options[name]},
        margin=_margin(options["margin"]),
        date=time.strftime("%Y-%m-%d"),
    )
    experiment.check()  # before there is a folder: what cannot be run shall leave none
    made_folder(options["out"])
    with progress("experiment car") as report_progress:
        result = car_experiment(experiment, report_progress)
    if options["out"] is not None:
        write_report(result, options["out"])
    click.echo(json.dumps(result) if options["as_json"] else markdown_of(result))


def _margin(text: str) -> str | float:
    if text in ("conformal", "theorem"):
        return text
    try:
        return float(text)
    except ValueError as error:
        raise InputError(f"--margin: got '{text}', wanted 'conformal', 'theorem' or a number in m") from error
