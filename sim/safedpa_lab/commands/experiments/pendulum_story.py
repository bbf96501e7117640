"""``safedpa experiment pendulum-story``: compare, diagnose, add on a second robot, and what it is worth."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import click

from safedpa.errors import InputError, did_you_mean
from safedpa.extras import needs
from safedpa_lab.commands.folder import made_folder
from safedpa_lab.commands.positive import check_positive

__all__ = ["command"]


@click.command(name="pendulum-story")
@click.option("--hidden", multiple=True, help="only this one: payload, 'dry friction' or both; may be repeated")
@click.option("--directions", type=int, default=12, show_default=True, help="of the wind, evenly around")
@click.option("--episodes", type=int, default=2, show_default=True, help="of each model and direction")
@click.option("--seconds", type=float, default=3.0, show_default=True, help="of each episode")
@click.option("--seed", type=int, default=0, show_default=True)
@click.option("--learned", is_flag=True, help="with the learned model too, and what was found added to it: slow")
@click.option(
    "--data",
    type=click.Path(path_type=Path, exists=True, file_okay=False),
    help="logs of DFKI's pendulum: also payloads of a user's pendulum that is identified from them",
)
@click.option("--processes", type=int, default=2, show_default=True)
@click.option("--out", type=click.Path(path_type=Path), help="folder for tables, JSON and a figure")
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
@needs("train")
def command(**options: Any) -> None:
    """A pendulum with half a kilogram more, or a hinge that rubs, which no model was told.

    Swings are recorded and diagnosed, what is found is added; then the filter keeps the pendulum within 45 degrees with
    the shipped model, with the corrected one and with the truth, each with the margin that its errors ask for.
    """
    from safedpa_lab.experiments.pendulum_payload import PayloadCases, payload_cases
    from safedpa_lab.experiments.pendulum_story import PendulumStory, pendulum_story
    from safedpa_lab.experiments.pendulum_story_report import story_markdown, write_story
    from safedpa_lab.pendulum.hidden import HIDDEN
    from safedpa_services.progress import progress

    check_positive(options, "directions", "episodes", "seconds", "processes")
    for name in options["hidden"]:
        if name not in HIDDEN:
            raise InputError(f"--hidden: got '{name}'; {did_you_mean(name, HIDDEN)}")
    out, as_json, data = options.pop("out"), options.pop("as_json"), options.pop("data")
    story = PendulumStory(**{**options, "hidden": options["hidden"] or tuple(HIDDEN)})
    cases = None if data is None else PayloadCases(data, processes=options["processes"])
    made_folder(out)
    with progress("experiment pendulum-story") as report_progress:
        result = {"date": time.strftime("%Y-%m-%d"), **pendulum_story(story, report_progress)}
    if cases is not None:
        with progress("payloads of a user") as report_progress:
            result["payloads"] = payload_cases(cases, report_progress)
    if out is not None:
        write_story(result, out)
    click.echo(json.dumps(result) if as_json else story_markdown(result))
