"""``safedpa experiment margins``: the margins that ship, over whole drives, and how often they hold."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

__all__ = ["command"]


@click.command(name="margins")
@click.option("--robot", "robots", multiple=True, help="name of a margin that ships; default: all of them")
@click.option("--drives", type=int, default=200, show_default=True, help="to calibrate on, for each robot")
@click.option("--fresh", type=int, default=200, show_default=True, help="to count on, for each kind of margin")
@click.option("--kind", "kinds", multiple=True, help="conformal (for a step) or drive: behind which; default: both")
@click.option("--seconds", type=float, default=0.0, help="of a drive; default: as each robot has it")
@click.option("--coverage", type=float, default=0.99, show_default=True, help="of steps, and of drives")
@click.option("--processes", type=int, default=2, show_default=True)
@click.option("--minutes", type=float, default=0.0, help="begin no drive after so long; run again to go on")
@click.option("--out", type=click.Path(path_type=Path), required=True, help="folder that keeps every drive")
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
def command(**options: Any) -> None:
    """Calibrate the margins of the shipped robots on whole drives, and count what they cover on fresh ones."""
    from safedpa_services.progress import progress
    from safedpa_sim.experiments.margin_drives import DRIVERS
    from safedpa_sim.experiments.margins import KINDS, MarginCases, margins_experiment

    as_json = options.pop("as_json")
    options["robots"] = options["robots"] or tuple(DRIVERS)
    options["kinds"] = options["kinds"] or KINDS
    with progress("experiment margins") as tell:
        result = margins_experiment(MarginCases(**options), tell)
    (options["out"] / "margins.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    if as_json:
        click.echo(json.dumps(result))
    else:
        _tell(result, options["out"])


def _tell(result: dict[str, Any], out: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"margins at {100 * result['coverage']:g} %, fresh drives", box=None)
    for column in ("robot", "barrier", "margin", "epsilon", "steps covered", "drives covered", "goals a minute"):
        table.add_column(column, justify="left" if column in ("robot", "barrier", "margin") else "right")
    for name, row in result["robots"].items():
        for kind in ("conformal", "drive"):
            fresh = row.get(f"fresh_{kind}", {})
            for barrier, covered in fresh.get("covered", {}).items():
                one, goals = covered[kind], fresh["goals_a_minute"]
                table.add_row(
                    name,
                    barrier,
                    kind,
                    f"{one['epsilon']:.4f}",
                    _share(one["steps"], one["steps_95"]),
                    f"{_share(one['drives'], one['drives_95'])} of {covered['drives']}",
                    f"{goals[0]:.2f} ({goals[1]:.2f} to {goals[2]:.2f})",
                )
    Console(width=160).print(table)
    click.echo(f"margins: {out}/ROBOT/margin.toml")
    if result["missing"]:
        click.echo(f"{result['missing']} drives are missing; run the same command again to go on")


def _share(share: float, interval: list[float]) -> str:
    return f"{100 * share:.2f} % ({100 * interval[0]:.2f} to {100 * interval[1]:.2f})"
