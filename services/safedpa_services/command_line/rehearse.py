"""``safedpa rehearse``: tests on simulated copies of runs which effects a diagnosis would find, and of which size."""

from __future__ import annotations

import json
from pathlib import Path

import click

from safedpa.extras import needs
from safedpa_services.command_line.names import complete_models
from safedpa_services.command_line.options import (
    as_json_option,
    columns_option,
    effects_option,
    runs_argument,
)


@click.command(name="rehearse")
@click.argument("model", shell_complete=complete_models)
@runs_argument
@columns_option
@effects_option
@click.option(
    "--effect", "names", multiple=True, metavar="NAME", help="Effect to hide; may be given several times; default: all."
)
@click.option(
    "--size", "sizes", type=float, multiple=True, default=(1.0,), show_default=True,
    help="Size of the hidden effect, relative to its typical size; may be given several times.",
)  # fmt: skip
@click.option("--seed", type=int, default=0, show_default=True, help="Seed of the noise.")
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
    """Test which effects a diagnosis of RUNs would find.

    Simulates the runs with a hidden effect that MODEL lacks, and tries to find it. The simulation uses the commands and
    the noise of the runs. The result says whether drives like these would show an effect. Takes the time of one
    diagnosis per effect and size.
    """
    from safedpa.api.planning import rehearse

    found = rehearse(model, runs, columns=columns, effects=effects, effect=names, size=sizes, seed=seed)
    if as_json:
        click.echo(json.dumps(found.to_dict(), allow_nan=False))
        return
    for trial in found.trials:
        unit = "" if trial.unit == "1" else f" {trial.unit}"
        named = ", ".join(trial.named) or trial.verdict.replace("_", " ")
        verdict = "found" if trial.found else "not found"
        expected = "as predicted" if trial.found == trial.predicted else "contrary to the prediction"
        click.echo(f"{trial.effect} {trial.parameter} {trial.size:.3g}{unit}: {verdict} ({named}), {expected}")
    click.echo(f"{found.agreeing} of {len(found.trials)} as 'safedpa diagnose --check' predicts for these runs")
