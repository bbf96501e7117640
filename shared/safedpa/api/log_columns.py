"""``columns``: the contents of a log, and a proposal of its column map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

from safedpa.dynamics import load_user_file
from safedpa.dynamics.user_files import load_user_files
from safedpa.errors import InputError
from safedpa.limits import printable
from safedpa.records import ColumnMap
from safedpa.records.column_map.file import parse_column_map
from safedpa.records.column_map.form import guess_columns, map_text
from safedpa.records.column_map.propose import best_system, propose_map, sources_of
from safedpa.records.readers.bags import AbstractLog, check_readable_mcap, kind_of, topic_log
from safedpa.records.readers.own_process import in_own_process
from safedpa.records.readers.preview import raw_rows
from safedpa.records.readers.table import regular_file
from safedpa.result import AbstractResult
from safedpa.systems import System
from safedpa.systems.registry import systems
from safedpa.systems.robots import DEFAULT_ROBOT, robot_named, robots


@final
@dataclass(frozen=True, repr=False, eq=False)
class ProposedColumns(AbstractResult):
    """The contents of a log, and a proposal of its column map.

    ``log`` is the file, ``text`` the map as TOML, with comments; check every line before you use it. ``topics``
    describes each topic of a bag or flight log: name, type, messages, rate [Hz], fields. ``print(proposal)`` shows the
    map.

    Example:

        >>> proposal = safedpa.columns("degrees.csv", "pendulum")
        >>> list(proposal.column_map.columns)
        ['t', 'angle', 'rate', 'torque']
        >>> run = safedpa.read_log("degrees.csv", "pendulum", proposal)
    """

    log: Path
    topics: tuple[dict[str, Any], ...]
    text: str

    @property
    def column_map(self) -> ColumnMap:
        """The proposal as a column map. Raises ColumnMapError if it is incomplete."""
        return parse_column_map(self.text, self.log.stem)

    def save(self, path: str | Path) -> Path:
        """Writes the map to a file, to be checked and corrected."""
        Path(path).write_text(self.text, encoding="utf-8")
        return Path(path)

    def to_dict(self) -> dict[str, Any]:
        """Returns the document that ``safedpa columns --json`` prints."""
        return {"log": str(self.log), "topics": list(self.topics), "map": self.text}

    def __str__(self) -> str:
        return self.text

    def _facts(self) -> dict[str, object]:
        lines = [line for line in self.text.splitlines() if "=" in line and not line.startswith(("#", "format", "["))]
        return {"log": self.log.name, "topics": len(self.topics), "map": "; ".join(lines)}

    def _columns(self) -> dict[str, Sequence[Any]]:
        names = ("name", "type", "messages", "rate", "problem")
        return {name: [topic[name] for topic in self.topics] for name in names}


def columns(log: str | Path, robot: str | None = None, *, effects: str | Path | None = None) -> ProposedColumns:
    """Lists the contents of a log and proposes a column map for the robot or system ``robot``; None: the car.

    The log is any that ``read_log`` reads. ``effects`` is a Python file with the user's own robots and systems. Raises
    InputError for an unknown robot and for recordings of the bus, which need no map; RunError for an unreadable file.

    Example:

        >>> print(safedpa.columns("degrees.csv", "pendulum"))
        # Columns of the log: time, theta_deg, rate, torque
        format = 1
        robot = "pendulum"
        <BLANKLINE>
        [columns]
        t = { from = "time" }
        angle = { from = "theta_deg", unit = "deg" }
        rate = { from = "rate" }
        torque = { from = "torque" }
        <BLANKLINE>
    """
    if effects is not None:
        load_user_file(Path(effects))
    load_user_files()
    path = Path(log)
    with regular_file(path) as file:
        topics, text = _proposed(file, _systems_of(robot or DEFAULT_ROBOT))
    return ProposedColumns(path, tuple(topics), text)


def _systems_of(name: str) -> tuple[System, ...]:
    """Those of a robot, or the system of that name, which needs no robot."""
    if name not in robots() and name in systems():
        return (systems()[name],)
    known = robot_named(name)
    return tuple(one.system for one in (known, *known.variants))


@in_own_process
def _proposed(path: Path, candidates: Sequence[System]) -> tuple[list[dict[str, Any]], str]:
    """Topics of a log, and the map that is proposed for the system of ``candidates`` that fits best."""
    kind = kind_of(path)
    if kind == "mcap":
        check_readable_mcap(path)
        raise InputError(f"{path}: got a recording of the bus, which needs no column map; use it directly")
    if kind != "topics":
        return [], _table_map(path, candidates)
    opened = topic_log(path)
    system = best_system(candidates, sources_of(opened.topics().values()))
    text = propose_map(opened, system, [other for other in candidates if other is not system])
    return _topics(opened), text


def _topics(log: AbstractLog) -> list[dict[str, Any]]:
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


def _table_map(log: Path, systems: Sequence[System]) -> str:
    names = raw_rows(log, 1).names
    forms = [(system, guess_columns(system, names)) for system in systems]
    system, lines = max(forms, key=lambda form: sum(bool(line.source) for line in form[1]))
    missing = [f'# {line.target} = "..."   # {line.si}: no matching column found' for line in lines if not line.source]
    listed = ", ".join(map(printable, names))
    return f"# Columns of the log: {listed}\n{map_text(system, lines)}" + "".join(f"{line}\n" for line in missing)
