"""Time and commands that look like another unit's: then no row can be used until a column map names the unit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from safedpa.records.apply_map import Rows
from safedpa.records.column_map import ColumnMap, SourceColumn
from safedpa.records.run import Finding
from safedpa.records.sentences import finding
from safedpa.systems import System

__all__ = ["other_units"]

_PERIODS = (2e-4, 0.5)
"""s between rows of a log that one may take for another unit's."""
_UNITS = (("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9))
_EPOCH = (1e9, 4e9)
"""s since 1970: 2001 to 2096."""
_PERCENT = (1.5, 100.5)
"""What a command of which 1 is all reaches in percent."""
_FEWEST = 20


def other_units(rows: Rows, system: System, mapping: ColumnMap) -> tuple[NDArray[np.bool_], list[Finding]]:
    """Every row, where time looks like ms, us or ns, or a command like percent, and no column map names the unit."""
    named = {name for name, item in mapping.columns.items() if isinstance(item, SourceColumn) and item.unit is not None}
    found = [] if "t" in named else _time(rows, system)
    found += _percent(rows, system, named)
    return np.full(len(rows.t), bool(found)), found


def _time(rows: Rows, system: System) -> list[Finding]:
    steps = np.diff(rows.t[np.isfinite(rows.t)])
    steps = steps[steps > 0.0]
    if len(steps) < _FEWEST:
        return []
    period, last = float(np.median(steps)), float(np.nanmax(np.abs(rows.t)))
    for unit, factor in _UNITS:
        if not _PERIODS[0] <= factor * period <= _PERIODS[1]:
            continue
        epoch = _EPOCH[0] <= factor * last <= _EPOCH[1]
        if period > 10.0 * _PERIODS[1] and (epoch or _faster(rows, system, factor) or _counted(rows.t, period)):
            text = f"t steps by {period:.4g}: it looks like {unit}, not seconds, so every row was cut"
            done = f'name unit = "{unit}" for t in a column map, or unit = "s" if it is seconds'
            return [finding("unit_mistake", text, len(rows.t), None, done)]
    return []


def _counted(t: NDArray[np.float64], period: float) -> bool:
    """Whether time is counted in whole steps of a finer unit, the rows a round number of them apart."""
    return bool((t[np.isfinite(t)] % 1.0 == 0.0).all()) and period in (10.0, 20.0, 25.0, 40.0, 50.0, 100.0)


def _faster(rows: Rows, system: System, factor: float) -> bool:
    """Whether some state moves as fast as another says only once time is multiplied with a factor."""
    for at, variable in enumerate(system.state):
        for other, rate in enumerate(system.state):
            if rate.unit != f"{variable.unit}/s" or variable.name in ("x", "y"):
                continue
            if _agrees(rows.t, rows.states[:, at], rows.states[:, other], factor):
                return True
    names = system.state_names
    if not {"x", "y", "speed"} <= set(names):
        return False
    x, y, speed = (rows.states[:, names.index(name)] for name in ("x", "y", "speed"))
    with np.errstate(all="ignore"):
        moved = np.hypot(np.diff(x), np.diff(y)).sum()
        said = float((np.abs(speed[:-1]) * np.diff(rows.t)).sum()) * factor
    return bool(np.isfinite(moved) and np.isfinite(said) and moved > 0 and 0.7 < said / moved < 1.4)


def _agrees(t: NDArray[np.float64], values: NDArray[np.float64], rates: NDArray[np.float64], factor: float) -> bool:
    good = np.isfinite(values) & np.isfinite(rates) & np.isfinite(t)
    if good.sum() < _FEWEST:
        return False
    moved = np.abs(np.diff(np.unwrap(values[good]))).sum()
    said = float((np.abs(rates[good][:-1]) * np.diff(t[good])).sum()) * factor
    return bool(moved > 0 and 0.7 < said / moved < 1.4)


def _percent(rows: Rows, system: System, named: set[str]) -> list[Finding]:
    found = []
    for index, variable in enumerate(system.action):
        values = rows.actions[:, index]
        values = np.abs(values[np.isfinite(values)])
        if variable.unit != "1" or variable.high > 1.0 or len(values) < _FEWEST or variable.name in named:
            continue
        largest = float(np.quantile(values, 0.99))
        if _PERCENT[0] < largest <= _PERCENT[1] and float((values > variable.high).mean()) > 0.2:
            text = f"{variable.name} reaches {largest:.4g} where 1 is all: it looks like percent, so every row was cut"
            done = f'name unit = "%" for {variable.name} in a column map'
            found.append(finding("unit_mistake", text, len(rows.t), None, done))
    return found
