"""Joins columns: several to one, and columns of different rates that share a table.

In a table of two rates, as an outer join writes it, each row holds the cells of one source, and the others are empty.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from safedpa.records.column_map.column_map import HOLD_ACTION, HOLD_STATE, ColumnMap, SourceColumn
from safedpa.records.quality.findings import count_text, finding
from safedpa.records.readers.table import Table
from safedpa.systems import System

__all__ = ["joined_column", "joined_rates"]

_SAME_RATE = 0.5
"""Share of the rows of the states in which a column of the same rate has a value."""


def joined_column(table: Table, column: SourceColumn) -> NDArray[np.float64]:
    """Returns the raw column, or several joined into one, shape (rows,)."""
    if not column.others:
        return table.columns[column.source]
    parts = np.stack([table.columns[name] for name in column.sources])
    if column.join == "norm":
        return np.asarray(np.sqrt((parts**2).sum(axis=0)))
    if column.join == "difference":
        return np.asarray(parts[0] - parts[1:].sum(axis=0))
    if column.join == "first":
        finite = np.isfinite(parts)
        return np.asarray(np.take_along_axis(parts, finite.argmax(axis=0)[None], axis=0)[0])
    return np.asarray(parts.sum(axis=0) if column.join == "sum" else parts.mean(axis=0))


def joined_rates(table: Table, columns: ColumnMap, system: System, t: NDArray[np.float64]) -> Table:
    """Fills columns of another rate, and those with a ``hold``, with their latest value; rows in order of ``t`` [s].

    A value is used in its segment until it is older than ``hold``, or than the default if the map names none. Rows
    without a state, which only held the cells of another rate, are removed.
    """
    names = (*system.state_names, *system.action_names)
    sources = {name: column for name in names if isinstance(column := columns.columns[name], SourceColumn)}
    filled = {name: np.isfinite(joined_column(table, column)) for name, column in sources.items()}
    states = [name for name in system.state_names if name in sources]
    if not states or not len(t):
        return table
    rows = max((filled[name] for name in states), key=np.count_nonzero)
    count = max(1, int(rows.sum()))
    other = [name for name in sources if (filled[name] & rows).sum() < _SAME_RATE * count and filled[name].any()]
    carriers = ~rows & np.any([filled[name] for name in other], axis=0) if other else np.zeros(len(t), dtype=bool)
    apart = other if carriers.any() else []
    values = dict(table.columns)
    for name, column in sources.items():
        usual = HOLD_ACTION if name in system.action_names else HOLD_STATE
        if name in apart or column.hold is not None:
            for source in column.sources:
                values[source] = _held(t, table.columns[source], table.segment, column.hold or usual)
    findings = table.findings
    if apart:
        text = f"{count_text(int(carriers.sum()), 'row holds', 'rows hold')} only {', '.join(apart)}: two rates in one "
        done = "the latest value was taken for the other rows; 'hold' in a column map says how long"
        findings = (*findings, finding("joined_rates", f"{text}table", int(carriers.sum()), None, done))
    return Table(values, findings, table.segment, table.timed).taken(~carriers if apart else slice(None))


def _held(
    t: NDArray[np.float64], values: NDArray[np.float64], segment: NDArray[np.intp] | None, hold: float
) -> NDArray[np.float64]:
    """The latest finite value of the same segment, no older than ``hold`` [s], at each row."""
    own = np.where(np.isfinite(values) & np.isfinite(t), np.arange(len(t)), -1)
    newest = np.maximum.accumulate(own)
    known = np.maximum(newest, 0)
    with np.errstate(invalid="ignore"):
        recent = (newest >= 0) & (t - t[known] <= hold)
    if segment is not None:
        recent &= segment[known] == segment
    return np.where(recent, values[known], np.nan)
