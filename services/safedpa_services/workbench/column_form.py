"""A column map as a form: one line for each quantity that the robot needs, guessed from a file's columns."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from safedpa.records.column_map.column_map import DERIVATIONS, ColumnMap, DerivedColumn, SourceColumn
from safedpa.records.column_map.propose import propose_sources
from safedpa.records.column_map.units import UNITS
from safedpa.systems import System

__all__ = ["DERIVED", "QuantityForm", "guess_columns", "lines_of", "map_text", "units_for"]

DERIVED = "(slope of another column)"
"""Stands for the source of a state that the log lacks."""

_WINDOW = 0.1
"""s over which a slope is taken unless a map says otherwise."""
_TEXT: Mapping[str, tuple[str, ...]] = {
    "t": ("t", "time", "timestamp", "stamp", "seconds", "secs", "clock"),
    "x": ("x", "pos x", "position x", "px", "vicon x", "pose x"),
    "y": ("y", "pos y", "position y", "py", "vicon y", "pose y"),
    "yaw": ("yaw", "heading", "theta", "psi", "orientation", "vicon yaw"),
    "speed": ("speed", "v", "vel", "velocity", "vx", "vel encoder"),
    "target_speed": ("target speed", "speed command", "cmd speed", "speed cmd", "desired speed", "reference speed"),
    "throttle": ("throttle", "gas", "drive", "duty", "motor"),
    "steer": ("steer", "steering", "steering angle", "delta", "steer cmd", "steering command"),
    "angle": ("angle", "position", "theta", "q", "pos"),
    "rate": ("rate", "velocity", "omega", "angular velocity", "qd", "vel"),
    "torque": ("torque", "tau", "effort", "u"),
}
"""Names under which logs hold a quantity, the likeliest first; compared without case and punctuation."""
_UNIT_ENDINGS = {
    "ms": "ms", "us": "us", "ns": "ns", "mm": "mm", "cm": "cm", "deg": "deg", "degrees": "deg", "kmh": "km/h",
    "kph": "km/h", "mph": "mph", "mps": "m/s", "rpm": "rpm", "rad": "rad", "dps": "deg/s",
}  # fmt: skip


@dataclass(frozen=True)
class QuantityForm:
    """Where one quantity comes from: value = (-1 if flip else 1) scale factor(unit) raw + offset, in ``si``."""

    target: str
    si: str
    source: str = ""
    """A column of the file; empty: none chosen yet; DERIVED: the slope of another column."""
    unit: str = ""
    """Empty: that of ``si``."""
    scale: float = 1.0
    offset: float = 0.0
    flip: bool = False
    window: float = _WINDOW
    retained: SourceColumn | DerivedColumn | None = None
    """The map's own column where it says more than a line shows: shifted, joined, the slope of a named state."""

    @property
    def derivation(self) -> str:
        """What derives this quantity where the log lacks it; empty where nothing does."""
        return next((name for name, (target, _) in DERIVATIONS.items() if target == self.target), "")


def units_for(si: str) -> list[str]:
    """Names of the units that measure the same as an SI unit."""
    return [name for name, unit in UNITS.items() if unit.si == si]


def lines_of(system: System, columns: ColumnMap) -> list[QuantityForm]:
    """The form of a column map that is there."""
    return [_line_of(line, columns.columns.get(line.target)) for line in _empty(system)]


def _line_of(line: QuantityForm, column: SourceColumn | DerivedColumn | None) -> QuantityForm:
    if isinstance(column, DerivedColumn):
        return replace(line, source=DERIVED, window=column.window, retained=column if column.of else None)
    if column is None:
        return line
    retained = column if column.others or column.shift or column.hold else None
    source = f"{column.join} of {', '.join(column.sources)}" if column.others else column.source
    unit, flip = column.unit or "", column.flip
    return replace(
        line, source=source, unit=unit, scale=column.scale, offset=column.offset, flip=flip, retained=retained
    )


def guess_columns(system: System, names: Sequence[str]) -> list[QuantityForm]:
    """The form with the columns whose names say what they hold; each column once."""
    if any(":@" in name for name in names):
        return _guessed_of_topics(system, names)
    free = list(names)
    lines = []
    for line in _empty(system):
        source = _likeliest(line.target, free)
        if source:
            free.remove(source)
            unit = _unit_in(source, line.si)
            lines.append(replace(line, source=source, unit=unit))
        else:
            lines.append(replace(line, source=DERIVED) if line.derivation else line)
    return lines


def _guessed_of_topics(system: System, names: Sequence[str]) -> list[QuantityForm]:
    """The same of a log of topics, whose columns are called /odom:pose.pose.position.x."""
    found = propose_sources((*system.state_names, *system.action_names), [name for name in names if ":@" not in name])
    first = next(iter(found.values()), "").rpartition(":")[0]
    found["t"] = next((name for name in names if name == f"{first}:@header"), f"{first}:@receipt" if first else "")
    empty = [replace(line, source=found.get(line.target, "")) for line in _empty(system)]
    return [replace(line, source=DERIVED) if line.derivation and not line.source else line for line in empty]


def map_text(system: System, lines: Sequence[QuantityForm]) -> str:
    """The column map that a form describes, as TOML."""
    rows = ["format = 1", f"robot = {_quoted(system.name)}", "", "[columns]"]
    return "\n".join([*rows, *(_row(line) for line in lines if line.source)]) + "\n"


def _row(line: QuantityForm) -> str:
    if isinstance(line.retained, DerivedColumn):
        of, window = _quoted(line.retained.of), line.retained.window
        return f'{line.target} = {{ derive = "{line.retained.derive}", of = {of}, window = {window!r} }}'
    if line.source == DERIVED:
        return f"{line.target} = {{ derive = {_quoted(line.derivation)}, window = {line.window!r} }}"
    parts = [f"from = {_quoted(line.source)}"]
    if line.retained is not None:
        names = ", ".join(map(_quoted, line.retained.sources))
        parts = [f'from = [{names}], join = "{line.retained.join}"' if line.retained.others else f"from = {names}"]
        parts += [f"shift = {line.retained.shift!r}"] if line.retained.shift else []
        parts += [f"hold = {line.retained.hold!r}"] if line.retained.hold else []
    if line.unit and line.unit != line.si:
        parts.append(f"unit = {_quoted(line.unit)}")
    if line.scale != 1.0:
        parts.append(f"scale = {line.scale!r}")
    if line.offset != 0.0:
        parts.append(f"offset = {line.offset!r}")
    if line.flip:
        parts.append("flip = true")
    return f"{line.target} = {{ {', '.join(parts)} }}"


def _empty(system: System) -> list[QuantityForm]:
    return [
        QuantityForm("t", "s"),
        *(QuantityForm(variable.name, variable.unit) for variable in (*system.state, *system.action)),
    ]


def _likeliest(target: str, names: Sequence[str]) -> str:
    plain = {name: _plain(name) for name in names}
    for word in (_plain(target), *_TEXT.get(target, ())):
        for name, own in plain.items():
            if own == word:
                return name
    return ""


def _plain(name: str) -> str:
    """Lower case words without a unit at the end: ``Yaw [deg]`` is ``yaw``."""
    phrase = re.sub(r"[^a-z0-9/]+", " ", name.lower()).split()
    while len(phrase) > 1 and (phrase[-1] in _UNIT_ENDINGS or phrase[-1] in UNITS):
        phrase.pop()
    return " ".join(phrase)


def _unit_in(name: str, si: str) -> str:
    phrase = re.sub(r"[^a-z0-9/]+", " ", name.lower()).split()
    for word in reversed(phrase[1:]):
        unit = _UNIT_ENDINGS.get(word, word)
        if unit in UNITS and UNITS[unit].si == si:
            return unit
    return ""


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in escaped) + '"'
