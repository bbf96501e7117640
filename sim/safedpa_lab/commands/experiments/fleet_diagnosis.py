"""``safedpa experiment fleet-diagnosis``: a simulated fleet, its diagnosis, and the truth."""

from __future__ import annotations

import json
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click

from safedpa.errors import InputError
from safedpa.extras import needs
from safedpa_lab.commands.positive import check_positive
from safedpa_lab.provenance.record import write_result

__all__ = ["command"]


@click.command(name="fleet-diagnosis")
@click.option("--robots", type=int, default=60, show_default=True)
@click.option("--seed", type=int, default=0, show_default=True, help="draws faults, drives and noise")
@click.option("--plain", is_flag=True, help="logs without disturbance, glitches, lost rows and gains that are off")
@click.option("--common", is_flag=True, help="hide a weak air drag in all robots next to")
@click.option("--screen", is_flag=True, help="instead: what a search of those with large errors alone would miss")
@click.option("--runs", type=int, default=4, show_default=True, help="of each robot")
@click.option("--seconds", type=float, default=40.0, show_default=True, help="of each run")
@click.option("--jobs", type=int, default=2, show_default=True, help="processes with one thread each")
@click.option("--out", type=click.Path(path_type=Path), help="folder for recordings and pages; else they are not kept")
@click.option("--record", type=click.Path(path_type=Path), metavar="FILE.json", help="write the result there as well")
@click.option("--page", type=click.Path(path_type=Path), metavar="FILE.md", help="write the tables there as well")
@click.option("--json", "as_json", is_flag=True, help="print one JSON document and nothing else")
@needs("sim", "diagnosis")
def command(**options: Any) -> None:
    """How well the diagnosis of a fleet finds which robots lack what.

    5 % of the robots have a dragging brake, 3 % a bent steering, one stands on a slope, the rest lack nothing. The
    truth is opened afterwards. With --out an interrupted experiment goes on.
    """
    from safedpa_lab.experiments.fleet_diagnosis import fleet_diagnosis_experiment, page_of
    from safedpa_services.progress import progress

    _check(options)
    if options["screen"]:
        _screened(options)
        return
    given = {key: options[key] for key in ("jobs", "common", "runs", "seconds")}
    with ExitStack() as stack:
        folder = options["out"] or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="safedpa-fleet-")))
        folder.mkdir(parents=True, exist_ok=True)
        report_progress = stack.enter_context(progress("experiment fleet-diagnosis"))
        result = fleet_diagnosis_experiment(
            options["robots"],
            options["seed"],
            folder.resolve(),
            hard=not options["plain"],
            report_progress=report_progress,
            **given,
        )
    if options["record"] is not None:
        write_result(options["record"], result)
    page = page_of(result, _text(options))
    if options["page"] is not None:
        options["page"].write_text(page, encoding="utf-8")
    click.echo(json.dumps(result, allow_nan=False) if options["as_json"] else page.rstrip())


def _screened(options: dict[str, Any]) -> None:
    from safedpa_lab.experiments.fleet_screen import fleet_screen
    from safedpa_services.progress import progress

    with progress("experiment fleet-diagnosis --screen") as report_progress:
        result = fleet_screen(options["seed"], hard=not options["plain"], report_progress=report_progress)
    if options["record"] is not None:
        write_result(options["record"], result)
    if options["as_json"]:
        click.echo(json.dumps(result))
        return
    count, quantile = result["effects"], 100 * result["quantile"]
    click.echo(
        f"{len(result['missed'])} of {count} effects lie within the errors of {quantile:.0f} % of healthy robots."
    )
    for row in result["rows"]:
        click.echo(f"{row['effect']:22} error {row['error']:.4f}, {row['over_limit']:.3f} of the limit")


def _check(options: dict[str, Any]) -> None:
    if options["robots"] < 5 or options["jobs"] < 1 or options["runs"] < 1 or options["seed"] < 0:
        raise InputError("--robots: wanted 5 or more; --jobs, --runs: wanted 1 or more; --seed: wanted 0 or more")
    check_positive(options, "seconds")
    for name in ("record", "page"):
        path = options[name]
        if path is not None and not path.absolute().parent.is_dir():
            raise InputError(f"--{name} {path}: folder {path.parent} does not exist; create it")


def _text(options: dict[str, Any]) -> str:
    """The command line that does the same again."""
    phrase = [f"safedpa experiment fleet-diagnosis --robots {options['robots']} --seed {options['seed']}"]
    phrase += [f"--{name}" for name in ("plain", "common") if options[name]]
    phrase += [f"--runs {options['runs']}"] if options["runs"] != 4 else []
    phrase += [f"--seconds {options['seconds']:g}"] if options["seconds"] != 40.0 else []
    return " ".join(phrase)
