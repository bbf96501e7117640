"""``safedpa rehearse``: what a diagnosis of one's own drives would find, and at which size."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import click

from safedpa.errors import InputError
from safedpa.extras import needs
from safedpa_services.command_line.names import complete_models
from safedpa_services.command_line.options import (
    as_json_option,
    columns_option,
    effects_option,
    load_given_model,
    load_runs,
    runs_argument,
)

__all__ = ["command"]


@click.command(name="rehearse")
@click.argument("model", shell_complete=complete_models)
@runs_argument
@columns_option
@effects_option
@click.option("--effect", "names", multiple=True, metavar="NAME", help="May be given several times; default: all.")
@click.option(
    "--size", "sizes", type=float, multiple=True, default=(1.0,), show_default=True,
    help="In ordinary sizes; may be given several times.",
)  # fmt: skip
@click.option("--seed", type=int, default=0, show_default=True, help="Draws the noise.")
@as_json_option
@needs("diagnosis")
def command(
    model: str,
    runs: tuple[str, ...],
    columns: str | None,
    effects: Path | None,
    names: tuple[str, ...],
    sizes: tuple[float, ...],
    seed: int,
    as_json: bool,
) -> None:
    """Rehearse a diagnosis of RUNs: hide each effect that MODEL may lack in their commands, and look for it.

    The runs are simulated again, with their own commands and noise, and diagnosed: does a drive like these show what one
    wants to know? Takes a diagnosis for each effect and size.
    """
    from safedpa.diagnosis.identifiability.rehearsal import rehearse_diagnosis
    from safedpa_services.progress import progress

    if seed < 0 or not all(size > 0 for size in sizes):
        raise InputError("--size: wanted more than 0; --seed: wanted 0 or more")
    loaded = load_given_model(model, effects)
    recorded = load_runs(loaded, runs, columns)
    with progress("rehearsing") as report_progress:
        found = rehearse_diagnosis(loaded, recorded, sizes, names, seed, report_progress)
    if as_json:
        trials = [asdict(trial) for trial in found.trials]
        click.echo(json.dumps({"format": 1, "trials": trials, "agreeing": found.agreeing}, allow_nan=False))
        return
    for trial in found.trials:
        unit = "" if trial.unit == "1" else f" {trial.unit}"
        notice = ", ".join(trial.named) or trial.verdict.replace("_", " ")
        verdict = "found" if trial.found else "not found"
        expected = "as expected" if trial.found == trial.predicted else "against what the sensitivities say"
        click.echo(f"{trial.effect} {trial.parameter} {trial.size:.3g}{unit}: {verdict} ({notice}), {expected}")
    click.echo(f"{found.agreeing} of {len(found.trials)} as the check of these runs foretells (diagnose --check)")
