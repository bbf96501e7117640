"""``safedpa experiment point-relinearised``: a model that is not affine in the action, behind the same filter."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import click

from safedpa.extras import needs
from safedpa_lab.commands.folder import made_folder, named_folder
from safedpa_lab.commands.positive import check_positive

__all__ = ["command"]

_QUICK = {"directions": 2, "episodes": 1, "steps": 40, "drive_steps": 10}


@click.command(name="point-relinearised")
@click.option("--directions", type=int, default=24, show_default=True, help="of the force, evenly around")
@click.option("--episodes", type=int, default=2, show_default=True, help="in each direction")
@click.option("--steps", type=int, default=1000, show_default=True, help="of an episode")
@click.option("--drives", type=int, default=100, show_default=True, help="that calibrate a margin")
@click.option("--drive-steps", type=int, default=200, show_default=True, help="of each of those")
@click.option("--seed", type=int, default=2400, show_default=True, help="among those of evaluation and calibration")
@click.option("--quick", is_flag=True, help="two episodes of 40 steps each: to see that it runs, no more")
@click.option("--car", "car_pairs", type=int, help="train both forms of a car's networks on so many pairs as well")
@click.option("--train", is_flag=True, help="train the networks again first, into --models: ten minutes")
@click.option("--models", type=click.Path(path_type=Path), default=Path(), help="folder; else those shipped")
@click.option("--processes", type=int, default=1, show_default=True)
@click.option("--record", type=click.Path(path_type=Path), help="file that keeps each row, so that a run goes on")
@click.option("--out", type=click.Path(path_type=Path), help="folder for table and JSON")
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
@needs("train")
def command(
    quick: bool, car_pairs: int | None, train: bool, out: Path | None, as_json: bool, models: Path, **options: Any
) -> None:
    """The point robot behind filters whose networks are not affine in the action, and behind affine ones.

    Free networks H(x, z, a) are relinearised by their own slope about the nominal action, or about the filter's own action; with
    the clean thrust, and with the benchmark's, which saturates. Every filter is told z = mu(e) of the true wind.
    """
    from safedpa_lab.experiments.point_relinearised import Relinearised, point_relinearised
    from safedpa_lab.experiments.point_relinearised_report import relinearised_markdown, write_relinearised
    from safedpa_lab.experiments.relinearised_errors import CarWork, car_errors, point_errors, train_networks
    from safedpa_lab.experiments.retained_drives import driven
    from safedpa_services.progress import progress

    if car_pairs is not None:
        check_positive({"car": car_pairs}, "car")
    asked = Relinearised(models=models, **{**options, **(_QUICK if quick else {})})
    if not train:
        named_folder("--models", models)
    made_folder(out)
    if train:
        train_networks(models)
    with progress("experiment point-relinearised") as report_progress:
        result = {"date": time.strftime("%Y-%m-%d"), "quick": quick, **point_relinearised(asked, report_progress)}
    result["networks"] = point_errors(models)
    if car_pairs is not None:
        retained = asked.record and asked.record.with_suffix(".car.jsonl")
        result["car"] = driven(car_errors, [CarWork(car_pairs)], 1, record=retained)[0]
    if out is not None:
        write_relinearised(result, out)
    click.echo(json.dumps(result) if as_json else relinearised_markdown(result))
