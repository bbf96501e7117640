"""``safedpa experiment meeting``: several cars on one field, each the others' obstacle."""

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


@click.command(name="meeting")
@click.option("--robots", type=int, multiple=True, help="so many cars, 2 to 8, once or more  [default: 2, 4, 8]")
@click.option("--seeds", type=int, default=5, show_default=True, help="drives of each number of cars")
@click.option("--first-seed", type=int, default=1000, show_default=True)
@click.option("--seconds", type=float, default=20.0, show_default=True, help="of driving in each")
@click.option("--fastest", type=float, default=2.0, show_default=True, help="m/s of whatever moves or hides")
@click.option("--guard", "guards", multiple=True, help="safedpa, told or nothing, once or more  [default: all]")
@click.option("--load", "loads", multiple=True, help="what every car tows, once or more  [none]")
@click.option("--processes", type=int, default=2, show_default=True)
@click.option("--out", type=click.Path(path_type=Path), help="write the result there as JSON as well")
@click.option("--page", type=click.Path(path_type=Path), help="write a page of the result there, as Markdown")
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
@needs("sim")
def command(**options: Any) -> None:
    """Cars that see each other by their lasers: do they touch while they move, and do they reach their goals?"""
    from safedpa_lab.experiments.meeting import GUARDS, meeting_experiment
    from safedpa_lab.experiments.meeting_page import page_of
    from safedpa_services.progress import progress

    _check(options)
    out, page = options["out"], options["page"]
    with progress("experiment meeting") as report_progress:
        found = meeting_experiment(
            range(options["first_seed"], options["first_seed"] + options["seeds"]),
            options["robots"] or (2, 4, 8),
            options["seconds"],
            options["fastest"],
            options["guards"] or GUARDS,
            options["loads"] or ("none",),
            options["processes"],
            report_progress,
        )
    result = {"experiment": "meeting", **found}
    if out is not None:
        write_result(out, result)
    if page is not None:
        page.write_text(page_of({**result, KEY: provenance()}), encoding="utf-8")
    if options["as_json"]:
        click.echo(json.dumps(result))
        return
    for row in result["rows"]:
        click.echo(
            f"{row['robots']} cars {row['guard']:8} {row['drives']} drives, a moving car touched another in "
            f"{row['drives_in_which_a_moving_car_touched_another']}; {row['goals_a_minute_and_robot']:.1f} goals a "
            f"minute and car, {100 * row['share_of_time_standing']:.0f} % of the time standing, "
            f"{row['stuck_pairs']} pairs stuck"
        )


def _check(options: dict[str, Any]) -> None:
    """Raises InputError naming the option that cannot be."""
    from safedpa_lab.experiments.meeting import GUARDS
    from safedpa_lab.experiments.meeting_scenes import MOST_ROBOTS
    from safedpa_lab.experiments.sensing import LOADS

    check_positive(options, "seeds", "seconds", "processes")
    for count in options["robots"]:
        if not 2 <= count <= MOST_ROBOTS:
            raise InputError(f"--robots: got {count}, wanted 2 to {MOST_ROBOTS}")
    if not 0.1 <= options["fastest"] <= 20.0:
        raise InputError(f"--fastest: got {options['fastest']}, wanted 0.1 to 20 m/s")
    for name, known in (("guard", GUARDS), ("load", LOADS)):
        for given in options[f"{name}s"]:
            if given not in known:
                raise InputError(f"--{name} {given}: {did_you_mean(given, known)}")
    for name in ("out", "page"):
        path = options[name]
        if path is not None and not path.absolute().parent.is_dir():
            raise InputError(f"--{name} {path}: folder {path.parent} does not exist; create it")
