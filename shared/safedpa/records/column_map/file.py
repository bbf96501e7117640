"""Reads column maps from TOML files; some are shipped with the project. Errors name the key."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

from safedpa.errors import ColumnMapError, InputError, did_you_mean
from safedpa.limits import finite_number, parse_toml, refuse_unknown, text_of_file_or_shipped, whole_number
from safedpa.records.column_map.column_map import (
    DERIVATIONS,
    JOINS,
    KEEPABLE,
    SLOPE,
    ColumnMap,
    DerivedColumn,
    SkipRows,
    SourceColumn,
    TrackedPoint,
    native_map,
)
from safedpa.records.column_map.units import UNITS
from safedpa.systems import System

__all__ = ["column_map_of", "load_column_map", "parse_column_map", "shipped_column_maps"]

FORMAT = 1
_KEYS = (
    "format",
    "robot",
    "columns",
    "unwrap",
    "skip_first_rows",
    "skip_where",
    "tracked_point",
    "keep_period",
    "keep",
    "frames",
)
_SOURCE_KEYS = ("from", "topic", "field", "clock", "hold", "unit", "scale", "offset", "flip", "shift", "join")
_CLOCKS = ("header", "receipt")
_FRAMES = ("frame_id", "child_frame_id")
_DERIVED_KEYS = ("derive", "window", "of")


def load_column_map(source: str | Path) -> ColumnMap:
    """Loads a column map from a TOML file, or a shipped one by its name (with or without ``.toml``).

    Raises ColumnMapError that names the file and the key.
    """
    path, text = text_of_file_or_shipped(source, shipped_column_maps(), "a column map file", ColumnMapError)
    try:
        return parse_column_map(text, path.stem)
    except ColumnMapError as error:
        raise ColumnMapError(f"{source}: {error}") from error


def column_map_of(source: Any, system: System) -> ColumnMap:
    """Returns a column map from a map, a file or shipped name, a dictionary, or None for the native names.

    A dictionary is as ``[columns]`` in a file; quantities of the system that it leaves out have their native names.
    Raises ColumnMapError that names the key.
    """
    if source is None:
        return native_map(system)
    if isinstance(source, ColumnMap):
        return source
    if isinstance(source, Mapping):
        native = {name: name for name in ("t", *system.state_names, *system.action_names)}
        return _column_map({"format": FORMAT, "robot": system.name, "columns": {**native, **source}}, "columns")
    return load_column_map(source)


def shipped_column_maps() -> dict[str, Path]:
    """Paths of the shipped column maps, by name without the suffix."""
    with as_file(files("safedpa.records") / "maps") as folder:
        return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def parse_column_map(text: str, name: str = "map") -> ColumnMap:
    """Parses a column map from TOML (docs/guides/column-maps.md); raises ColumnMapError that names the key."""
    try:
        table = parse_toml(text)
    except InputError as error:
        raise ColumnMapError(str(error)) from error
    return _column_map(table, name)


def _column_map(table: Mapping[str, Any], name: str) -> ColumnMap:
    refuse_unknown(table, _KEYS, "", ColumnMapError)
    if table.get("format") != FORMAT:
        raise ColumnMapError(f"format: got {table.get('format')!r}, wanted {FORMAT}; this program reads no other")
    columns = _columns(table.get("columns"))
    return ColumnMap(
        name=name,
        robot=_text("robot", table.get("robot"), "the name of the robot, such as 'car'"),
        columns=columns,
        unwrap=_unwrap(table, columns),
        skip_first_rows=_count("skip_first_rows", table.get("skip_first_rows", 0)),
        skip_where=_skip_where(table.get("skip_where", [])),
        tracked_point=_tracked_point(table.get("tracked_point")),
        keep_period=_positive("keep_period", table["keep_period"]) if "keep_period" in table else None,
        keep=_keep(table.get("keep", [])),
        frames=_frames(table.get("frames", {})),
    )


def _columns(table: Any) -> dict[str, SourceColumn | DerivedColumn]:
    if not isinstance(table, dict) or not table:
        raise ColumnMapError('columns: missing; wanted a table [columns] with lines like x = "position x"')
    columns: dict[str, SourceColumn | DerivedColumn] = {}
    targets: dict[str, str] = {}
    for target, entry in table.items():
        column = columns[target] = _column(target, entry)
        if isinstance(column, SourceColumn) and not column.others:  # joined ones may serve several
            if column.source in targets:
                raise ColumnMapError(
                    f"columns.{target}: column '{column.source}' is already the source of '{targets[column.source]}'; "
                    "one column can be one target only"
                )
            targets[column.source] = target
    for target, column in columns.items():
        _check_derivation(target, column, columns)
    return _with_time(columns)


def _column(target: str, entry: Any) -> SourceColumn | DerivedColumn:
    key = f"columns.{target}"
    table = {"from": entry} if isinstance(entry, str) else entry
    if not isinstance(table, dict):
        raise ColumnMapError(f'{key}: got {entry!r}, wanted a column\'s name or a table like {{ from = "name" }}')
    if "derive" in table:
        return _derived(key, table)
    refuse_unknown(table, (*_SOURCE_KEYS, "derive"), f"{key}.", ColumnMapError)
    unit = table.get("unit")
    if unit is not None and _text(f"{key}.unit", unit, "a unit's name") not in UNITS:
        raise ColumnMapError(f"{key}.unit: unknown unit '{unit}'; {did_you_mean(unit, UNITS)}")
    scale = _number(f"{key}.scale", table.get("scale", 1.0))
    if scale == 0.0:
        raise ColumnMapError(f"{key}.scale: got 0, wanted another number; 0 would erase the column")
    source, others, join = _topic_column(key, table) if "topic" in table else _raw_columns(key, table)
    return SourceColumn(
        hold=_positive(f"{key}.hold", table["hold"]) if "hold" in table else None,
        source=source,
        others=others,
        join=join,
        unit=unit,
        scale=scale,
        offset=_number(f"{key}.offset", table.get("offset", 0.0)),
        flip=_boolean(f"{key}.flip", table.get("flip", False)),
        shift=_number(f"{key}.shift", table.get("shift", 0.0)),
    )


def _topic_column(key: str, table: Mapping[str, Any]) -> tuple[str, tuple[str, ...], str]:
    """Raw column for a field of a topic or for its clock."""
    topic = _text(f"{key}.topic", table["topic"], "a topic's name")
    for other in ("from", "join"):
        if other in table:
            raise ColumnMapError(
                f"{key}.{other}: got it next to a topic; write 'from' = \"{topic}:FIELD\", or leave it out"
            )
    clock = table.get("clock")
    if ("field" in table) == (clock is not None):
        raise ColumnMapError(
            f'{key}: wanted a field of the topic, or for t clock = "header" or "receipt", and not both'
        )
    if clock is None:
        return f"{topic}:{_text(f'{key}.field', table['field'], 'a field of the topic')}", (), ""
    if clock not in _CLOCKS or key != "columns.t":
        raise ColumnMapError(f"{key}.clock: got {clock!r}, wanted {' or '.join(_CLOCKS)}, and for t alone")
    return f"{topic}:@{clock}", (), ""


def _with_time(columns: dict[str, SourceColumn | DerivedColumn]) -> dict[str, SourceColumn | DerivedColumn]:
    """Adds the default time of a map of topics: the stamps of the first topic."""
    first = next((item for item in columns.values() if isinstance(item, SourceColumn)), None)
    topic = "" if first is None else first.source.rpartition(":")[0]
    return columns if "t" in columns or not topic else {"t": SourceColumn(f"{topic}:@stamp"), **columns}


def _frames(table: Any) -> dict[str, dict[str, str]]:
    if not isinstance(table, dict):
        raise ColumnMapError(f'frames: got {table!r}, wanted tables like [frames."/odom"]')
    found = {}
    for topic, entry in table.items():
        if not isinstance(entry, dict):
            raise ColumnMapError(f"frames.{topic}: got {entry!r}, wanted a table with {' and '.join(_FRAMES)}")
        refuse_unknown(entry, _FRAMES, f"frames.{topic}.", ColumnMapError)
        found[topic] = {key: _text(f"frames.{topic}.{key}", value, "a frame's name") for key, value in entry.items()}
    return found


def _raw_columns(key: str, table: Mapping[str, Any]) -> tuple[str, tuple[str, ...], str]:
    """Returns the first raw column, the others, and how they are joined."""
    entry, join = table.get("from"), table.get("join")
    if not isinstance(entry, list):
        if join is not None:
            raise ColumnMapError(f"{key}.join: got {join!r} for one column; name several in 'from', or leave it out")
        return _text(f"{key}.from", entry, "a column's name"), (), ""
    names = tuple(_text(f"{key}.from", name, "a column's name") for name in entry)
    if len(names) < 2 or len(set(names)) < len(names):
        raise ColumnMapError(f"{key}.from: got {entry!r}, wanted two different columns or more")
    if join not in JOINS:
        raise ColumnMapError(f"{key}.join: got {join!r}, wanted a way to join them: {', '.join(JOINS)}")
    return names[0], names[1:], str(join)


def _derived(key: str, table: Mapping[str, Any]) -> DerivedColumn:
    refuse_unknown(table, _DERIVED_KEYS, f"{key}.", ColumnMapError)
    derive = _text(f"{key}.derive", table["derive"], "what to derive")
    if derive not in (*DERIVATIONS, SLOPE):
        raise ColumnMapError(f"{key}.derive: got '{derive}'; {did_you_mean(derive, (*DERIVATIONS, SLOPE))}")
    if (derive == SLOPE) != ("of" in table):
        wanted = "missing; wanted the state whose slope it is" if derive == SLOPE else f"unknown with '{derive}'"
        raise ColumnMapError(f"{key}.of: {wanted}")
    if "window" not in table:
        raise ColumnMapError(f"{key}.window: missing; wanted the seconds over which the slope is computed, such as 0.1")
    of = _text(f"{key}.of", table["of"], "a state's name") if derive == SLOPE else ""
    return DerivedColumn(derive, _positive(f"{key}.window", table["window"]), of)


def _check_derivation(
    target: str, column: SourceColumn | DerivedColumn, columns: Mapping[str, SourceColumn | DerivedColumn]
) -> None:
    if isinstance(column, SourceColumn):
        return
    wanted, needs = (target, (column.of,)) if column.derive == SLOPE else DERIVATIONS[column.derive]
    if target != wanted:
        raise ColumnMapError(f"columns.{target}.derive: '{column.derive}' gives '{wanted}', not '{target}'")
    for name in needs:
        if not isinstance(columns.get(name), SourceColumn):
            raise ColumnMapError(f"columns.{target}.derive: '{column.derive}' needs the column '{name}' of the log")


def _unwrap(table: Mapping[str, Any], columns: Mapping[str, Any]) -> tuple[str, ...] | None:
    names = table.get("unwrap")
    if names is None:
        return None
    if not isinstance(names, list):
        raise ColumnMapError(f"unwrap: got {names!r}, wanted a list of names")
    for name in names:
        if name not in columns:
            raise ColumnMapError(f"unwrap: got {name!r}; {did_you_mean(str(name), columns)}")
    return tuple(names)


def _skip_where(entries: Any) -> tuple[SkipRows, ...]:
    rules = [entries] if isinstance(entries, dict) else entries
    if not isinstance(rules, list) or not all(isinstance(rule, dict) for rule in rules):
        raise ColumnMapError(f'skip_where: got {entries!r}, wanted {{ column = "name", equals = 0.0 }}')
    for rule in rules:
        refuse_unknown(rule, ("column", "equals"), "skip_where.", ColumnMapError)
    return tuple(
        SkipRows(
            _text("skip_where.column", rule.get("column"), "a column's name"),
            _number("skip_where.equals", rule.get("equals")),
        )
        for rule in rules
    )


def _keep(names: Any) -> tuple[str, ...]:
    if not isinstance(names, list):
        raise ColumnMapError(f"keep: got {names!r}, wanted a list of findings whose rows are kept")
    for name in names:
        if name not in KEEPABLE:
            raise ColumnMapError(f"keep: got {name!r}; {did_you_mean(str(name), KEEPABLE)}")
    return tuple(names)


def _tracked_point(table: Any) -> TrackedPoint | None:
    if table is None:
        return None
    if not isinstance(table, dict):
        raise ColumnMapError(f"tracked_point: got {table!r}, wanted a table with ahead, left [m] and yaw_offset [rad]")
    refuse_unknown(table, ("ahead", "left", "yaw_offset"), "tracked_point.", ColumnMapError)
    return TrackedPoint(**{key: _number(f"tracked_point.{key}", value) for key, value in table.items()})


def _text(key: str, value: Any, wanted: str) -> str:
    if not isinstance(value, str) or not value:
        raise ColumnMapError(f"{key}: got {value!r}, wanted {wanted} in quotes")
    return value


def _number(key: str, value: Any) -> float:
    return finite_number(key, value, error=ColumnMapError)


def _positive(key: str, value: Any) -> float:
    number = _number(key, value)
    if number <= 0.0:
        raise ColumnMapError(f"{key}: got {value!r}, wanted seconds above 0")
    return number


def _count(key: str, value: Any) -> int:
    wanted = "a whole number, 0 or more"
    if whole_number(key, value, wanted, ColumnMapError) < 0:
        raise ColumnMapError(f"{key}: got {value!r}, wanted {wanted}")
    return int(value)


def _boolean(key: str, value: Any) -> bool:
    if not isinstance(value, bool):
        raise ColumnMapError(f"{key}: got {value!r}, wanted true or false")
    return value
