"""Twenty ways in which a good log of a car goes bad, and by which finding each has to be noticed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.errors import InputError

Table = dict[str, FloatArray]


@dataclass(frozen=True)
class Bad:
    """One way to spoil a table of columns by name, and how that is noticed."""

    kind: str
    """Of the finding; ``refused`` where the file cannot be read as it is."""
    notice: str
    """Part of the sentence."""
    spoil: Callable[[Table], Table]
    text: Callable[[Table], str] | None = None
    """Where the fault is in how numbers are written."""


def _csv(table: Table, delimiter: str = ",", comma: bool = False, before: str = "") -> str:
    rows = zip(*(column.tolist() for column in table.values()), strict=True)
    lines = [delimiter.join(table), *(delimiter.join(f"{value:.9g}" for value in row) for row in rows)]
    text = "\n".join(lines)
    return before + (text.replace(".", ",") if comma else text) + "\n"


def _same(table: Table) -> Table:
    return table


def _changed(**changes: Callable[[FloatArray], FloatArray]) -> Callable[[Table], Table]:
    return lambda table: {name: changes[name](v) if name in changes else v for name, v in table.items()}


def _drive(table: Table) -> str:
    return "throttle" if "throttle" in table else "target_speed"


def _drive_changed(change: Callable[[FloatArray], FloatArray]) -> Callable[[Table], Table]:
    return lambda table: {**table, _drive(table): change(table[_drive(table)])}


def _frozen(values: FloatArray) -> FloatArray:
    """From a third of the log on the value stays, for a quarter of it."""
    found, begin = values.copy(), len(values) // 3
    found[begin : begin + len(values) // 4] = values[begin]
    return found


def _dead(values: FloatArray) -> FloatArray:
    found = values.copy()
    found[len(values) // 2 :] = 0.0
    return found


def _late(table: Table) -> Table:
    """Speed as it was 0.3 s ago."""
    return {**table, "speed": np.interp(table["t"] - 0.3, table["t"], table["speed"])}


def _thinned(table: Table) -> Table:
    """In the second half every other row."""
    rows = np.arange(len(table["t"]))
    retained = (rows < len(rows) // 2) | (rows % 2 == 0)
    return {name: values[retained] for name, values in table.items()}


def _every(count: int, value: float) -> Callable[[FloatArray], FloatArray]:
    def change(values: FloatArray) -> FloatArray:
        found = values.copy()
        found[50::count] = value
        return found

    return change


def _swapped(table: Table) -> Table:
    return {**table, "x": table["y"], "y": table["x"]}


def _jumped(values: FloatArray) -> FloatArray:
    return values + np.where(np.arange(len(values)) > len(values) // 2, 5.0, 0.0)


def _gap(table: Table) -> Table:
    rows = np.arange(len(table["t"]))
    retained = (rows < len(rows) // 2) | (rows > len(rows) // 2 + 60)
    return {name: values[retained] for name, values in table.items()}


_DEGREES = 180.0 / np.pi

BAD: Final[Mapping[str, Bad]] = {
    "frozen_speed": Bad("frozen", "speed stays at exactly", _changed(speed=_frozen)),
    "frozen_yaw": Bad("frozen", "yaw stays at exactly", _changed(yaw=_frozen)),
    "dead_drive": Bad("dead_command", "its recording looks dead", _drive_changed(_dead)),
    "dead_steer": Bad("dead_command", "steer stays at 0", _changed(steer=_dead)),
    "drive_flipped": Bad("opposite_sign", "speed falls as", _drive_changed(lambda v: -v)),
    "steer_flipped": Bad("opposite_sign", "turns against steer", _changed(steer=lambda v: -v)),
    "speed_late": Bad("time_offset", "comes 0.3", _late),
    "milliseconds": Bad("refused", "looks like ms", _changed(t=lambda v: np.round(1e3 * v))),
    "nanoseconds": Bad("refused", "looks like ns", _changed(t=lambda v: np.round(1e9 * v))),
    "percent": Bad("refused", "looks like percent", _drive_changed(lambda v: 100.0 * v)),
    "decimal_comma": Bad("decimal_comma", "decimal commas", _same, lambda table: _csv(table, ";", comma=True)),
    "comment_lines": Bad(
        "comment_lines", "before the header", _same, lambda table: _csv(table, before="# recorded by hand\n# car 7\n")
    ),
    "two_rates": Bad("two_rates", "two rates in one file", _thinned),
    "same_twice": Bad("same_recording", "the same recording", _changed(t=lambda v: v + 500.0)),
    "steer_in_degrees": Bad("refused", "looks like degrees", _changed(steer=lambda v: _DEGREES * v)),
    "speed_in_km_per_hour": Bad("unit_mistake", "km/h", _changed(speed=lambda v: 3.6 * v)),
    "beyond_bounds": Bad("out_of_bounds", "widen the bound", _changed(steer=_every(9, 0.8))),
    "x_and_y_swapped": Bad("swapped_columns", "look swapped", _swapped),
    "teleport": Bad("jump", "jumps", _changed(x=_jumped)),
    "gap": Bad("gap", "gap", _gap),
}
"""By name. ``same_twice`` is to be given next to the log that it is a copy of; ``percent`` is of a throttle."""


_NEEDED = {"t", "x", "y", "yaw", "speed", "steer"}
_NATIVE = _NEEDED | {"target_speed", "throttle"}


def write_bad_files(log: Path, folder: Path, faults: Sequence[str] = tuple(BAD)) -> dict[str, Path]:
    """Writes each of ``faults`` made from a good log of a car in native columns into a folder; the files by name.

    Only the native columns are read and written. Raises InputError where the log has other ones, or no numbers in them.
    """
    lines = log.read_text(encoding="utf-8").splitlines()
    names = lines[0].split(",") if lines else []
    if not set(names) >= _NEEDED:
        raise InputError(f"{log}: got the columns {', '.join(names)}; wanted the native ones of a car")
    native = [
        index for index, name in enumerate(names) if name in _NATIVE
    ]  # an export reports verdicts in words next to
    try:
        values = np.array([[float(line.split(",")[index]) for index in native] for line in lines[1:]])
    except (ValueError, IndexError) as error:
        raise InputError(f"{log}: wanted a number in every cell of the native columns ({error})") from error
    if not len(values):
        raise InputError(f"{log}: got no rows; wanted a good log of a car")
    table = {names[index]: values[:, place].copy() for place, index in enumerate(native)}
    folder.mkdir(parents=True, exist_ok=True)
    found = {}
    for name, bad in ((name, BAD[name]) for name in faults):
        if name == "percent" and "throttle" not in table:
            continue
        found[name] = folder / f"{name}.csv"
        found[name].write_text((bad.text or _csv)(bad.spoil(dict(table))), encoding="utf-8")
    return found
