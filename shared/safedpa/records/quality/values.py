"""Checks of single values: not finite, out of bounds, constant inputs, and wrong units.

If time, commands or angles seem to have another unit, all rows are cut until a column map names the unit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from safedpa.records.column_map.column_map import ColumnMap, SourceColumn
from safedpa.records.quality.findings import count_text, finding
from safedpa.records.run import Finding, RawRows, Stretch
from safedpa.systems import System, Variable

__all__ = ["constant_findings", "degrees_for_radians", "not_a_number", "other_units", "out_of_bounds"]

Found = tuple[NDArray[np.bool_], list[Finding]]


def _columns(rows: RawRows, system: System, measured: list[bool]) -> list[tuple[Variable, NDArray[np.float64]]]:
    """All measured columns with their variables; derived ones are not checked, because they follow from others."""
    states = [(variable, rows.states[:, index]) for index, variable in enumerate(system.state) if measured[index]]
    return states + [(variable, rows.actions[:, index]) for index, variable in enumerate(system.action)]


def not_a_number(rows: RawRows, system: System, measured: list[bool]) -> Found:
    """Rows in which time, a measured state or an action is missing, NaN, infinite or beyond ``LARGEST_NUMBER``."""
    columns = [("t", rows.t), *((variable.name, values) for variable, values in _columns(rows, system, measured))]
    masks = {name: ~np.isfinite(values) for name, values in columns}
    bad = np.any(list(masks.values()), axis=0)
    count = int(bad.sum())
    if not count:
        return bad, []
    names = ", ".join(name for name, mask in masks.items() if mask.any())
    text = f"{count_text(count, 'row', 'rows')} without a finite number in {names}"
    return bad, [finding("not_a_number", text, count, _time_at(rows.t, int(np.argmax(bad))), "cut out")]


def _time_at(t: NDArray[np.float64], row: int) -> float | None:
    """Time of a row, or of the last row before it with a finite time."""
    before = t[: row + 1][np.isfinite(t[: row + 1])]
    return float(before[-1]) if len(before) else None


def out_of_bounds(rows: RawRows, system: System, measured: list[bool]) -> Found:
    """Rows with a measured state or an action outside the range that its system declares."""
    bad = np.zeros(len(rows.t), dtype=bool)
    found = []
    for variable, values in _columns(rows, system, measured):
        slack = _slack(variable, values)
        mask = np.isfinite(values) & ((values < variable.low - slack) | (values > variable.high + slack))
        count = int(mask.sum())
        if count:
            worst = float(values[mask][np.argmax(np.abs(values[mask]))])
            text = (
                f"{count_text(count, 'row', 'rows')} with {variable.name} outside "
                f"{variable.low:g} .. {variable.high:g} "
                f"{variable.unit}, the worst {worst:.4g}"
            )
            done = (
                "cut out; if the robot really does that, widen the bound in its system, or set "
                'keep = ["out_of_bounds"] in a column map; else name the unit or scale there'
            )
            found.append(finding("out_of_bounds", text, count, _time_at(rows.t, int(np.argmax(mask))), done))
            bad |= mask
    return bad, found


def _slack(variable: Variable, values: NDArray[np.float64]) -> float:
    """How far a value may be beyond a bound: rounding, and the noise of a measurement at the bound."""
    finite = values[np.isfinite(values)]
    span = variable.high - variable.low
    if not np.isfinite(span):
        return 0.0
    # the second difference of a smooth signal is its noise, of variance 6; 0.455 is the median of chi squared
    noise = float(np.sqrt(np.median(np.diff(finite, 2) ** 2) / 0.455 / 6.0)) if len(finite) > _MIN_ROWS else 0.0
    slack = min(_NOISE * noise, _NOISE_SHARE * span)
    resting = max(int((np.abs(finite - bound) < slack).sum()) for bound in (variable.low, variable.high))
    return max(1e-6 * max(abs(variable.low), abs(variable.high)), slack if resting >= _MIN_ROWS else 0.0)


_NOISE, _NOISE_SHARE = 5.0, 0.01
"""Standard deviations of noise that a state at its bound may be beyond it, and the largest such share of the range."""


def constant_findings(rows: RawRows, stretches: list[Stretch], system: System) -> list[Finding]:
    """Reports actions that never change, and runs in which no state changes."""
    if not stretches:
        return []
    rows_used = np.concatenate([np.arange(stretch.start, stretch.stop) for stretch in stretches])
    found = []
    for index, variable in enumerate(system.action):
        values = rows.actions[rows_used, index]
        if np.ptp(values) <= 1e-9 * max(1.0, float(np.abs(values).max())):
            text = (
                f"{variable.name} is always {values[0]:.4g} {variable.unit}: "
                "its effect cannot be identified; nothing was cut for it"
            )
            found.append(finding("constant_input", text, len(rows_used)))
    if np.nanmax(np.ptp(rows.states[rows_used], axis=0), initial=0.0) <= 1e-9:
        found.append(finding("no_motion", "no state ever changes: the run cannot show the dynamics", len(rows_used)))
    return found


_PERIODS = (2e-4, 0.5)
"""Plausible range of the time between rows, s."""
_FASTEST, _DAY = 2e-5, 86_400.0
"""s; no robot is recorded in shorter steps."""
_UNITS = (("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9))
_EPOCH = (1e9, 4e9)
"""s since 1970: the years 2001 to 2096."""
_PERCENT = (1.5, 100.5)
"""Range of the largest value of a normalised command that is given in percent."""
_MIN_ROWS = 20
_MIN_STEPS = 30
_DONE = 'name unit = "deg" in a column map'


def other_units(rows: RawRows, system: System, mapping: ColumnMap) -> tuple[NDArray[np.bool_], list[Finding]]:
    """All rows, if time seems to be in ms, us or ns, or a command in percent, and no column map names the unit."""
    named = {name for name, item in mapping.columns.items() if isinstance(item, SourceColumn) and item.unit is not None}
    found = [] if "t" in named else _time_unit(rows, system)
    found += _percent(rows, system, named)
    found += _beyond_bounds(rows, system, named)
    return np.full(len(rows.t), bool(found)), found


def _time_unit(rows: RawRows, system: System) -> list[Finding]:
    steps = np.diff(rows.t[np.isfinite(rows.t)])
    steps = steps[steps > 0.0]
    if len(steps) < _MIN_ROWS:
        return []
    period, last = float(np.median(steps)), float(np.nanmax(np.abs(rows.t)))
    if period < _FASTEST and _PERIODS[0] <= _DAY * period <= _PERIODS[1]:
        text = f"t steps by {period:.4g}: it looks like days, as spreadsheets count, not seconds, so every row was cut"
        return [finding("unit_mistake", text, len(rows.t), None, "multiply it by 86400, or write dates")]
    for unit, factor in _UNITS:
        if not _PERIODS[0] <= factor * period <= _PERIODS[1]:
            continue
        slow = period > 10.0 * _PERIODS[1]  # far too slow if these were seconds
        epoch = _EPOCH[0] <= factor * last <= _EPOCH[1]
        if epoch or (slow and (_rates_fit_factor(rows, system, factor) or _in_whole_units(rows.t, period))):
            text = f"t steps by {period:.4g}: it looks like {unit}, not seconds, so every row was cut"
            done = f'name unit = "{unit}" for t in a column map, or unit = "s" if it is seconds'
            return [finding("unit_mistake", text, len(rows.t), None, done)]
    return []


def _in_whole_units(t: NDArray[np.float64], period: float) -> bool:
    """Whether times are whole numbers of a finer unit, with a round number of them between rows."""
    return bool((t[np.isfinite(t)] % 1.0 == 0.0).all()) and period in (10.0, 20.0, 25.0, 40.0, 50.0, 100.0)


def _rates_fit_factor(rows: RawRows, system: System, factor: float) -> bool:
    """Whether some state changes at the measured rate only if time is multiplied by a factor."""
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
    good = np.isfinite(x) & np.isfinite(y) & np.isfinite(speed) & np.isfinite(rows.t)
    with np.errstate(all="ignore"):
        moved = np.hypot(np.diff(x[good]), np.diff(y[good])).sum()
        expected = (np.abs(speed[good][:-1]) * np.diff(rows.t[good])).sum() * factor
        return bool(0.7 < expected / moved < 1.4)  # False for NaN: a robot that does not move


def _agrees(t: NDArray[np.float64], values: NDArray[np.float64], rates: NDArray[np.float64], factor: float) -> bool:
    good = np.isfinite(values) & np.isfinite(rates) & np.isfinite(t)
    if good.sum() < _MIN_ROWS:
        return False
    moved = np.abs(np.diff(np.unwrap(values[good]))).sum()
    expected = float((np.abs(rates[good][:-1]) * np.diff(t[good])).sum()) * factor
    return bool(moved > 0 and 0.7 < expected / moved < 1.4)


def _percent(rows: RawRows, system: System, named: set[str]) -> list[Finding]:
    found = []
    for index, variable in enumerate(system.action):
        values = rows.actions[:, index]
        values = np.abs(values[np.isfinite(values)])
        if variable.unit != "1" or variable.high > 1.0 or len(values) < _MIN_ROWS or variable.name in named:
            continue
        largest = float(np.quantile(values, 0.99))
        if _PERCENT[0] < largest <= _PERCENT[1] and float((values > variable.high).mean()) > 0.2:
            text = f"{variable.name} reaches {largest:.4g} where 1 is the maximum: it looks like percent, so every row "
            text += "was cut"
            done = f'name unit = "%" for {variable.name} in a column map'
            found.append(finding("unit_mistake", text, len(rows.t), None, done))
    return found


def _beyond_bounds(rows: RawRows, system: System, named: set[str]) -> list[Finding]:
    """Channels that are mostly beyond their bounds, and well within them once divided by a usual factor."""
    found = []
    channels = [*zip(system.state, rows.states.T, strict=True), *zip(system.action, rows.actions.T, strict=True)]
    for item, column in channels:
        values = np.abs(column[np.isfinite(column)])
        bound = max(abs(item.low), abs(item.high))
        if item.name in named or item.unit == "1" or len(values) < _MIN_ROWS or not np.isfinite(bound):
            continue
        outside = float(((column < item.low) | (column > item.high)).mean())
        largest = float(np.quantile(values, 0.99))
        for factor, name in _FACTORS:
            fits = _LEAST_RANGE * bound < largest / factor <= bound * (1.0 + 1e-9)
            if outside > _MOSTLY and fits and (factor not in _OF_ANGLES or item.unit.startswith("rad")):
                text = (
                    f"{item.name} reaches {largest:.4g} {item.unit} where {bound:.4g} is the bound: it looks as if it "
                    f"were in {name}, a factor of {factor:.4g}, so every row was cut"
                )
                done = f"name its unit or a scale for {item.name} in a column map, or widen the bound in its system"
                found.append(finding("unit_mistake", text, len(rows.t), None, done))
                break
    return found


_FACTORS = ((float(np.degrees(1.0)), "degrees"), (1000.0, "thousandths (mm, mA, mV)"), (100.0, "hundredths (cm)"))
"""Usual factors between units, by what they are called."""
_OF_ANGLES = (float(np.degrees(1.0)),)
_MOSTLY, _LEAST_RANGE = 0.4, 0.1
"""Share of the rows beyond the bounds, and share of the bounds that the corrected values must reach."""


def degrees_for_radians(rows: RawRows, system: System) -> tuple[NDArray[np.bool_], list[Finding]]:
    """All rows, if a commanded angle or the heading is in degrees. Must run before angles are unwrapped."""
    found = _commands_in_degrees(rows, system) + _heading_in_degrees(rows, system)
    return np.full(len(rows.t), bool(found)), found


def _commands_in_degrees(rows: RawRows, system: System) -> list[Finding]:
    """Reports actions in rad beyond pi / 2: no joint or wheel turns that far."""
    found = []
    for index, variable in enumerate(system.action):
        values = rows.actions[:, index]
        values = values[np.isfinite(values)]
        if variable.unit == "rad" and len(values):
            largest = float(np.quantile(np.abs(values), 0.99))
            if largest > np.pi / 2.0:
                text = f"{variable.name} reaches {largest:.4g} rad: it looks like degrees, so every row was cut"
                found.append(finding("unit_mistake", text, len(rows.t), None, _DONE))
    return found


def _heading_in_degrees(rows: RawRows, system: System) -> list[Finding]:
    """Compares the direction of motion with yaw in radians and with yaw in degrees.

    agreement = |sum step exp(-i yaw)| / sum |step|: 1 if the car moves along its heading, up to a constant angle.
    """
    if not {"x", "y", "yaw"} <= set(system.state_names):
        return []
    x, y, yaw = (rows.states[:, system.state_names.index(name)] for name in ("x", "y", "yaw"))
    steps = np.diff(x) + 1j * np.diff(y)
    good = np.isfinite(steps) & np.isfinite(yaw[:-1])
    steps, yaw = steps[good], yaw[:-1][good]
    total = float(np.abs(steps).sum())
    if len(steps) < _MIN_STEPS or total == 0.0 or float(np.abs(yaw).max()) < 2.0 * np.pi:
        return []
    as_it_is = float(np.abs(np.sum(steps * np.exp(-1j * yaw)))) / total
    as_degrees = float(np.abs(np.sum(steps * np.exp(-1j * np.radians(yaw))))) / total
    if as_degrees < 0.8 or as_degrees < as_it_is + 0.3:
        return []
    text = f"yaw follows the direction of motion only when it is read as degrees (agreement {as_degrees:.2f}, "
    text += f"{as_it_is:.2f} as radians), so every row was cut"
    return [finding("unit_mistake", text, len(rows.t), None, _DONE)]
