"""``safedpa columns``: lists the contents of a log and proposes a column map for it."""

from __future__ import annotations

import json
from pathlib import Path

import click

from safedpa_services.command_line.names import complete_robots
from safedpa_services.command_line.options import as_json_option, effects_option


@click.command(name="columns")
@click.argument("log", type=click.Path(path_type=Path))
@click.option(
    "--robot", default=None, shell_complete=complete_robots, help="The robot that was logged; default: the car."
)
@effects_option
@as_json_option
def command(log: Path, robot: str | None, effects: Path | None, as_json: bool) -> None:
    """List the contents of LOG and propose a column map.

    Example: safedpa columns LOG --robot car > map.toml.

    LOG is a table (CSV, Parquet, NumPy .npz, MATLAB .mat, HDF5, a LeRobot dataset), a rosbag2 (MCAP, SQLite or folder),
    a ROS 1 bag, or a PX4 flight log; a path, a URL, or - for standard input. The map lists topics, types, rates and
    fields as comments. It is a proposal: check every line before you use it.
    """
    from safedpa.api.log_columns import columns

    found = columns(log, robot, effects=effects)
    click.echo(json.dumps(found.to_dict()) if as_json else found.text, nl=as_json)
