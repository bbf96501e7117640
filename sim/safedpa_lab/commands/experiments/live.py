"""``safedpa experiment live``: something changes while the car drives; is it found, named and corrected?"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from safedpa.errors import InputError
from safedpa.extras import needs
from safedpa_lab.provenance.record import write_result
from safedpa_services.command_line.names import SuggestingChoice

__all__ = ["command"]

_CASES = ("hitch", "headwind", "steering_offset", "nothing", "all")


@click.command(name="live")
@click.option("--case", "case", type=SuggestingChoice(_CASES), default="all", show_default=True, help="what changes")
@click.option("--seed", type=int, default=1, show_default=True, help="of the first scene")
@click.option(
    "--drives", type=int, default=10, show_default=True, help="scenes of each case in which something changes"
)
@click.option("--after", type=float, default=30.0, show_default=True, help="s of driving before the change")
@click.option("--hours", type=float, default=1.0, show_default=True, help="of driving in which nothing changes, in all")
@click.option("--quiet-drives", type=int, default=1, show_default=True, help="scenes over which those hours are spread")
@click.option("--processes", type=int, default=1, show_default=True)
@click.option("--record", type=click.Path(path_type=Path), metavar="FILE.mcap", help="one drive alone, recorded")
@click.option("--out", type=click.Path(path_type=Path), help="write the result there as JSON as well")
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
@needs("sim")
def command(**options: Any) -> None:
    """Diagnosis next to a driving car, in lockstep.

    The car drives behind the safety filter with a model of the car alone. hitch: a chair is hitched. headwind: a steady
    wind begins. steering_offset: the linkage is bent. The diagnosis raises a finding, names the effect, and the first
    effect that unseen data confirm is accepted by itself; the error before and after is told. nothing: nothing changes,
    and nothing may be found.
    """
    _check(options)
    result = _recorded(options) if options["record"] is not None else _measured(options)
    if options["out"] is not None:
        write_result(options["out"], result)
    if options["as_json"]:
        click.echo(json.dumps(result))
    elif options["record"] is not None:
        click.echo(f"recording: {options['record']}")
    else:
        _report(result)


def _check(options: dict[str, Any]) -> None:
    for name in ("drives", "hours", "quiet_drives", "processes"):
        if not options[name] > 0:
            raise InputError(f"--{name.replace('_', '-')}: got {options[name]}, wanted more than 0")
    if options["seed"] < 0 or not 25.0 <= options["after"] < 1e5:
        raise InputError(
            "--seed: wanted 0 or more; --after: wanted 25 s or more, the band is learned in the first 20 s"
        )
    for name in ("out", "record"):
        path = options[name]
        if path is not None and not path.absolute().parent.is_dir():
            raise InputError(f"--{name} {path}: folder {path.parent} does not exist; create it")
    if options["record"] is not None and options["case"] == "all":
        raise InputError("--record: got --case all, wanted one case; a recording holds one drive")


def _recorded(options: dict[str, Any]) -> dict[str, Any]:
    import dataclasses

    from safedpa_lab.experiments.live_record import record_drive

    seconds = 120.0 + options["after"]
    drive = record_drive(options["case"], options["seed"], seconds, options["after"], options["record"])
    return {"experiment": "live", "recording": str(options["record"]), **dataclasses.asdict(drive)}


def _measured(options: dict[str, Any]) -> dict[str, Any]:
    from safedpa_lab.experiments.live import LiveExperiment, live_experiment
    from safedpa_services.progress import progress

    first, quiet = options["seed"], options["quiet_drives"]
    experiment = LiveExperiment(
        cases=_CASES[:-1] if options["case"] == "all" else (options["case"],),
        seeds=tuple(range(first, first + options["drives"])),
        quiet_seeds=tuple(range(first, first + quiet)),
        quiet_seconds=3600.0 * options["hours"] / quiet,
        change_after=options["after"],
        processes=options["processes"],
    )
    with progress("experiment live") as report_progress:
        return {"experiment": "live", **live_experiment(experiment, report_progress)}


def _report(result: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    if result["rows"]:
        table = Table(
            title=f"the change comes after {result['change_after']:g} s; medians in s, errors over 1 s", box=None
        )
        for column in ("case", "raised", "after", "named", "after", "first", "error", "then", "fell", "hits"):
            table.add_column(column, justify="left" if column == "case" else "right", no_wrap=True)
        for row in result["rows"]:
            table.add_row(*_cells(row))
        Console().print(table)
    if result["quiet"] is not None:
        quiet = result["quiet"]
        click.echo(
            f"nothing changed in {quiet['hours']:g} h: {quiet['findings']} findings (stated: any with probability "
            f"{quiet['stated_probability_at_most']:.2%} at most), {quiet['collisions']} collisions"
        )


def _cells(row: dict[str, Any]) -> list[str]:
    def number(name: str, digits: int) -> str:
        value = row[f"{name}_median"]
        return "" if value is None else f"{value:.{digits}f}"

    count = row["drives"]
    return [
        row["case"],
        f"{row['raised_in_time']}/{count}",
        number("seconds_to_finding", 1),
        f"{row['named_in_time']}/{count}",
        number("seconds_to_effect", 1),
        f"{row['first']}/{count}",
        number("before", 3),
        number("after", 3),
        f"{row['fell_in_time']}/{count}",
        str(row["collisions"]),
    ]
