"""``columns``, ``list_effects`` and ``check``: contents of a log, effects a model may lack, a robot of one's own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

from safedpa.dynamics import load_user_file
from safedpa.effects import AbstractEffect, effects_of, robots
from safedpa.errors import InputError, did_you_mean
from safedpa.limits import printable
from safedpa.records import ColumnMap
from safedpa.records.column_map.file import parse_column_map
from safedpa.records.column_map.form import guess_columns, map_text
from safedpa.records.column_map.propose import best_system, propose_map, sources_of
from safedpa.records.readers.bags import AbstractLog, check_readable_mcap, kind_of, topic_log
from safedpa.records.readers.preview import raw_rows
from safedpa.result import AbstractResult
from safedpa.systems import System
from safedpa.systems.robots import DEFAULT_ROBOT, robot_named
from safedpa.systems.robots import robots as known_robots

if TYPE_CHECKING:
    from safedpa.check_robot import PartFinding


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


@final
@dataclass(frozen=True, repr=False, eq=False)
class EffectTable(AbstractResult):
    """The physical effects that models may have, by robot.

    ``by_robot`` has the effects of each robot, in the order in which they act. The table of ``to_dataframe`` has one
    row per parameter.

    Example:

        >>> table = safedpa.list_effects("pendulum")
        >>> [effect.name for effect in table.by_robot["pendulum"]][:2]
        ['torque_gain', 'torque_delay']
    """

    by_robot: dict[str, tuple[AbstractEffect, ...]]

    def to_dict(self) -> dict[str, Any]:
        """Returns the document that ``safedpa effects --json`` prints."""
        return {"format": 1, "effects": [_entry(item) for items in self.by_robot.values() for item in items]}

    def _facts(self) -> dict[str, object]:
        return {robot: f"{len(items)} effects" for robot, items in self.by_robot.items()}

    def _columns(self) -> dict[str, Sequence[Any]]:
        pairs = [(item, part) for items in self.by_robot.values() for item in items for part in item.parameters]
        columns: dict[str, Sequence[Any]] = {
            "robot": [item.robot for item, _ in pairs],
            "effect": [item.name for item, _ in pairs],
            "equation": [item.equation for item, _ in pairs],
        }
        for name in ("name", "unit", "low", "high", "typical", "neutral"):
            columns["parameter" if name == "name" else name] = [getattr(part, name) for _, part in pairs]
        return columns


@final
@dataclass(frozen=True, repr=False, eq=False)
class RobotCheck(AbstractResult):
    """What is fine, missing or wrong about the robots that a file declares.

    ``parts`` has the findings of each robot by its name: part, verdict (fine, note, missing or wrong) and sentence.

    Example:

        >>> checked = safedpa.check("incomplete.py")
        >>> checked.passed, [(part.part, part.verdict) for part in checked.parts["drone"]][-1]
        (False, ('stand_in', 'wrong'))
    """

    parts: dict[str, tuple[PartFinding, ...]]

    @property
    def passed(self) -> bool:
        """Whether every robot can be driven as it is declared."""
        return all(one.ends_well for parts in self.parts.values() for one in parts)

    def to_dict(self) -> dict[str, Any]:
        """Returns the document that ``safedpa check --json`` prints."""
        return {name: [asdict(one) for one in parts] for name, parts in self.parts.items()}

    def __str__(self) -> str:
        lines = []
        for name, parts in self.parts.items():
            lines += [f"robot '{name}'", *(f"  {one.verdict:<8}{one.part}: {one.sentence}" for one in parts)]
        return "\n".join(lines)

    def _facts(self) -> dict[str, object]:
        wrong = [f"{name} {one.part}" for name, parts in self.parts.items() for one in parts if not one.ends_well]
        return {"robots": ", ".join(self.parts), "passed": self.passed, "not_fine": ", ".join(wrong) or "nothing"}

    def _columns(self) -> dict[str, Sequence[Any]]:
        rows = [(name, one) for name, parts in self.parts.items() for one in parts]
        columns: dict[str, Sequence[Any]] = {"robot": [name for name, _ in rows]}
        return columns | {key: [getattr(one, key) for _, one in rows] for key in ("part", "verdict", "sentence")}


def columns(log: str | Path, robot: str | None = None, *, effects: str | Path | None = None) -> ProposedColumns:
    """Lists the contents of a log and proposes a column map for ``robot``, a name; None: the car.

    The log is a CSV or Parquet file, a rosbag2 (MCAP, SQLite or folder), a ROS 1 bag, or a PX4 flight log. ``effects``
    is a Python file with the user's own robots. Raises InputError for an unknown robot and for recordings of the bus,
    which need no map; RunError for an unreadable file.

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
    path, known = Path(log), robot_named(robot or DEFAULT_ROBOT)
    systems = tuple(one.system for one in (known, *known.variants))
    kind = kind_of(path)
    if kind == "mcap":
        check_readable_mcap(path)
        raise InputError(f"{log}: got a recording of the bus, which needs no column map; use it directly")
    if kind != "topics":
        return ProposedColumns(path, (), _table_map(path, systems))
    opened = topic_log(path)
    system = best_system(systems, sources_of(opened.topics().values()))
    text = propose_map(opened, system, [other for other in systems if other is not system])
    return ProposedColumns(path, tuple(_topics(opened)), text)


def list_effects(robot: str | None = None, *, effects: str | Path | None = None) -> EffectTable:
    """Lists the physical effects that a model can have, of one robot or of all.

    ``effects`` is a Python file with the user's own. Raises InputError for an unknown robot. (``safedpa.effects`` is
    the package of the effects.)

    Example:

        >>> sorted(safedpa.list_effects().by_robot)
        ['car', 'differential_drive', 'pendulum', 'point']
    """
    if effects is not None:
        load_user_file(Path(effects))
    if robot is not None and robot not in robots():
        raise InputError(f"robot: got '{robot}'; {did_you_mean(robot, robots())}")
    chosen = {owner: effects_of(owner).values() for owner in robots() if robot in (None, owner)}
    # In the order in which they act, from the command to the sensor.
    return EffectTable(
        {owner: tuple(sorted(items, key=lambda item: (item.stage, item.name))) for owner, items in chosen.items()}
    )


def check(file: str | Path, *, seed: int = 0) -> RobotCheck:
    """Checks the robots that a Python file declares: whether each is complete and can be filtered safely.

    For the test, its simulation is driven by random nominal actions from ``seed`` through its filter. Raises InputError
    if the file cannot be loaded or declares no robot.

    Example:

        >>> safedpa.check("drone.py").passed
        True
    """
    from safedpa.check_robot import check_robot  # here: it imports what drives a robot, a second of a short command

    names = [name for name in load_user_file(Path(file)) if name in known_robots()]
    if not names:
        raise InputError(f"{file}: got no robot, wanted a class derived from AbstractRobot")
    return RobotCheck({name: tuple(check_robot(known_robots()[name], seed)) for name in names})


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


def _entry(item: AbstractEffect) -> dict[str, Any]:
    return {
        "robot": item.robot,
        "name": item.name,
        "stage": item.stage.name.lower(),
        "equation": item.equation,
        "parameters": [asdict(parameter) for parameter in item.parameters],
        "needs": list(item.needs),
        "signature": item.signature,
        "source": item.source,
    }
