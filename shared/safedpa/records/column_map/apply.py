"""Applies a column map: raw columns of a log to time, states and actions of a system."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from safedpa.errors import ColumnMapError, did_you_mean
from safedpa.records.column_map.column_map import SLOPE, ColumnMap, DerivedColumn, SourceColumn
from safedpa.records.column_map.derive import slope
from safedpa.records.column_map.rates import joined_column, joined_rates
from safedpa.records.column_map.units import UNITS, factor_to_si
from safedpa.records.quality.clock import gap_rows
from safedpa.records.quality.findings import count_text, finding
from safedpa.records.readers.table import Table
from safedpa.records.run import Finding, RawRows, Stretch
from safedpa.records.segments import judge_clock, late_rows
from safedpa.systems import System

__all__ = ["check_map", "derive_states", "mapped_rows", "ordered_table", "resample_rows"]

_EPOCH = (1e9, 4e9)
"""s since 1970: the years 2001 to 2096."""


def check_map(columns: ColumnMap, system: System) -> None:
    """Raises ColumnMapError unless the map has exactly the quantities of the system."""
    if columns.robot != system.name:
        raise ColumnMapError(f"{columns.name}: robot: the map is for a {columns.robot}, the model for a {system.name}")
    needed = ("t", *system.state_names, *system.action_names)
    for target in columns.columns:
        if target not in needed:
            raise ColumnMapError(
                f"{columns.name}: columns.{target}: the model has no '{target}'; {did_you_mean(target, needed)}; "
                "correct the name, or take a model that fits this log"
            )
    for target in needed:
        if target not in columns.columns:
            raise ColumnMapError(
                f"{columns.name}: columns.{target}: missing; the {system.name} needs {', '.join(needed)}"
            )
    if columns.tracked_point is not None and not {"x", "y", "yaw"} <= set(system.state_names):
        raise ColumnMapError(f"{columns.name}: tracked_point: a {system.name} has no x, y and yaw; remove the table")
    for target, column in columns.columns.items():
        if isinstance(column, DerivedColumn) and (target not in system.state_names or column.of == target):
            raise ColumnMapError(f"{columns.name}: columns.{target}.derive: wanted for a state, of another state")
        if isinstance(column, DerivedColumn) and column.of and column.of not in system.state_names:
            known = did_you_mean(column.of, system.state_names)
            raise ColumnMapError(f"{columns.name}: columns.{target}.of: got '{column.of}'; {known}")
        if isinstance(column, SourceColumn) and column.unit is not None:
            factor_to_si(column.unit, _unit(system, target), f"{columns.name}: columns.{target}.unit")


def mapped_rows(table: Table, columns: ColumnMap, system: System) -> tuple[RawRows, tuple[Finding, ...]]:
    """Returns rows in SI units with the names of the system, in the order of their times, and findings about times.

    Derived states are NaN until ``derive_states``.
    """
    table = table.taken(_rows_to_keep(table, columns))
    findings = _epoch_findings(table, columns)
    if table.segment is None:
        table = ordered_table(table, _values(table, columns, system, "t"))
        table = joined_rates(table, columns, system, _values(table, columns, system, "t"))
    segment = np.zeros(len(table), dtype=np.intp) if table.segment is None else table.segment
    values = {name: _values(table, columns, system, name) for name in columns.columns}
    turns = [name for at, name in enumerate(system.state_names) if at in system.angles]
    turns = turns if columns.unwrap is None else [name for name in turns if name in columns.unwrap]
    breaks = np.flatnonzero(np.diff(segment)) + 1
    shifted = {
        name: _shifted(values["t"], breaks, part, columns.columns[name], name in turns) for name, part in values.items()
    }
    values, count = shifted, len(table)
    states = np.stack([values[name] for name in system.state_names], axis=1) if count else np.empty((0, 0))
    actions = np.array([values[name] for name in system.action_names]).reshape(len(system.action), count).T
    if columns.tracked_point is not None and count:
        states[~np.isfinite(states)] = np.nan  # cos(inf) would warn; non-finite rows are cut later
        point, at = columns.tracked_point, [system.state_names.index(name) for name in ("x", "y", "yaw")]
        yaw = states[:, at[2]] + point.yaw_offset
        states[:, at[0]] -= point.ahead * np.cos(yaw) - point.left * np.sin(yaw)
        states[:, at[1]] -= point.ahead * np.sin(yaw) + point.left * np.cos(yaw)
        states[:, at[2]] = yaw
    return RawRows(values["t"], states, actions, segment), (*table.findings, *findings)


def ordered_table(table: Table, t: NDArray[np.float64]) -> Table:
    """Sorts the rows of a table within the segments of its clock ``t`` [s]; rows whose time is wrong are removed."""
    clock = judge_clock(t)
    findings = list(table.findings)
    if clock.wrong.any():
        first, count = int(np.flatnonzero(clock.wrong)[0]), int(clock.wrong.sum())
        near = t[: first + 1][~clock.wrong[: first + 1] & np.isfinite(t[: first + 1])]
        text = f"{count_text(count, 'row has', 'rows have')} a time that fits none around it ({t[first]:.3f} s)"
        findings.append(finding("bad_stamp", text, count, near[-1] if len(near) else t[first], "cut out"))
    right = np.flatnonzero(~clock.wrong)
    late, largest = late_rows(t[right], clock.segment[right])
    if late.any():
        first, count = right[int(np.argmax(late))], int(late.sum())
        text = f"{count_text(count, 'row is', 'rows are')} out of order by up to {largest:.3g} s"
        findings.append(finding("out_of_order", text, count, t[first], "sorted"))
        last = np.fmax.accumulate(t[right])
        right = right[np.lexsort((np.where(np.isfinite(t[right]), t[right], last), clock.segment[right]))]
    taken = table.taken(right)
    return Table(taken.columns, tuple(findings), clock.segment[right])


def _shifted(
    t: NDArray[np.float64],
    breaks: NDArray[np.intp],
    values: NDArray[np.float64],
    column: SourceColumn | DerivedColumn,
    turns: bool,
) -> NDArray[np.float64]:
    """Corrects the delay ``shift`` of a column by linear interpolation; NaN beyond the ends of the log.

    This is the only place that interpolates, because the map requests it. It never interpolates across a gap or the
    ``breaks`` between segments. A column that ``turns`` is an angle, which is unwrapped first.
    """
    if isinstance(column, DerivedColumn) or column.shift == 0.0 or len(t) < 2:
        return values
    found = np.full(len(t), np.nan)
    for segment in np.split(np.arange(len(t)), breaks):
        timed = segment[np.isfinite(t[segment])]
        for rows in np.split(timed, np.flatnonzero(gap_rows(t[timed])[0])):
            if len(rows):
                finite = np.isfinite(values[rows])
                part = values[rows].copy()
                part[finite] = np.unwrap(part[finite]) if turns else part[finite]
                found[rows] = np.interp(t[rows] + column.shift, t[rows], part, left=np.nan, right=np.nan)
    return found


def _unit(system: System, target: str) -> str:
    units = {variable.name: variable.unit for variable in (*system.state, *system.action)}
    return "s" if target == "t" else units[target]


def _values(table: Table, columns: ColumnMap, system: System, target: str) -> NDArray[np.float64]:
    column = columns.columns[target]
    if isinstance(column, DerivedColumn):
        return np.full(len(table), np.nan)
    raw = joined_column(table, column)
    if column.unit is None:
        factor = _epoch_factor(table, column, raw)[1] if target == "t" else 1.0
    else:
        factor = factor_to_si(column.unit, _unit(system, target), target)
        if column.source in table.timed and factor != 1.0:
            raise ColumnMapError(
                f"{columns.name}: columns.{target}.unit: got '{column.unit}', but the column holds dates or times, "
                "which are read as seconds; leave the unit out"
            )
    gain = column.gain(factor)
    return raw if gain == 1.0 and column.offset == 0.0 else raw * gain + column.offset


def _epoch_factor(table: Table, column: SourceColumn, raw: NDArray[np.float64]) -> tuple[str, float]:
    """The unit, and its factor to seconds, of times since 1970 whose size leaves only one unit possible."""
    finite = np.abs(raw[np.isfinite(raw)])
    if column.scale != 1.0 or column.source in table.timed or not len(finite):
        return "s", 1.0
    size = float(np.median(finite))
    found = [unit for unit in ("ms", "us", "ns") if _EPOCH[0] <= UNITS[unit].factor * size <= _EPOCH[1]]
    return (found[0], UNITS[found[0]].factor) if found else ("s", 1.0)


def _epoch_findings(table: Table, columns: ColumnMap) -> list[Finding]:
    column = columns.columns["t"]
    if not isinstance(column, SourceColumn) or column.unit is not None:
        return []
    unit, factor = _epoch_factor(table, column, joined_column(table, column))
    if factor == 1.0:
        return []
    text = f"t is in {unit} since 1970 and was read so"
    return [finding("time_unit", text, len(table), None, f'name unit = "{unit}" in a column map to say so')]


def _rows_to_keep(table: Table, columns: ColumnMap) -> NDArray[np.bool_]:
    keep = np.ones(len(table), dtype=bool)
    keep[: columns.skip_first_rows] = False
    for rule in columns.skip_where:
        keep &= table.columns[rule.column] != rule.equals
    return keep


def derive_states(
    rows: RawRows, stretches: list[Stretch], columns: ColumnMap, system: System
) -> tuple[RawRows, list[Stretch], list[Finding]]:
    """Computes the derived states within each stretch, and trims its ends, where the window does not fit."""
    derived = {name: column for name, column in columns.columns.items() if isinstance(column, DerivedColumn)}
    if not derived:
        return rows, stretches, []
    states = rows.states.copy()
    names = system.state_names
    for stretch in stretches:
        part = slice(stretch.start, stretch.stop)
        for target, column in derived.items():
            states[part, names.index(target)] = _derivative(rows.t[part], states[part], names, column)
    trimmed = [_trimmed(states, stretch) for stretch in stretches]
    findings = [_derived_finding(target, column) for target, column in derived.items()]
    return replace(rows, states=states), [stretch for stretch in trimmed if len(stretch) > 1], findings


def _derivative(
    t: NDArray[np.float64], states: NDArray[np.float64], names: tuple[str, ...], column: DerivedColumn
) -> NDArray[np.float64]:
    if column.derive in ("rate_from_angle", SLOPE):
        return slope(t, states[:, names.index(column.of or "angle")], column.window)
    along_x = slope(t, states[:, names.index("x")], column.window)
    along_y = slope(t, states[:, names.index("y")], column.window)
    yaw = states[:, names.index("yaw")]
    return np.asarray(along_x * np.cos(yaw) + along_y * np.sin(yaw))


def _trimmed(states: NDArray[np.float64], stretch: Stretch) -> Stretch:
    good = np.flatnonzero(np.isfinite(states[stretch.start : stretch.stop]).all(axis=1))
    if not len(good):
        return Stretch(stretch.start, stretch.start)
    return Stretch(stretch.start + int(good[0]), stretch.start + int(good[-1]) + 1)


def _derived_finding(target: str, column: DerivedColumn) -> Finding:
    source = column.of or ("angle" if column.derive == "rate_from_angle" else "position")
    return Finding(
        "derived_state",
        f"{target} is the slope of the measured {source} over {column.window:g} s, central; "
        f"the first and last {column.window / 2:g} s of each stretch were cut for it",
    )


def resample_rows(rows: RawRows, stretches: list[Stretch], period: float) -> tuple[RawRows, list[Stretch]]:
    """Keeps the rows nearest to multiples of ``period`` [s], each with the mean action up to the next kept row.

    The action is averaged so that a command that changes between two kept rows has the same total effect. States are
    not averaged.
    """
    picked: list[NDArray[np.intp]] = []
    actions: list[NDArray[np.float64]] = []
    resampled: list[Stretch] = []
    for stretch in stretches:
        chosen = _nearest_to_multiples(rows.t[stretch.start : stretch.stop], period) + stretch.start
        if len(chosen) < 2:
            continue
        held = np.diff(rows.t[stretch.start : stretch.stop], append=rows.t[stretch.stop - 1])[:, None]
        held[-1] = held[:-1].mean()
        starts = chosen - stretch.start
        impulse = np.add.reduceat(rows.actions[stretch.start : stretch.stop] * held, starts)
        actions.append(impulse / np.add.reduceat(held, starts))
        first = sum(len(part) for part in picked)
        picked.append(chosen)
        resampled.append(Stretch(first, first + len(chosen)))
    if not picked:
        return rows.taken(np.zeros(len(rows.t), dtype=bool)), []
    index = np.concatenate(picked)
    return RawRows(rows.t[index], rows.states[index], np.concatenate(actions)), resampled


def _nearest_to_multiples(t: NDArray[np.float64], period: float) -> NDArray[np.intp]:
    if len(t) < 2:
        return np.zeros(len(t), dtype=np.intp)
    wanted = np.arange(t[0], t[-1] + float(np.median(np.diff(t))) / 2.0, period)
    after = np.clip(np.searchsorted(t, wanted), 1, len(t) - 1)
    nearest = np.where(wanted - t[after - 1] < t[after] - wanted, after - 1, after)
    return np.unique(nearest)
