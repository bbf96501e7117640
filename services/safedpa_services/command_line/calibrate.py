"""``safedpa calibrate``: calibrates the filter's margins on recorded drives."""

from __future__ import annotations

from pathlib import Path

import click

from safedpa.systems.robots import DEFAULT_ROBOT
from safedpa_services.command_line.json_answer import answers_json, report_progress
from safedpa_services.command_line.names import complete_models


@click.command()
@click.argument("recordings", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--model",
    shell_complete=complete_models,
    default=DEFAULT_ROBOT,
    show_default=True,
    help="model file, or the name of one that ships",
)
@click.option("--settings", default=DEFAULT_ROBOT, show_default=True, help="settings of the filter: a file or a name")
@click.option(
    "--coverage",
    type=float,
    default=0.99,
    show_default=True,
    help="fraction of steps, and of drives, that a margin covers",
)
@click.option(
    "--out", type=click.Path(path_type=Path), required=True, help="margin file to write, for the option --margin"
)
@answers_json
def command(recordings: tuple[Path, ...], model: str, settings: str, coverage: float, out: Path) -> None:
    """Calibrate the filter's margins from RECORDINGS (MCAP).

    A margin covers the amount by which h falls below its prediction. The recordings must not have been used for
    fitting.

    Four fifths of the drives give the margins, for a step and for a whole drive; their coverage is measured on the last
    fifth. Fewer than 123 drives (for 99 %) are cut into blocks instead and give no margin for a whole drive. The
    setting ``margin`` selects the margin that a filter uses: conformal, drive or theorem.
    """
    from safedpa.api.calibrating import calibrate

    found = calibrate(recordings, model=model, settings=settings, coverage=coverage, out=out)
    report_progress(str(found))
    report_progress(f"margin: {out}", facts=found.to_dict())
