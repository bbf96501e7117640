"""``safedpa experiment sensing``: the filter with a laser alone."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from safedpa.errors import InputError, did_you_mean
from safedpa.extras import needs
from safedpa_lab.commands.positive import check_positive
from safedpa_lab.provenance.record import KEY, provenance, write_result

__all__ = ["command"]


@click.command(name="sensing")
@click.option("--seeds", type=int, default=8, show_default=True, help="drives of each kind of scene")
@click.option("--first-seed", type=int, default=1000, show_default=True)
@click.option("--seconds", type=float, default=30.0, show_default=True, help="of driving in each")
@click.option("--coming", type=float, default=1.5, show_default=True, help="m/s of anyone who no one sees")
@click.option("--peers/--no-peers", default=True, help="the same drives behind others' brakes, and behind nothing")
@click.option("--told/--not-told", default=True, help="the same drives with perfect knowledge, to compare with")
@click.option("--hiding/--no-hiding", default=False, help="the same drives told everything but who hides")
@click.option("--scene", "scenes", multiple=True, help="one kind of scene, once or more  [default: all]")
@click.option("--load", "loads", multiple=True, help="what is towed, once or more; every one with every seed  [none]")
@click.option("--policy", default="way_seeker", show_default=True, help="the controller, or goal_seeker: looks nowhere")
@click.option("--processes", type=int, default=2, show_default=True)
@click.option(
    "--record", type=click.Path(path_type=Path), help="keep each drive there; what it holds is not driven again"
)
@click.option("--out", type=click.Path(path_type=Path), help="write the result there as JSON as well")
@click.option("--page", type=click.Path(path_type=Path), help="write a page of the result there, as Markdown")
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
@needs("sim")
def command(**options: Any) -> None:
    """Drives with a laser alone: among pillars and people, through a door, past someone who steps out."""
    from safedpa_lab.experiments.sensing import GUARDS, LOADS, SCENES, sensing_experiment
    from safedpa_lab.experiments.sensing_page import page_of
    from safedpa_services.progress import progress

    _check(options)
    out, page = options["out"], options["page"]
    seeds = range(options["first_seed"], options["first_seed"] + options["seeds"])
    with progress("experiment sensing") as report_progress:
        wanted = {"reported": options["reported"], "told-but-hiding": options["hiding"]}
        others = [guard for guard in GUARDS[1:] if wanted.get(guard, options["peers"])]
        found = sensing_experiment(
            seeds,
            options["seconds"],
            options["coming"],
            options["processes"],
            (GUARDS[0], *others),
            report_progress,
            options["scenes"] or SCENES,
            options["loads"] or LOADS[:1],
            options["policy"],
            options["record"],
        )
    result = {"experiment": "sensing", **found}
    if out is not None:
        write_result(out, result)
    if page is not None:
        page.write_text(page_of({**result, KEY: provenance()}), encoding="utf-8")
    if options["as_json"]:
        click.echo(json.dumps(result))
    else:
        for row in result["rows"]:
            click.echo(
                f"{row['scene']:10} {row['guard']:17} {row['drives']} drives, the car moved into something in "
                f"{row['drives_in_which_the_car_moved_into_something']}, was touched while it stood "
                f"{row['touched_while_it_stood']} times; {row['goals_a_minute']:.1f} goals and "
                f"{row['metres_a_minute']:.0f} m a minute"
            )


def _check(options: dict[str, Any]) -> None:
    """Raises InputError naming the option that cannot be."""
    from safedpa_lab.experiments.sensing import LOADS, POLICIES, SCENES

    known_names = {"scene": SCENES, "load": LOADS}
    check_positive(options, "seeds", "seconds", "processes")
    if not 0.0 <= options["coming"] <= 1.5:
        raise InputError(f"--coming: got {options['coming']}, wanted 0 to 1.5 m/s")
    if options["policy"] not in POLICIES:
        raise InputError(f"--policy {options['policy']}: {did_you_mean(options['policy'], POLICIES)}")
    for name in ("out", "page", "record"):
        path = options[name]
        if path is not None and not path.absolute().parent.is_dir():
            raise InputError(f"--{name} {path}: folder {path.parent} does not exist; create it")
    for name, known in known_names.items():
        for given in options[f"{name}s"]:
            if given not in known:
                raise InputError(f"--{name} {given}: {did_you_mean(given, known)}")
