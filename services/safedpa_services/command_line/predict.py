"""``safedpa predict``: writes a model's open-loop predictions along a recorded run."""

from __future__ import annotations

from pathlib import Path

import click

from safedpa.extras import needs
from safedpa_services.command_line.json_answer import answers_json, report_progress
from safedpa_services.command_line.names import complete_models
from safedpa_services.command_line.options import (
    columns_option,
    effects_option,
    force_option,
    horizon_option,
)  # fmt: skip


@click.command(name="predict")
@click.argument("model", shell_complete=complete_models)
@click.argument("run")
@columns_option
@horizon_option(None)
@click.option("--out", type=click.Path(path_type=Path), required=True, metavar="FILE.csv", help="File to write.")
@effects_option
@force_option
@answers_json
@needs("diagnosis")
def command(
    model: str, run: str, columns: str | None, horizon: float, out: Path, effects: Path | None, force: bool
) -> None:
    """Predict RUN with MODEL, open loop, from every tenth row.

    Each prediction starts at the measured state and uses only the recorded actions. FILE.csv has the columns start_t, t
    and the states, with one line per measured row up to the horizon.
    """
    from safedpa.api.predicting import predict

    found = predict(model, run, horizon, columns=columns, effects=effects, out=out, force=force)
    facts = found.to_dict()
    line = f"{out}: {facts['predictions']} predictions from {facts['starts']} starts over {horizon:g} s"
    report_progress(line, err=True, facts=facts)
