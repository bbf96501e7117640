"""``safedpa experiment faults``: things fail while a robot drives; is it safe, and does it recover?"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import sys
import time
from pathlib import Path
from typing import Any

import click

from safedpa.errors import InputError, SafedpaError
from safedpa.extras import needs

__all__ = ["command"]

_PIPE_COLUMNS = 120
_MOST_MINUTES = 1440


@click.command(name="faults")
@click.option("--only", metavar="NAME", help="one fault by its name, or all of a kind, such as kill")
@click.option("--small", is_flag=True, help="a few of them, half a minute")
@click.option(
    "--minutes",
    type=click.FloatRange(min=1.0),  # below, no process is old enough to be judged
    metavar="M",
    help="so long, on one fleet, in an order of the seed; memory and open files of its processes are told",
)
@click.option("--list", "listed", is_flag=True, help="print the table of faults and run none")
@click.option("--seed", type=int, default=9, show_default=True, help="of scenes and of lost messages")
@click.option("--keep", type=click.Path(path_type=Path), metavar="DIR", help="keep logs, traces and recordings there")
@click.option("--out", type=click.Path(path_type=Path), metavar="DIR", help="folder for faults.json and faults.md")
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
@needs("sim")
def command(**options: Any) -> None:
    """Faults on a fleet of real processes that drives in real time.

    A car with a box drives behind router and filter. Processes are killed, paused and made to hang, networks are cut,
    delayed and made to lose messages, clocks set, the disk filled. Exit code 1 when an invariant did not hold: no
    collision, no stale action, and the loop drives again; with --minutes also when a process grew.
    """
    from safedpa_lab.faults.table import all_faults, faults_for, faults_named, small_faults

    if options["minutes"] and (options["only"] or options["small"]):
        raise InputError("--minutes: takes all faults that one fleet can suffer; leave --only and --small out")
    if options["minutes"] and not options["minutes"] <= _MOST_MINUTES:  # so that NaN is refused as well
        raise InputError(f"--minutes: got {options['minutes']:g}, wanted {_MOST_MINUTES} at most, which is a day")
    faults = faults_named(options["only"]) if options["only"] else all_faults()
    if options["minutes"]:
        faults = faults_for(60.0 * options["minutes"], options["seed"])
    if options["small"]:
        faults = [fault for fault in faults if fault in small_faults()] if options["only"] else small_faults()
    if not faults:
        raise InputError(f"--only '{options['only']}': none of these is in the small version; leave --small out")
    if options["listed"]:
        for fault in faults:
            click.echo(f"{fault.name:28}{fault.sentence}")
        return
    result = _measured(faults, options)
    if options["out"] is not None:
        from safedpa_lab.faults.report import write_report

        write_report(result, options["out"])
    if options["as_json"]:
        click.echo(json.dumps(result))
    else:
        _report(result)
    if not result["held"]:
        between = "something between the faults, or the recorder's acknowledgement"
        broken = [row["name"] for row in result["rows"] if not row["held"]]
        broken += [f"{row['name']} grew" for row in result["resources"] if not row["flat"]]
        broken = broken or [between]
        raise SafedpaError(f"faults: did not hold: {', '.join(broken)}")


def _measured(faults: Any, options: dict[str, Any]) -> dict[str, Any]:
    from safedpa_lab.faults.campaign import run_faults
    from safedpa_lab.faults.endurance import Resources, retained_by
    from safedpa_services.progress import progress

    began, load, resources = time.monotonic(), os.getloadavg()[0], Resources()
    with progress("experiment faults") as report_progress:
        campaign = run_faults(
            faults,
            options["seed"],
            options["keep"],
            lambda _, done, count: report_progress(done, count),
            is_hasty=options["small"],
            seconds=60.0 * (options["minutes"] or math.inf),
            alongside=resources.alongside,
        )
    retained = retained_by(resources.samples) if options["minutes"] else []
    return {
        "experiment": "faults",
        "command": _command(options),
        "date": time.strftime("%Y-%m-%d %H:%M"),
        "seed": options["seed"],
        "seconds": round(time.monotonic() - began, 1),
        "cores": os.cpu_count(),
        "load_before": load,
        "load_after": os.getloadavg()[0],
        "held": campaign.held and all(one.flat for one in retained),
        "periods": campaign.periods,
        "collisions": campaign.collisions,
        "stale_actions": campaign.stale_actions,
        "acknowledged": campaign.acknowledged,
        "recorded": campaign.recorded,
        "resources": [dataclasses.asdict(one) | {"flat": one.flat} for one in retained],
        "rows": [dataclasses.asdict(outcome) for outcome in campaign.outcomes],
    }


def _command(options: dict[str, Any]) -> str:
    notice = f" --only '{options['only']}'" if options["only"] else ""
    notice += f" --minutes {options['minutes']:g}" if options["minutes"] else ""
    return f"safedpa experiment faults{notice}{' --small' if options['small'] else ''} --seed {options['seed']}"


def _report(result: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, padding=(0, 1), title="periods of 0.05 s; times in s from the recovery")
    for column in ("fault", "held", "hits", "stale", "watchdog", "fallback", "drives", "back", "not recorded"):
        table.add_column(column, justify="left" if column == "fault" else "right", no_wrap=True)
    for row in result["rows"]:
        table.add_row(*_cells(row))
    Console(width=None if sys.stdout.isatty() else _PIPE_COLUMNS).print(table)
    click.echo(
        f"{result['periods']} periods in all: {result['collisions']} collisions, {result['stale_actions']} stale "
        f"actions; recordings hold {result['recorded']} messages, {result['acknowledged']} were acknowledged"
    )
    for row in result["resources"]:
        grew = "" if row["flat"] else ": it grew"
        (first, last), (few, many) = row["mib"], row["handles"]
        click.echo(f"{row['name']}: {first:.0f} to {last:.0f} MiB, {few} to {many} open files{grew}")
    for row in result["rows"]:
        if not row["held"]:
            click.echo(f"{row['name']}: {'; '.join(row['broken'])}")


def _cells(row: dict[str, Any]) -> list[str]:
    def seconds(value: float | None) -> str:
        return "never" if value is None else f"{value:.2f}"

    return [
        row["name"],
        "yes" if row["held"] else "no",
        *(str(row[name]) for name in ("collisions", "stale_actions")),
        *(f"{row[name]}/{row['periods']}" for name in ("watchdog", "fallbacks")),
        seconds(row["recovery_seconds"]),
        seconds(row["whole_seconds"]),
        f"{row['states_not_recorded']}, {row['verdicts_not_recorded']}",
    ]
