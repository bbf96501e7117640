"""``safedpa add``: adds one effect of the user's choice to a model and fits it."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING

import click

from safedpa.extras import needs
from safedpa_services.command_line.names import complete_effects, complete_models
from safedpa_services.command_line.options import (
    force_option,
    inputs_of,
    load_given_model,
    load_runs,
    run_options,
    value_text,
)

if TYPE_CHECKING:
    from safedpa.effects import Varies, Where

__all__ = ["command"]


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
    from safedpa.comparison.output import refuse_inputs, require_writable_file
    from safedpa.diagnosis.add_effect import add_effect
    from safedpa.dynamics import save_model

    loaded = load_given_model(model, effects)
    refuse_inputs([out], inputs_of(model, runs, columns, effects), force)
    require_writable_file(out)
    law = _law(where, varies, edge, effect)
    found = add_effect(loaded, effect, load_runs(loaded, runs, columns), horizon, law)
    save_model(found.model, out)
    before, after = found.before.value, found.after.value
    if as_json:
        values = {path: vars(value) for path, value in found.values.items()}
        sentence = {"sentence": found.sentence} if law is not None else {}
        errors = {key: value if math.isfinite(value) else None for key, value in (("before", before), ("after", after))}
        document = {"format": 1, "effect": effect, **errors, "parameters": values, **sentence}
        click.echo(json.dumps(document, allow_nan=False))
        return
    if found.sentence:
        click.echo(found.sentence)
    for path, value in found.values.items():
        click.echo(value_text(path, value))
    change = f" ({100 * (after / before - 1):+.1f} %)" if before > 0 else ""
    click.echo(f"held-out error after {horizon:g} s: {before:.4g} before, {after:.4g} with {effect}{change}")
    click.echo(f"Model: {out}")


def _law(where: str | None, varies: str | None, edge: float, effect: str) -> Where | Varies | None:
    from safedpa.effects.law import law_of
    from safedpa.errors import InputError

    if where is not None and varies is not None:
        raise InputError("--where, --varies: got both, wanted one of them")
    if where is not None:
        return law_of("where", where, edge, effect)
    return None if varies is None else law_of("varies", varies, None, effect)
