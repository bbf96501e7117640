"""``safedpa compare``: compares a model with measurements."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from safedpa.extras import needs
from safedpa_services.command_line.names import complete_models
from safedpa_services.command_line.options import folder_option, force_option, run_options

if TYPE_CHECKING:
    from safedpa.comparison.comparison import Comparison

WORST = 8
"""Number of bins that are printed."""

NAME = 20
"""Characters of a run's name that fit into a table of 80 columns."""


@click.command(name="compare")
@click.argument("model", shell_complete=complete_models)
@run_options
@folder_option("compare.html and compare.json")
@click.option("--before", metavar="MODEL", help="An earlier model: report which states got worse in which runs.")
@force_option
@needs("diagnosis")
def command(
    model: str,
    runs: tuple[str, ...],
    columns: str | None,
    horizon: float,
    out: Path | None,
    effects: Path | None,
    as_json: bool,
    before: str | None,
    force: bool,
) -> None:
    """Compare MODEL with recorded RUNs.

    Shows how large the model's error is, and where. Predicts open loop from a start every 0.1 s. Prints the errors,
    together with those of predictors that know no physics, and writes compare.html (readable offline) and compare.json.
    """
    from safedpa.api.comparing import compare
    from safedpa.comparison.output import new_folder

    folder = out or new_folder("compare", model)
    found = compare(
        model, runs, columns=columns, horizon=horizon, effects=effects, before=before, out=folder, force=force
    )
    if as_json:
        click.echo(json.dumps(found.to_dict(), allow_nan=False))
    else:
        _show(found.details, folder / "compare.html", found.change)


def _show(comparison: Comparison, page: Path, change: str) -> None:
    from safedpa.comparison.summary import naive_sentence, run_sentence, state_sentence, where_sentence
    from safedpa_services.terminal import terminal

    console = terminal(highlight=False, soft_wrap=False)
    console.print()
    console.print(where_sentence(comparison), style="bold", markup=False)
    console.print(f"{state_sentence(comparison)} {naive_sentence(comparison)}", markup=False)
    for text in (run_sentence(comparison), change):
        if text:
            console.print(text, markup=False)
    console.print(_error_table(comparison))
    console.print(_where_table(comparison))
    if len(comparison.runs) > 1:
        console.print(_run_table(comparison))
        console.print(_state_table(comparison))
    _show_findings(console, comparison)
    console.print(f"Page: {page}", markup=False, soft_wrap=True)


def _error_table(comparison: Comparison) -> Any:
    from safedpa.comparison.comparison import PREDICTORS

    table = _table(f"Error after {comparison.horizon:g} s and earlier", "state", "after")
    for name in PREDICTORS:
        table.add_column(name.replace("_", " "), justify="right")
    count = len(comparison.horizons)
    picked = sorted({max(1, round(count * share)) for share in (0.2, 0.5, 1.0)})
    for index, state in enumerate(comparison.windows.system.state):
        for position in picked:
            item = comparison.horizons[position - 1]
            values = [item.errors[name].per_state[index] * item.errors[name].scale[index] for name in PREDICTORS]
            first = f"{state.name} ({state.unit})" if position == picked[0] else ""
            table.add_row(first, f"{item.seconds:.3g} s", *(f"{value:.3g}" for value in values))
    for position in picked:
        item = comparison.horizons[position - 1]
        first = "mean, scaled" if position == picked[0] else ""
        table.add_row(
            first, f"{item.seconds:.3g} s", *(f"{item.errors[name].value:.2f}" for name in PREDICTORS), style="bold"
        )
    return table


def _where_table(comparison: Comparison) -> Any:
    from safedpa.comparison.summary import bin_text, worst_bins

    table = _table("Where it is worst", "range")
    for title in ("error", "x average", "share", "windows"):
        table.add_column(title, justify="right")
    for item in worst_bins(comparison)[:WORST]:
        table.add_row(
            bin_text(item, NAME),
            f"{item.error:.2f}",
            f"{item.ratio:.2f}",
            f"{100 * item.share:.1f} %",
            str(item.samples),
        )
    return table


def _run_table(comparison: Comparison) -> Any:
    from safedpa.comparison.summary import shortened

    table = _table("Runs", "run")
    for title in ("seconds", "period", "windows", "error"):
        table.add_column(title, justify="right")
    for run in comparison.runs:
        numbers = (f"{run.duration:.1f}", f"{run.period:.4g} s", str(run.windows), f"{run.error:.2f}")
        table.add_row(shortened(run.name, NAME), *numbers)
    return table


def _state_table(comparison: Comparison) -> Any:
    from safedpa.comparison.summary import shortened

    names = comparison.windows.system.state_names
    table = _table("Error by run and state", "run")
    for name in names:
        table.add_column(name, justify="right")
    for run in comparison.runs:
        values = (f"{run.per_state[name]:.2f}" if name in run.per_state else "" for name in names)
        table.add_row(shortened(run.name, NAME), *values)
    return table


def _show_findings(console: Any, comparison: Comparison) -> None:
    """Prints findings about the data; findings that all runs share are printed once."""
    found: dict[str, list[str]] = {}
    for run, finding in comparison.findings:
        found.setdefault(finding.message, []).append(run)
    from safedpa.comparison.summary import shortened

    console.print("Data quality", style="italic")
    if not found:
        console.print("  nothing to report")
    for message, runs in found.items():
        short = [shortened(run, NAME) for run in runs]
        every = len(runs) == len(comparison.runs) > 1
        console.print(f"  {'every run' if every else ', '.join(short)}: {message}", markup=False)
    console.print()


def _table(title: str, *columns: str) -> Any:
    from rich import box
    from rich.table import Table

    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for name in columns:
        table.add_column(name, overflow="fold")
    return table
