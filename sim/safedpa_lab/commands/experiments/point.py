"""``safedpa experiment point``: the paper's point robot among hazards, in a force from every direction."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import click

from safedpa.errors import InputError, did_you_mean
from safedpa.extras import needs
from safedpa_lab.commands.folder import made_folder, named_folder

__all__ = ["command"]

_MODELS, _BASELINES = Path("learned/point"), Path("learned/point_baselines")
_FOLDER = click.Path(path_type=Path)
_QUICK = {"directions": 8, "episodes": 4, "steps": 500}


@click.command(name="point")
@click.option("--models", type=_FOLDER, default=_MODELS, show_default=True, help="of the learned models")
@click.option("--baselines", type=_FOLDER, default=_BASELINES, show_default=True)
@click.option("--methods", metavar="NAME,NAME,...", help="which ones; all when left out")
@click.option("--directions", type=int, default=24, show_default=True, help="of the force, evenly around")
@click.option("--episodes", type=int, default=20, show_default=True, help="of each method and direction")
@click.option("--steps", type=int, default=1000, show_default=True, help="of each episode")
@click.option("--force", type=float, default=0.008, show_default=True, help="N")
@click.option("--drives", type=int, default=400, show_default=True, help="of each round that calibrate a margin")
@click.option("--seed", type=int, default=0, show_default=True, help="of layouts, headings, goals that are counted")
@click.option("--processes", type=int, default=2, show_default=True)
@click.option("--record", type=_FOLDER, metavar="FILE", help="keep drives there, and go on with those it holds")
@click.option("--quick", is_flag=True, help="8 directions x 4 episodes of 500 steps")
@click.option("--out", type=_FOLDER, help="folder for tables, JSON and figures")
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
@needs("train")
def command(methods: str | None, quick: bool, out: Path | None, as_json: bool, **options: Any) -> None:
    """SafeDPA and its baselines on the point robot among eight hazards.

    Every method meets the same layouts, forces and goals; the robots of a method drive all at once. Each filter has the
    margin that other drives calibrate for it; in a second table all have SafeDPA's. Weights are looked for in both
    folders, then among those that ship. Margins, RMA-P's penalty and what is counted have seeds apart.
    """
    from safedpa_lab.experiments.point import PointExperiment, point_experiment
    from safedpa_lab.experiments.point_report import markdown_of, write_report
    from safedpa_services.progress import progress

    named_folder("--models", options["models"], _MODELS)
    named_folder("--baselines", options["baselines"], _BASELINES)
    made_folder(out)
    if methods is not None:
        options["methods"] = _named(methods)
    else:
        options["methods"] = _trained(options["models"], options["baselines"])
    experiment = PointExperiment(**{**options, **(_QUICK if quick else {})}, date=time.strftime("%Y-%m-%d"))
    with progress("experiment point") as report_progress:
        result = point_experiment(experiment, report_progress)
    if out is not None:
        write_report(result, out)
    click.echo(json.dumps(result) if as_json else markdown_of(result))


def _trained(models: Path, baselines: Path) -> tuple[str, ...]:
    """All methods but those that no one has trained, which are told."""
    from safedpa_lab.point.drivers import with_weights
    from safedpa_lab.point.methods import METHODS

    names = with_weights(models, baselines)
    for name in METHODS:
        if name not in names:
            click.echo(f"warning: {name}: left out, there are no weights of it", err=True)
    return names


def _named(methods: str) -> tuple[str, ...]:
    from safedpa_lab.point.methods import METHODS

    names = tuple(name.strip() for name in methods.split(",") if name.strip())
    for name in names or ("",):
        if name not in METHODS:
            raise InputError(f"--methods: '{name}': {did_you_mean(name, tuple(METHODS))}")
    return names
