"""``safedpa experiment real-logs``: diagnosis on recordings of real robots."""

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

_PARTS = ("car", "pendulum", "balls", "all")
_BALL = Path(__file__).resolve().parents[4] / "docs" / "examples" / "falling_ball.py"
"""Where it lies in a working copy of the project."""


@click.command(name="real-logs")
@click.option(
    "--data",
    type=click.Path(path_type=Path),
    required=True,
    metavar="DIR",
    help="folder with the recordings: see docs/real-logs.md for where they are",
)
@click.option("--part", type=SuggestingChoice(_PARTS), default="all", show_default=True)
@click.option(
    "--ball",
    type=click.Path(path_type=Path),
    metavar="FILE.py",
    help="defines the falling ball; see docs/own-system.md",
)
@click.option("--processes", type=int, default=2, show_default=True)
@click.option("--out", type=click.Path(path_type=Path), help="write the result there as JSON as well")
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
@needs("diagnosis")
def command(**options: Any) -> None:
    """What diagnosis finds in recordings of real robots.

    A 1:10 car (four drives), a torque-limited pendulum (six logs), and balls dropped from a bridge. The car is also
    diagnosed on every three of its logs, and judged by the fourth, which neither the search nor the fit saw, and the
    model of all four by drives of another day, where they are in the folder. ``outside`` is the share of the judging
    log's rows about which the other logs hold less than a second of driving at such a speed and throttle.
    """
    from safedpa_lab.experiments.real_logs import PARTS, RealLogs, real_logs_experiment
    from safedpa_services.progress import progress

    if options["processes"] < 1:
        raise InputError(f"--processes: got {options['processes']}, wanted more than 0")
    if not options["data"].is_dir():
        raise InputError(
            f"--data {options['data']}: no such folder; see docs/real-logs.md for where the recordings are"
        )
    out, ball = options["out"], options["ball"]
    if out is not None and not out.absolute().parent.is_dir():
        raise InputError(f"--out {out}: folder {out.parent} does not exist; create it")
    if ball is None and _BALL.is_file():
        ball = _BALL
    parts = PARTS if options["part"] == "all" else (options["part"],)
    with progress("experiment real-logs") as report_progress:
        result = real_logs_experiment(RealLogs(options["data"], ball, parts, options["processes"]), report_progress)
    if out is not None:
        write_result(out, result)
    if options["as_json"]:
        click.echo(json.dumps(result))
    else:
        _report(result)


def _report(result: dict[str, Any]) -> None:
    from rich.console import Console

    console = Console(highlight=False)
    console.print(_rows(result["rows"]))
    console.print(_targets(result["targets"]))
    for row in result["rows"]:
        for other in row.get("other_days", ()):
            before, after = other["unseen_before"], other["unseen_after"]
            outside = f"{other['unseen_outside']:.0%} of its rows outside of what the fit saw"
            change = f"{before:.3f} to {after:.3f}, {after / before - 1.0:+.0%}"
            console.print(f"Another day, {other['name']}: {change}; {outside}")
    if result["stable_names"]:
        folds = sum(1 for row in result["rows"] if "unseen_change" in row)
        names = ", ".join(f"{name} {count}/{folds}" for name, count in result["stable_names"].items())
        console.print(f"Named with one log left out: {names}", markup=False)


def _rows(rows: list[dict[str, Any]]) -> Any:
    from rich.table import Table

    table = Table(box=None, padding=(0, 1, 0, 0))
    for name in ("recordings", "added, in order"):
        table.add_column(name, overflow="fold")
    for name in ("error", "after", "change", "unseen", "outside", "s"):
        table.add_column(name, justify="right", no_wrap=True)
    for row in rows:
        every = "car, all logs" if row["part"] == "car" else row["part"]
        left_out = f"car, without {row['name'].removesuffix('.csv')[-8:]}"
        name = (left_out if row["part"] == "car" else row["name"]) if row["name"] else every
        unseen = f"{100 * row['unseen_change']:+.0f} %" if "unseen_change" in row else ""
        outside = f"{100 * row['unseen_outside']:.0f} %" if "unseen_outside" in row else ""
        added = ", ".join(row["added"]) or row["verdict"].replace("_", " ")
        numbers = (f"{row['errors'][0]:.3f}", f"{row['errors'][-1]:.3f}", f"{100 * row['change']:+.0f} %")
        table.add_row(name, added, *numbers, unseen, outside, f"{row['seconds']:.0f}")
    return table


def _targets(targets: list[dict[str, Any]]) -> Any:
    from rich.table import Table

    table = Table(box=None, padding=(0, 1, 0, 0))
    for name in ("of", "asked", "measured", ""):
        table.add_column(name, overflow="fold")
    for item in targets:
        table.add_row(item["subject"], item["asked"], item["measured"], "met" if item["met"] else "missed")
    return table
