"""``safedpa init``: writes a first model of a robot from a log of it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import click

from safedpa.errors import InputError
from safedpa.extras import needs
from safedpa_services.command_line.options import as_json_option


def _by_name(option: str, pairs: Sequence[str]) -> dict[str, str]:
    split = {name: column for name, _, column in (pair.partition("=") for pair in pairs)}
    wrong = next((name for name, column in split.items() if not column or not name.isidentifier()), None)
    if wrong is not None:
        raise InputError(f"{option}: got '{wrong}', wanted NAME=COLUMN, such as angle=q1")
    return split


@click.command(name="init")
@click.argument("logs", metavar="LOG...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), required=True, metavar="DIR", help="Folder for the files.")
@click.option("--state", "states", multiple=True, metavar="NAME=COLUMN", help="A state; then only those named.")
@click.option("--action", "actions", multiple=True, metavar="NAME=COLUMN", help="A command; then only those named.")
@click.option("--base", metavar="KIND", default=None, help="Kind of base; default: the one with the smallest error.")
@click.option("--robot", default=None, help="Name of the robot; default: that of the folder.")
@click.option("--horizon", type=float, default=None, metavar="SECONDS", help="How far to predict; default: by the log.")
@click.option("--force", is_flag=True, help="Replace files of an earlier proposal.")
@as_json_option
@needs("diagnosis")
def command(
    logs: tuple[Path, ...],
    out: Path,
    states: tuple[str, ...],
    actions: tuple[str, ...],
    base: str | None,
    robot: str | None,
    horizon: float | None,
    force: bool,
    as_json: bool,
) -> None:
    """Write a first model of a robot from LOG.

    LOG is a table, or several with the same columns: CSV, Parquet or arrays. Recognises time, commands, states, and
    pairs of position and rate; compares bases on the last part of each log: integrator, first_order, double_integrator,
    joint, position_loop, coupled (states that drive each other), bicycle, differential_drive, multirotor, planar. DIR
    gets robot.py (system, base, effects), model.toml and columns.toml. It is a proposal: check names, units and bounds.
    The last line printed is the command that diagnoses the model.
    """
    from safedpa.api.starting import init

    given = {"states": _by_name("--state", states), "actions": _by_name("--action", actions)}
    found = init(logs, out, **given, base=base, robot=robot, horizon=horizon, force=force)
    click.echo(json.dumps(found.to_dict()) if as_json else str(found))
