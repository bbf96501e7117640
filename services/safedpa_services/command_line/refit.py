"""``safedpa refit`` and ``safedpa remove``: fit a model again, with its effects or without one of them."""

from __future__ import annotations

import json
from pathlib import Path

import click

from safedpa.extras import needs
from safedpa_services.command_line.names import complete_effects, complete_models
from safedpa_services.command_line.options import force_option, run_options

_out_option = click.option(
    "--out", type=click.Path(path_type=Path), required=True, metavar="MODEL2.toml", help="The new model."
)


@click.command(name="refit")
@click.argument("model", shell_complete=complete_models)
@run_options
@click.option(
    "--free", multiple=True, metavar="NAME", help="A parameter, such as base.gain, or an effect; may be repeated."
)
@_out_option
@force_option
@needs("diagnosis")
def refit(
    model: str,
    runs: tuple[str, ...],
    free: tuple[str, ...],
    out: Path,
    columns: str | None,
    horizon: float,
    effects: Path | None,
    as_json: bool,
    force: bool,
) -> None:
    """Fit all free parameters of MODEL together to recorded RUNs.

    With --free also those that it names. Prints the fitted parameters and the error on held-out data, before and after.
    """
    from safedpa.api.fitting import refit as refitted

    given = {"columns": columns, "horizon": horizon, "effects": effects, "force": force}
    found = refitted(model, runs, free=free, out=out, **given)  # type: ignore[arg-type]
    click.echo(json.dumps(found.to_dict(), allow_nan=False) if as_json else f"{found}\nModel: {out}")


@click.command(name="remove")
@click.argument("model", shell_complete=complete_models)
@click.argument("effect", shell_complete=complete_effects)
@run_options
@_out_option
@force_option
@needs("diagnosis")
def remove(
    model: str,
    effect: str,
    runs: tuple[str, ...],
    out: Path,
    columns: str | None,
    horizon: float,
    effects: Path | None,
    as_json: bool,
    force: bool,
) -> None:
    """Remove one EFFECT from MODEL and fit the free parameters again to recorded RUNs.

    Prints the fitted parameters and the error on held-out data, before and after.
    """
    from safedpa.api.fitting import remove as removed

    given = {"columns": columns, "horizon": horizon, "effects": effects, "force": force}
    found = removed(model, effect, runs, out=out, **given)  # type: ignore[arg-type]
    click.echo(json.dumps(found.to_dict(), allow_nan=False) if as_json else f"{found}\nModel: {out}")
