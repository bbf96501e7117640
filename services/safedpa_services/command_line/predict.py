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
    inputs_of,
    load_given_model,
)  # fmt: skip

__all__ = ["command"]


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
    from safedpa.comparison.output import refuse_inputs, require_writable_file
    from safedpa.comparison.rollout import predict_run
    from safedpa.records import load_column_map, load_run
    from safedpa.records.writers.tables import write_columns

    refuse_inputs([out], inputs_of(model, [run], columns, effects), force)
    loaded = load_given_model(model, effects)
    recorded = load_run(run, loaded.system, load_column_map(columns) if columns else None)
    require_writable_file(out)
    table = predict_run(loaded, recorded, horizon)
    write_columns(table, out, "csv")
    starts = len(set(table["start_t"].tolist()))
    facts = {"written": str(out), "predictions": len(table["t"]), "starts": starts, "horizon": horizon}
    report_progress(
        f"{out}: {len(table['t'])} predictions from {starts} starts over {horizon:g} s", err=True, facts=facts
    )
