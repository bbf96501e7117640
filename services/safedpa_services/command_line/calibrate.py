"""``safedpa calibrate``: the filter's margins from recorded drives."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

from safedpa.robot import DEFAULT_ROBOT
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
    "--coverage", type=float, default=0.99, show_default=True, help="share of steps, and of drives, that are covered"
)
@click.option("--out", type=click.Path(path_type=Path), required=True, help="margin file, for the filter's --margin")
@answers_json
def command(recordings: tuple[Path, ...], model: str, settings: str, coverage: float, out: Path) -> None:
    """Calibrate the margins: how much worse h turned out than predicted, on RECORDINGS (MCAP) not used for fitting.

    Four fifths of the drives make the margins, for a step and for a whole drive; on the last fifth they are counted.
    Fewer than 123 drives (for 99 %) are cut into blocks instead, and say nothing about drives. The setting ``margin``
    says which of the margins a filter uses: conformal, drive or theorem.
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
        f" of {calibration.drives} drives" if calibration.drives else ", too few drives to say anything about drives"
    )
    report_progress(f"{calibration.transitions} transitions{drives}")
    report_progress(f"coverage {calibration.coverage:g}; epsilon, and share of what is fresh")
    for kind, epsilon in calibration.epsilon.items():
        line = f"  {kind:<10} conformal {epsilon:.4f}{_share(calibration, 'conformal', kind)}"
        if kind in calibration.drive:
            line += f"   drive {calibration.drive[kind]:.4f}{_share(calibration, 'drive', kind)}"
        if kind in calibration.theorem:
            line += f"   theorem {calibration.theorem[kind]:.4f}{_share(calibration, 'theorem', kind)}"
        report_progress(line)
    reported = {name: dict(getattr(calibration, name)) for name in ("epsilon", "drive", "theorem", "covered")}
    reported |= {name: getattr(calibration, name) for name in ("transitions", "drives", "coverage")}
    report_progress(f"margin: {out}", facts={"margin": str(out), **reported})


def _share(calibration: MarginCalibration, name: str, kind: str) -> str:
    share = calibration.covered.get(f"{name}.{kind}")
    return "" if share is None else f" ({100 * share:.2f} %)"
