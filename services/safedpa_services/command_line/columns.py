"""``safedpa columns``: lists the contents of a log and proposes a column map for it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from safedpa.limits import printable
from safedpa_services.command_line.names import complete_robots
from safedpa_services.command_line.options import as_json_option, effects_option

if TYPE_CHECKING:
    from safedpa.records.readers.bags import AbstractLog
    from safedpa.systems import System

__all__ = ["command"]


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

    LOG is a CSV or Parquet file, a rosbag2 (MCAP, SQLite or folder), a ROS 1 bag, or a PX4 flight log. The map lists
    topics, types, rates and fields as comments. It is a proposal: check every line before you use it.
    """
    from safedpa.dynamics import load_user_file
    from safedpa.errors import InputError
    from safedpa.records.column_map.propose import best_system, propose_map, sources_of
    from safedpa.records.readers.bags import kind_of, topic_log
    from safedpa.systems.robots import DEFAULT_ROBOT, robot_named

    if effects is not None:
        load_user_file(effects)
    known = robot_named(robot or DEFAULT_ROBOT)
    systems = tuple(one.system for one in (known, *known.variants))
    kind = kind_of(log)
    if kind == "mcap":
        raise InputError(f"{log}: got a recording of the bus, which needs no column map; use it directly")
    if kind == "topics":
        opened = topic_log(log)
        system = best_system(systems, sources_of(opened.topics().values()))
        others = [other for other in systems if other is not system]
        text, topics = propose_map(opened, system, others), _topics(opened)
    else:
        text, topics = _of_table(log, systems), []
    click.echo(json.dumps({"log": str(log), "topics": topics, "map": text}) if as_json else text, nl=as_json)


def _topics(log: AbstractLog) -> list[dict[str, object]]:
    return [
        {
            "name": topic.name,
            "type": topic.type,
            "messages": topic.count,
            "rate": topic.rate,
            "fields": dict(topic.fields),
            "problem": topic.problem,
        }
        for topic in log.topics().values()
    ]


def _of_table(log: Path, systems: Sequence[System]) -> str:
    from safedpa.records.column_map.form import guess_columns, map_text
    from safedpa.records.readers.preview import raw_rows

    names = raw_rows(log, 1).names
    forms = [(system, guess_columns(system, names)) for system in systems]
    system, lines = max(forms, key=lambda form: sum(bool(line.source) for line in form[1]))
    missing = [f'# {line.target} = "..."   # {line.si}: no matching column found' for line in lines if not line.source]
    columns = ", ".join(map(printable, names))
    return f"# Columns of the log: {columns}\n{map_text(system, lines)}" + "".join(f"{line}\n" for line in missing)
