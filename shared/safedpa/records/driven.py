"""Does the robot do what its drive is told? A throttle, target speed or torque with the wrong sign."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from safedpa.records.apply_map import Rows
from safedpa.records.derive import Vector, slope
from safedpa.records.run import Finding, Stretch
from safedpa.records.sentences import finding
from safedpa.systems import System

__all__ = ["drive_findings"]

_DRIVES = {"throttle": "speed", "target_speed": "speed", "torque": "rate"}
"""Actions, and the state that grows with them."""
_WINDOW = 0.2
_LATEST = 0.5
"""s by which the robot may follow."""
_FEWEST = 100
_AGAINST = 0.5
"""Partial correlation from which it certainly goes against the command."""
_CLEAR = 0.3
"""Partial correlation from which a delay shows anything."""


def drive_findings(rows: Rows, stretches: list[Stretch], system: System) -> list[Finding]:
    """Actions that slow down what they should drive: d(state)/dt on action, state and constant; nothing is cut.

    The action is correlated with what the rest leaves, at delays of up to half a second. Drags, gains, lags and loads
    change the size, and never the sign.
    """
    found = []
    for index, variable in enumerate(system.action):
        driven = _DRIVES.get(variable.name)
        if driven not in system.state_names:
            continue
        value = _partial(rows, stretches, rows.actions[:, index], system, driven)
        if value < -_AGAINST:
            text = f"{driven} falls as {variable.name} rises (correlation {value:.2f} beside what else drives it)"
            done = f"flip {variable.name} in a column map"
            found.append(finding("opposite_sign", text, done=done))
    return found


def _partial(rows: Rows, stretches: list[Stretch], action: Vector, system: System, driven: str) -> float:
    """Partial correlation of the slope of a state with an earlier action, of the sign that shows first."""
    at = system.state_names.index(driven)
    slopes = np.full(len(rows.t), np.nan)
    for part in stretches:
        own = slice(part.start, part.stop)
        slopes[own] = slope(rows.t[own], rows.states[own, at], _WINDOW)
    angles = [np.sin(rows.states[:, index]) for index, item in enumerate(system.state) if item.angle]
    beside = np.column_stack([rows.states[:, at], np.ones(len(rows.t)), *angles])
    steps = np.diff(rows.t[np.isfinite(rows.t)])
    period = float(np.median(steps)) if len(steps) else 1.0
    most = max(0, round(_LATEST / max(period, 1e-6)))
    values = [_beside(slopes, action, beside, shift) for shift in range(0, most + 1, max(1, most // 10))]
    # what comes late by half a swing goes against anything: the first delay at which anything shows has the sign
    first = next((value for value in values if abs(value) > _CLEAR), 0.0)
    return min(values) if first < 0.0 else max(first, 0.0)


def _beside(slopes: Vector, action: Vector, beside: NDArray[np.float64], shift: int) -> float:
    """Partial correlation of slopes[k + shift] with action[k] beside some columns (rows, columns) at k + shift."""
    count = len(slopes) - shift
    if count < _FEWEST:
        return 0.0
    wanted, command, columns = slopes[shift:], action[:count], beside[shift:]
    good = np.isfinite(wanted) & np.isfinite(command) & np.isfinite(columns).all(axis=1)
    if good.sum() < _FEWEST or not np.ptp(command[good]) > 1e-9:
        return 0.0
    both = np.column_stack([wanted[good], command[good]])
    left = both - columns[good] @ np.linalg.lstsq(columns[good], both, rcond=None)[0]
    size = float(np.sqrt((left[:, 0] ** 2).sum() * (left[:, 1] ** 2).sum()))
    return float(left[:, 0] @ left[:, 1]) / size if size > 1e-12 else 0.0
