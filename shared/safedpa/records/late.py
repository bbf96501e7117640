"""Channels that come late: a speed beside the change of position that it should be, a command beside what it does."""

from __future__ import annotations

import numpy as np

from safedpa.records.apply_map import Rows
from safedpa.records.derive import Vector, slope
from safedpa.records.held import hold_rows
from safedpa.records.run import Finding, Stretch
from safedpa.records.sentences import finding
from safedpa.systems import System

__all__ = ["late_findings"]

_LATEST = 1.0
"""s that are looked at, to either side."""
_WINDOW = 0.2
_FEWEST = 100
_SAME = 0.9
"""Correlation at the best shift, without which two channels do not say the same."""
_BETTER = 0.02
"""By which it has to be better than without a shift."""
_SEVERE = 0.15
"""s, and twice what a channel is held, from which nothing is judged before it is aligned."""
_TOLD = 0.05
"""s from which it is said at all."""


def late_findings(rows: Rows, stretches: list[Stretch], system: System, measured: list[bool]) -> list[Finding]:
    """Measured rates that come later, or earlier, than the change of what they are the rate of; nothing is cut."""
    found = []
    for name, said, seen in _pairs(rows, stretches, system, measured):
        late = _lateness(rows.t, said, seen)
        if late is None or abs(late[0]) < _TOLD:
            continue
        seconds, best, now = late
        held = hold_rows(said[np.isfinite(said)]) * _period(rows.t)
        side = "late" if seconds > 0 else "early"
        kind = "time_offset" if abs(seconds) >= max(_SEVERE, 2.0 * held) else "slightly_late"
        text = (
            f"{name} comes {abs(seconds):.2f} s {side} against the change of what it is the rate of (correlation "
            f"{best:.3f} when it is shifted, {now:.3f} as it is)"
        )
        done = f"align it with shift = {seconds:.2f} for {name} in a column map"
        found.append(finding(kind, text, done=done))
    return found


def _pairs(
    rows: Rows, stretches: list[Stretch], system: System, measured: list[bool]
) -> list[tuple[str, Vector, Vector]]:
    """(name of a measured rate, its values, the slope that it should be)."""
    names, states = system.state_names, rows.states
    if {"x", "y", "yaw", "speed"} <= set(names):
        index = names.index("speed")
        x, y, yaw = (states[:, names.index(name)] for name in ("x", "y", "yaw"))
        along = _slopes(rows.t, x, stretches) * np.cos(yaw) + _slopes(rows.t, y, stretches) * np.sin(yaw)
        return [("speed", states[:, index], along)] if measured[index] else []
    found = []
    for at, variable in enumerate(system.state):
        for index, rate in enumerate(system.state):
            if rate.unit == f"{variable.unit}/s" and measured[index] and measured[at]:
                found.append((rate.name, states[:, index], _slopes(rows.t, states[:, at], stretches)))
    return found


def _slopes(t: Vector, values: Vector, stretches: list[Stretch]) -> Vector:
    found = np.full(len(t), np.nan)
    for part in stretches:
        own = slice(part.start, part.stop)
        found[own] = slope(t[own], values[own], _WINDOW)
    return found


def _lateness(t: Vector, said: Vector, seen: Vector) -> tuple[float, float, float] | None:
    """(seconds by which ``said`` comes after ``seen``, correlation then, correlation as it is); None where unclear."""
    period = _period(t)
    if not period > 0.0:
        return None
    most = max(1, round(_LATEST / period))
    step = max(1, most // 40)
    shifts = np.unique(np.concatenate([np.arange(-most, most + 1, step), [0]]))
    values = np.array([_correlation(said, seen, int(shift)) for shift in shifts])
    best = int(np.nanargmax(values)) if np.isfinite(values).any() else -1
    if best < 0 or values[best] < _SAME:
        return None
    around = np.arange(shifts[best] - step, shifts[best] + step + 1)
    finer = np.array([_correlation(said, seen, int(shift)) for shift in around])
    top = int(np.nanargmax(finer))
    now = _correlation(said, seen, 0)
    if finer[top] < now + _BETTER or abs(around[top]) >= most:
        return None
    return float(around[top]) * period, float(finer[top]), now


def _period(t: Vector) -> float:
    """Usual seconds between rows; 0 where there are none."""
    steps = np.diff(t[np.isfinite(t)])
    return float(np.median(steps)) if len(steps) else 0.0


def _correlation(said: Vector, seen: Vector, shift: int) -> float:
    """Of said[k + shift] with seen[k]."""
    if abs(shift) > len(said) - _FEWEST:
        return float("nan")
    if shift >= 0:
        one, other = said[shift:], seen[: len(seen) - shift]
    else:
        one, other = said[:shift], seen[-shift:]
    good = np.isfinite(one) & np.isfinite(other)
    if good.sum() < _FEWEST or not (np.ptp(one[good]) > 0 and np.ptp(other[good]) > 0):
        return float("nan")
    return float(np.corrcoef(one[good], other[good])[0, 1])
