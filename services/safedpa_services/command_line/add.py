"""``safedpa add``: adds one effect of the user's choice to a model and fits it."""

from __future__ import annotations

import json
from pathlib import Path

import click

from safedpa.extras import needs
from safedpa_services.command_line.names import complete_effects, complete_models
from safedpa_services.command_line.options import force_option, run_options


@click.command(name="add")
@click.argument("model", shell_complete=complete_models)
@click.argument("effect", shell_complete=complete_effects)
@run_options
@click.option("--out", type=click.Path(path_type=Path), required=True, metavar="MODEL2.toml", help="The new model.")
@click.option("--where", metavar="WORDS", help="Limit it to a region: 'x above', 'abs_speed below', 'circle', 'strip'.")
@click.option("--varies", metavar="WORDS", help="Let a parameter vary: 'gain with time', 'gain with abs_speed'.")
@click.option(
    "--edge", type=float, default=0.05, show_default=True, help="Width of the transition at the edge of --where."
)
@force_option
@needs("diagnosis")
def command(
    model: str,
    effect: str,
    runs: tuple[str, ...],
    out: Path,
    columns: str | None,
    horizon: float,
    effects: Path | None,
    as_json: bool,
    force: bool,
    where: str | None,
    varies: str | None,
    edge: float,
) -> None:
    """Add one EFFECT to MODEL, fitted to recorded RUNs.

    The effect need not be among those that a diagnosis proposes. With --where the effect acts in a region only; with
    --varies one of its parameters depends on a variable. The borders of the region and the dependence are fitted as
    well. Prints the fitted parameters and the error on held-out data, before and after.
    """
    from safedpa.api.fitting import add

    given = {"columns": columns, "horizon": horizon, "effects": effects, "force": force}
    found = add(model, effect, runs, where=where, varies=varies, edge=edge, out=out, **given)  # type: ignore[arg-type]
    click.echo(json.dumps(found.to_dict(), allow_nan=False) if as_json else f"{found}\nModel: {out}")
