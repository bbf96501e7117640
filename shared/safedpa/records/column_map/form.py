"""A column map as a form with one line for each quantity of the robot; can be guessed from column names."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from safedpa.records.column_map.column_map import DERIVATIONS, ColumnMap, DerivedColumn, SourceColumn
from safedpa.records.column_map.propose import COMMANDED, MEASURED, propose_sources
from safedpa.records.column_map.units import UNITS, join_units
from safedpa.systems import System

__all__ = [
    "DERIVED", "QuantityForm", "guess_columns", "is_time", "lines_of", "map_text", "unit_named", "units_for",
]  # fmt: skip

DERIVED = "(slope of another column)"
"""Source of a state that has no column: the derivative of another column."""

_DEFAULT_WINDOW = 0.1
"""Default window for a derivative, s."""
_COLUMN_NAMES: Mapping[str, tuple[str, ...]] = {
    "t": ("t", "time", "timestamp", "stamp", "sec", "secs", "seconds", "clock"),
    "x": ("x", "pos x", "position x", "px", "vicon x", "pose x", "pos east", "east", "easting"),
    "y": ("y", "pos y", "position y", "py", "vicon y", "pose y", "pos north", "north", "northing"),
    "yaw": ("yaw", "heading", "theta", "psi", "orientation", "vicon yaw"),
    "speed": ("speed", "v", "vel", "velocity", "vx", "vel encoder", "wheel speed", "ground speed", "measured speed"),
    "turn_rate": ("turn rate", "yaw rate", "gyro z", "wz", "omega", "angular velocity", "angular z"),
    "target_turn_rate": ("target turn rate", "cmd turn rate", "turn rate cmd", "cmd yaw rate", "cmd angular z"),
    "target_speed": (
        "target speed",
        "target",
        "speed target",
        "speed command",
        "cmd speed",
        "speed cmd",
        "desired speed",
        "reference speed",
    ),
    "throttle": ("throttle", "gas", "drive", "duty", "motor"),
    "steer": ("steer", "steering", "steering angle", "delta", "steer cmd", "steering command", "servo"),
    "angle": ("angle", "position", "theta", "q", "pos", "phi", "joint angle", "joint position"),
    "rate": ("rate", "velocity", "omega", "angular velocity", "qd", "vel", "joint velocity"),
    "torque": ("torque", "tau", "effort", "u", "motor torque", "joint torque", "motor effort"),
}
"""Column names that logs use for a quantity, the most common first; compared without case and punctuation."""
_UNIT_ENDINGS = {
    "ms": "ms", "us": "us", "ns": "ns", "mm": "mm", "cm": "cm", "deg": "deg", "degrees": "deg", "kmh": "km/h",
    "kph": "km/h", "mph": "mph", "mps": "m/s", "rpm": "rpm", "rad": "rad", "dps": "deg/s",
    "nm": "N m", "sec": "s",
}  # fmt: skip
_RIGHT = {"right", "cw", "clockwise"}
"""Parts of the names of columns that count to the right."""
_LEFT_POSITIVE = ("y", "yaw", "steer", "turn_rate", "target_turn_rate")


@dataclass(frozen=True)
class QuantityForm:
    """Source of one quantity: value = (-1 if flip else 1) * scale * factor(unit) * raw + offset, in unit ``si``."""

    target: str
    si: str
    source: str = ""
    """A column of the file; empty if none is chosen; DERIVED for the derivative of another column."""
    unit: str = ""
    """Unit of the column; empty for ``si``."""
    scale: float = 1.0
    offset: float = 0.0
    flip: bool = False
    window: float = _DEFAULT_WINDOW
    original: SourceColumn | DerivedColumn | None = None
    """The column of the loaded map if a line cannot show all of it (shift, join, derivative of a named state)."""

    @property
    def derivation(self) -> str:
        """Name of the derivation for this quantity if the log lacks it; empty if there is none."""
        return next((name for name, (target, _) in DERIVATIONS.items() if target == self.target), "")


def units_for(si: str) -> list[str]:
    """Names of the units that convert to an SI unit."""
    return [name for name, unit in UNITS.items() if unit.si == si]


def lines_of(system: System, columns: ColumnMap) -> list[QuantityForm]:
    """Returns the form of an existing column map."""
    return [_line_from_column(line, columns.columns.get(line.target)) for line in _empty_form(system)]


def _line_from_column(line: QuantityForm, column: SourceColumn | DerivedColumn | None) -> QuantityForm:
    if isinstance(column, DerivedColumn):
        return replace(line, source=DERIVED, window=column.window, original=column if column.of else None)
    if column is None:
        return line
    original = column if column.others or column.shift or column.hold else None
    source = f"{column.join} of {', '.join(column.sources)}" if column.others else column.source
    unit, flip = column.unit or "", column.flip
    return replace(
        line, source=source, unit=unit, scale=column.scale, offset=column.offset, flip=flip, original=original
    )


def guess_columns(system: System, names: Sequence[str]) -> list[QuantityForm]:
    """Guesses the form from column names; uses each column at most once."""
    if any(":@" in name for name in names):
        return _guess_topic_fields(system, names)
    free = list(names)
    lines = []
    for line in _empty_form(system):
        source = _find_column(line.target, free)
        if source:
            free.remove(source)
            unit = _unit_in(source, line.si)
            flip = line.target in _LEFT_POSITIVE and not _RIGHT.isdisjoint(_parts(source))
            lines.append(replace(line, source=source, unit=unit, flip=flip))
        else:
            lines.append(replace(line, source=DERIVED) if line.derivation else line)
    return lines


def _guess_topic_fields(system: System, names: Sequence[str]) -> list[QuantityForm]:
    """Guesses the form for a log of topics, whose columns have names such as /odom:pose.pose.position.x."""
    found = propose_sources((*system.state_names, *system.action_names), [name for name in names if ":@" not in name])
    first = next(iter(found.values()), "").rpartition(":")[0]
    found["t"] = next((name for name in names if name == f"{first}:@header"), f"{first}:@receipt" if first else "")
    empty = [replace(line, source=found.get(line.target, "")) for line in _empty_form(system)]
    return [replace(line, source=DERIVED) if line.derivation and not line.source else line for line in empty]


def map_text(system: System, lines: Sequence[QuantityForm]) -> str:
    """Returns the column map that a form describes, as TOML."""
    rows = ["format = 1", f"robot = {_toml_string(system.name)}", "", "[columns]"]
    return "\n".join([*rows, *(_toml_line(line) for line in lines if line.source)]) + "\n"


def _toml_line(line: QuantityForm) -> str:
    if isinstance(line.original, DerivedColumn):
        of, window = _toml_string(line.original.of), line.original.window
        return f'{line.target} = {{ derive = "{line.original.derive}", of = {of}, window = {window!r} }}'
    if line.source == DERIVED:
        return f"{line.target} = {{ derive = {_toml_string(line.derivation)}, window = {line.window!r} }}"
    parts = [f"from = {_toml_string(line.source)}"]
    if line.original is not None:
        names = ", ".join(map(_toml_string, line.original.sources))
        parts = [f'from = [{names}], join = "{line.original.join}"' if line.original.others else f"from = {names}"]
        parts += [f"shift = {line.original.shift!r}"] if line.original.shift else []
        parts += [f"hold = {line.original.hold!r}"] if line.original.hold else []
    if line.unit and line.unit != line.si:
        parts.append(f"unit = {_toml_string(line.unit)}")
    if line.scale != 1.0:
        parts.append(f"scale = {line.scale!r}")
    if line.offset != 0.0:
        parts.append(f"offset = {line.offset!r}")
    if line.flip:
        parts.append("flip = true")
    return f"{line.target} = {{ {', '.join(parts)} }}"


def _empty_form(system: System) -> list[QuantityForm]:
    return [
        QuantityForm("t", "s"),
        *(QuantityForm(variable.name, variable.unit) for variable in (*system.state, *system.action)),
    ]


def _find_column(target: str, names: Sequence[str]) -> str:
    plain = {name: _normalized(name) for name in names}
    candidates = (_normalized(target), *_COLUMN_NAMES.get(target, ()))
    for candidate in candidates:
        for name, normalized in plain.items():
            if normalized == candidate:
                return name
    if target in _COLUMN_NAMES and target in MEASURED:  # a measured speed is better than one that is derived
        for name, normalized in plain.items():
            if not COMMANDED.search(normalized) and target.replace("_", " ") in normalized:
                return name
    return ""


def _parts(name: str) -> list[str]:
    """The lower-case parts of a name: ``wheelspeed_kmh`` has ``wheel``, ``speed`` and ``kmh``."""
    split = re.sub(r"([a-z])([A-Z])", r"\1 \2", name)
    split = re.sub(r"(?<=[a-z])(speed|rate|angle)\b|(?<=[a-z])(speed|rate|angle)(?=_)", r" \1\2", split.lower())
    return join_units(re.sub(r"[^a-z0-9/]+", " ", split)).split()


def _normalized(name: str) -> str:
    """Lower-case name without punctuation, unit and direction: ``Yaw [deg]`` becomes ``yaw``."""
    parts = _parts(name)
    plain = [part for part in parts[1:] if part not in _UNIT_ENDINGS and part not in UNITS and part not in _RIGHT]
    return " ".join([*parts[:1], *plain])


def _unit_in(name: str, si: str) -> str:
    return next((unit for unit in _units_in(name) if UNITS[unit].si == si), "")


def _units_in(name: str) -> list[str]:
    units = [_UNIT_ENDINGS.get(part, part) for part in reversed(_parts(name)[1:])]
    return [unit for unit in units if unit in UNITS]


def unit_named(name: str) -> str:
    """The unit that ends a column's name, such as ``deg`` of ``angle_deg``; empty without one."""
    ambiguous = ("1", "s", "in", "min")  # of joint_1, start_s, plugged_in and speed_min
    return next((unit for unit in _units_in(name) if unit not in ambiguous), "")


def is_time(name: str) -> bool:
    """Whether a column's name is one of those that logs use for the time."""
    return _normalized(name) in _COLUMN_NAMES["t"]


def _toml_string(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in escaped) + '"'
