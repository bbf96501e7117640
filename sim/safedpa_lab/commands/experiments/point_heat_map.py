"""``safedpa experiment point-heat-map``: what each model says that an action does to h, next to what it does."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import click

from safedpa.extras import needs
from safedpa_lab.commands.folder import made_folder, named_folder

__all__ = ["command"]


@click.command(name="point-heat-map")
@click.option("--direction", type=float, default=135.0, show_default=True, help="of the force [degrees]")
@click.option("--force", type=float, default=0.008, show_default=True, help="N")
@click.option("--moments", type=int, default=60, show_default=True, help="near hazards, drawn from drives")
@click.option("--points", type=int, default=21, show_default=True, help="along each of thrust and turn")
@click.option("--seed", type=int, default=0, show_default=True)
@click.option(
    "--models", "folder", type=click.Path(path_type=Path), default=Path(), help="folder of models; else those shipped"
)
@click.option("--out", type=click.Path(path_type=Path), help="folder for table, JSON and a figure")
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
@needs("train")
def command(out: Path | None, as_json: bool, **options: Any) -> None:
    """The point robot near hazards in a wind: the change of h over turn and thrust, by each model.

    SafeDPA, Mix and each Fix are compared with the simulator: correlation, and how often they agree whether room is won.
    """
    from safedpa_lab.experiments.point_heat_map import heat_map_markdown, write_heat_map
    from safedpa_lab.point.heat_map import HeatMap, heat_map

    asked = HeatMap(**options, shown=min(3, options["moments"]))
    named_folder("--models", options["folder"])
    made_folder(out)
    result = {"date": time.strftime("%Y-%m-%d"), **heat_map(asked)}
    if out is not None:
        write_heat_map(result, out)
    click.echo(json.dumps(result) if as_json else heat_map_markdown(result))
