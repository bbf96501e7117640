"""``safedpa effects``: lists the library of physical effects as a table, as JSON, or as Markdown for the docs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from safedpa_services.command_line.options import as_json_option, effects_option

if TYPE_CHECKING:
    from rich.text import Text

    from safedpa.effects import AbstractEffect, Parameter


@click.command()
@click.option("--robot", help="List only the effects of this robot (car, pendulum, point).")
@as_json_option
@click.option("--markdown", is_flag=True, help="Print the Markdown tables of docs/reference/effects.md.")
@effects_option
def command(robot: str | None, as_json: bool, markdown: bool, effects: Path | None) -> None:
    """List the physical effects that a model can have.

    Shows equation, parameters, units, and the residuals of a model without the effect.
    """
    from safedpa.api.effect_table import list_effects

    found = list_effects(robot, effects=effects)
    listed = found.by_robot
    if as_json:
        click.echo(json.dumps(found.to_dict(), indent=2))
    elif markdown:
        click.echo("\n".join(line for owner, items in listed.items() for line in _markdown(owner, items)))
    else:
        _show(listed)


def _bounds(parameter: Parameter) -> str:
    unit = "" if parameter.unit == "1" else f" {parameter.unit}"
    return f"{parameter.low:g} to {parameter.high:g}{unit}"


def _neutral_value(parameter: Parameter) -> str:
    return "any value" if parameter.neutral is None else f"{parameter.neutral:g}"


def _title(item: AbstractEffect) -> str:
    return f"only with {', '.join(item.needs)}" if item.needs else ""


def _markdown(owner: str, items: Sequence[AbstractEffect]) -> list[str]:
    def cell(text: str) -> str:
        return text.replace("|", "\\|")

    lines = [
        f"### {owner.capitalize()}",
        "",
        "| effect | equation | parameters: bounds (typical; no effect at) | in residuals |",
        "|---|---|---|---|",
    ]
    for item in items:
        parameters = "<br>".join(
            f"`{p.name}`: {_bounds(p)} ({p.typical:g}; {_neutral_value(p)})" for p in item.parameters
        )
        needs = f"<br>{_title(item)}" if item.needs else ""
        lines.append(f"| `{item.name}`{needs} | {cell(item.equation)} | {parameters} | {cell(item.signature)} |")
    return [*lines, ""]


def _show(listed: dict[str, tuple[AbstractEffect, ...]]) -> None:
    from rich.table import Table
    from rich.text import Text

    from safedpa_services.terminal import terminal

    console = terminal()
    for owner, items in listed.items():
        table = Table(
            title=f"{owner}: {len(items)} effects, from the command to the sensor",
            title_justify="left",
            title_style="bold",
            header_style="bold",
            show_lines=True,
            expand=True,
        )
        table.add_column("effect", no_wrap=True)
        table.add_column("equation, and the residuals of a model without it", ratio=3)
        table.add_column("parameters", ratio=2)
        for item in items:
            name = Text.assemble((item.name, "bold cyan"), *([("\n" + _title(item), "yellow")] if item.needs else []))
            what = Text.assemble(item.equation, "\n", (item.signature, "dim"))
            table.add_row(name, what, Text("\n").join(_parameter_text(parameter) for parameter in item.parameters))
        console.print(table)
        console.print()
    console.print(
        Text("To add one to a model file, write a table [[effects]] with its name and parameters.", style="dim")
    )


def _parameter_text(parameter: Parameter) -> Text:
    from rich.text import Text

    text = Text.assemble(
        (parameter.name, "green"), f" {_bounds(parameter)}", (f", typical {parameter.typical:g}", "dim")
    )
    return text.append(f"\n  {parameter.meaning}", "dim") if parameter.meaning else text
