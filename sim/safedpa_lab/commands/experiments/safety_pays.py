"""``safedpa experiment safety-pays``: the same filter with an incomplete, a diagnosed and a perfect model."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from safedpa.errors import InputError, did_you_mean
from safedpa.extras import needs
from safedpa_lab.commands.positive import check_positive
from safedpa_lab.provenance.record import write_result

__all__ = ["command"]


@click.command(name="safety-pays")
@click.option("--hidden", "hidden", multiple=True, help="only this one; may be repeated: see the docs for the names")
@click.option("--seeds", type=int, default=40, show_default=True, help="scenes of each")
@click.option("--first-seed", type=int, default=0, show_default=True)
@click.option("--seconds", type=float, default=20.0, show_default=True, help="of driving in each episode")
@click.option("--drives", type=int, default=4, show_default=True, help="training drives that diagnosis sees")
@click.option("--drive-seconds", type=float, default=30.0, show_default=True)
@click.option("--processes", type=int, default=2, show_default=True)
@click.option("--out", type=click.Path(path_type=Path), help="write the result there as JSON as well")
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
@needs("sim", "diagnosis")
def command(**options: Any) -> None:
    """What knowing the missing effect is worth.

    The pymunk car with a bent linkage, a slow link or a chair that the model does not know; the filter drives it with
    the incomplete model, with the one that diagnosis made of it, and with the truth.
    """
    from safedpa_lab.experiments.hidden_car import HIDDEN
    from safedpa_lab.experiments.safety_pays import SafetyPays, safety_pays
    from safedpa_services.progress import progress

    check_positive(options, "seeds", "seconds", "drives", "drive_seconds", "processes")
    for name in options["hidden"]:
        if name not in HIDDEN:
            raise InputError(f"--hidden: got '{name}'; {did_you_mean(name, HIDDEN)}")
    out = options["out"]
    if out is not None and not out.absolute().parent.is_dir():
        raise InputError(f"--out {out}: folder {out.parent} does not exist; create it")
    seeds = range(options["first_seed"], options["first_seed"] + options["seeds"])
    experiment = SafetyPays(
        hidden=options["hidden"] or tuple(HIDDEN),
        seeds=tuple(seeds),
        **{name: options[name] for name in ("seconds", "drives", "drive_seconds", "processes")},
    )
    with progress("experiment safety-pays") as report_progress:
        result = {"experiment": "safety-pays", **safety_pays(experiment, report_progress)}
    if out is not None:
        write_result(out, result)
    if options["as_json"]:
        click.echo(json.dumps(result))
    else:
        _report(result)


def _report(result: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"{len(result['seeds'])} scenes of {result['seconds']:g} s each", box=None)
    for column in ("hidden", "model", "safe", "95 %", "h below 0", "margin m", "changed", "goals", "first goal s"):
        table.add_column(column, justify="left" if column in ("hidden", "model") else "right")
    for row in result["rows"]:
        low, high = row["safe_share_95"]
        first = row["first_goal_median"]
        table.add_row(
            row["hidden"],
            row["model"],
            f"{row['safe_episodes']}/{row['episodes']}",
            f"{100 * low:.0f}-{100 * high:.0f}",
            str(row["below_zero"]),
            f"{row['epsilon']['obstacle']:.3f}",
            f"{100 * row['intervention_share']:.0f} %",
            str(row["goals"]),
            "" if first is None else f"{first:.1f}",
        )
    Console().print(table)
