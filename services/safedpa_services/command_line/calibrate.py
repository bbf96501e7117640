"""``safedpa calibrate``: calibrates the filter's margins on recorded drives."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

from safedpa.systems.robots import DEFAULT_ROBOT
from safedpa_services.command_line.json_answer import answers_json, report_progress
from safedpa_services.command_line.names import complete_models

if TYPE_CHECKING:
    from safedpa.safety import MarginCalibration


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
    from safedpa.calibration.from_recordings import calibration_from_recordings
    from safedpa.comparison.output import refuse_inputs, require_writable_folder
    from safedpa.dynamics import load_model
    from safedpa.safety.defaults import settings_named

    refuse_inputs([out], recordings)
    require_writable_folder(out.parent)
    calibration = calibration_from_recordings(
        load_model(model), settings_named(settings), recordings, coverage, time.strftime("%Y-%m-%d")
    )
    calibration.save(out)
    _report(calibration, out)


def _report(calibration: MarginCalibration, out: Path) -> None:
    drives = (
        f" of {calibration.drives} drives" if calibration.drives else ", too few drives for a margin of a whole drive"
    )
    report_progress(f"{calibration.transitions} transitions{drives}")
    report_progress(f"coverage {calibration.coverage:g}; epsilon (coverage on held-out data)")
    for kind, epsilon in calibration.epsilon.items():
        line = f"  {kind:<10} conformal {epsilon:.4f}{_share(calibration, 'conformal', kind)}"
        if kind in calibration.drive:
            line += f"   drive {calibration.drive[kind]:.4f}{_share(calibration, 'drive', kind)}"
        if kind in calibration.theorem:
            line += f"   theorem {calibration.theorem[kind]:.4f}{_share(calibration, 'theorem', kind)}"
        report_progress(line)
    facts = {name: dict(getattr(calibration, name)) for name in ("epsilon", "drive", "theorem", "covered")}
    facts |= {name: getattr(calibration, name) for name in ("transitions", "drives", "coverage")}
    report_progress(f"margin: {out}", facts={"margin": str(out), **facts})


def _share(calibration: MarginCalibration, name: str, kind: str) -> str:
    share = calibration.covered.get(f"{name}.{kind}")
    return "" if share is None else f" ({100 * share:.2f} %)"
