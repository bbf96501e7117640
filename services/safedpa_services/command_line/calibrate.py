"""``safedpa calibrate``: the filter's margin from recorded drives."""

from __future__ import annotations

import time
from pathlib import Path

import click


@click.command()
@click.argument("recordings", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--model", default="car", show_default=True, help="model file, or the name of one that ships")
@click.option("--settings", default="car", show_default=True, help="settings of the filter: a file or a name")
@click.option("--coverage", type=float, default=0.99, show_default=True, help="share of steps that the margin covers")
@click.option("--out", type=click.Path(path_type=Path), required=True, help="margin file, for the filter's --margin")
def command(recordings: tuple[Path, ...], model: str, settings: str, coverage: float, out: Path) -> None:
    """Calibrate the margin: how much worse h turned out than predicted, on RECORDINGS (MCAP) not used for fitting."""
    from safedpa.dynamics import load_model
    from safedpa.safety.recorded import calibration_from_recordings
    from safedpa.safety.shipped import settings_named

    calibration = calibration_from_recordings(
        load_model(model), settings_named(settings), recordings, coverage, time.strftime("%Y-%m-%d")
    )
    calibration.save(out)
    click.echo(f"{calibration.transitions} transitions, coverage {coverage:g}")
    for kind, epsilon in calibration.epsilon.items():
        click.echo(f"  {kind:<10} epsilon {epsilon:.4f}")
    click.echo(f"margin: {out}")
