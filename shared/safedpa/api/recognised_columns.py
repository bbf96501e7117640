"""The columns of a log by their role, as ``init`` recognises them: time, states and commands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.errors import InputError, RunError, did_you_mean
from safedpa.records.column_map.recognise import LoggedColumn, changes, is_command, logged_column, time_column
from safedpa.records.load import read_columns
from safedpa.records.readers.preview import raw_rows


@dataclass(frozen=True)
class RecognisedColumns:
    """The columns of a log by their role."""

    names: tuple[str, ...]
    time: str
    time_unit: str
    t: FloatArray
    states: tuple[LoggedColumn, ...]
    actions: tuple[LoggedColumn, ...]

    @classmethod
    def of(cls, logs: Sequence[Path], states: Mapping[str, str], actions: Mapping[str, str]) -> RecognisedColumns:
        """Reads logs, one after the other, and recognises the columns that ``states`` and ``actions`` do not name.

        Raises InputError for unknown columns and if no state or no command is found, RunError for unusable rows.
        """
        log, preview = logs[0], raw_rows(logs[0], 20)
        for column in (*states.values(), *actions.values()):
            if column not in preview.names:
                raise InputError(f"{log}: no column '{column}'; {did_you_mean(column, preview.names)}")
        cells = list(zip(*preview.rows, strict=False)) if preview.rows else [()] * len(preview.names)
        numeric = [name for name, column in zip(preview.names, cells, strict=False) if all(map(_is_number, column))]
        table = _one_after_the_other([read_columns(path, numeric).columns for path in logs])
        rows = np.all([np.isfinite(values) for values in table.values()], axis=0) if table else np.empty(0, bool)
        varied = {name: values[rows] for name, values in table.items() if rows.any() and np.ptp(values[rows]) > 0.0}
        time = time_column(varied)
        if not time or rows.sum() < 50:
            raise RunError(f"{log}: {rows.sum()} usable rows, time column '{time}'; wanted 50 rows and a column t [s]")
        clock = logged_column(time, varied.pop(time))
        own = {column: name for name, column in (*states.items(), *actions.items())}
        columns = [logged_column(column, values, own.get(column, "")) for column, values in varied.items()]
        commands = [item for item in columns if item.source in actions.values()]
        if not actions:
            commands = [item for item in columns if item.source not in own and is_command(item)]
        taken = {item.source for item in commands}
        measured = [item for item in columns if item.source not in taken and (not states or item.source in own)]
        if not commands or not measured:
            what, option = ("command", "--action") if not commands else ("state", "--state")
            seen = ", ".join(name for name in preview.names[:20] if name != time)
            raise InputError(f"{log}: no column looks like a {what} among {seen}; name one with {option} NAME=COLUMN")
        unit = clock.unit if clock.si == "s" else ""
        t = clock.values - clock.values[0]
        return cls(preview.names, time, unit, t, tuple(measured), tuple(commands))


def _one_after_the_other(tables: Sequence[Mapping[str, FloatArray]]) -> dict[str, FloatArray]:
    """The rows of all tables, each with times that follow those of the table before it."""
    whole = {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}
    time = time_column(tables[0])
    if len(tables) > 1 and time:
        ends, shifted = 0.0, []
        for table in tables:
            t = table[time] - table[time][0] + ends
            shifted.append(t)
            ends = float(t[-1] + np.median(np.diff(t)))
        whole[time] = np.concatenate(shifted)
    return whole


def _is_number(cell: str) -> bool:
    try:
        return cell == "" or float(cell) is not None
    except ValueError:
        return False


def unexplained_change(t: FloatArray, values: FloatArray, columns: Sequence[FloatArray]) -> float:
    """Mean square of the changes of a column that the integrals of others do not explain, over the best span."""
    rests = []
    for span in (4, 16):
        change = changes(t, values, span)[0]
        matrix = np.stack([changes(t, column, span)[1] for column in (*columns, np.ones_like(t))], axis=1)
        matrix /= np.linalg.norm(matrix, axis=0)
        solution = np.linalg.lstsq(matrix, change, rcond=1e-9)[0]
        rests.append(float(np.mean((change - matrix @ solution) ** 2)) / max(float(np.var(change)), 1e-300))
    return min(rests)
