"""``safedpa experiment point-story``: compare, diagnose, add on the point robot, and what it is worth."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import click

from safedpa.extras import needs
from safedpa_lab.commands.folder import made_folder
from safedpa_lab.commands.positive import check_positive
from safedpa_lab.provenance.record import write_result

__all__ = ["command"]


@click.command(name="point-story")
@click.option("--hidden", multiple=True, help="only this one; there is 'force and drag'")
@click.option("--robots", type=int, default=128, show_default=True, help="each in a layout of its own")
@click.option("--seconds", type=float, default=10.0, show_default=True, help="of each episode")
@click.option("--seed", type=int, default=0, show_default=True)
@click.option("--out", type=click.Path(path_type=Path), help="folder for table and JSON")
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
@needs("diagnosis")
def command(hidden: tuple[str, ...], out: Path | None, as_json: bool, **options: Any) -> None:
    """A point robot that a force pushes and whose slides drag, and no model was told.

    Logs are recorded and diagnosed, what is found is added; then the filter keeps robots out of hazards with the
    shipped model, with the corrected one and with the truth.
    """
    from safedpa_lab.experiments.point_story import PointStory, point_story, point_story_markdown
    from safedpa_lab.point.hidden import HIDDEN
    from safedpa_services.progress import progress

    check_positive(options, "robots", "seconds")
    story = PointStory(hidden=hidden or tuple(HIDDEN), **options)
    made_folder(out)
    with progress("experiment point-story") as report_progress:
        result = {"date": time.strftime("%Y-%m-%d"), **point_story(story, report_progress)}
    if out is not None:
        write_result(out / "point-story.json", result)
        (out / "point-story.md").write_text(point_story_markdown(result), encoding="utf-8")
    click.echo(json.dumps(result) if as_json else point_story_markdown(result))
