"""Angles in degrees where radians are wanted: then no row can be used until a column map names the unit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from safedpa.records.apply_map import Rows
from safedpa.records.run import Finding
from safedpa.records.sentences import finding
from safedpa.systems import System

__all__ = ["degrees_for_radians"]

_DONE = 'name unit = "deg" in a column map'
_FEWEST_STEPS = 30


def degrees_for_radians(rows: Rows, system: System) -> tuple[NDArray[np.bool_], list[Finding]]:
    """Every row, when an angle commanded to an actuator or the heading is in degrees; before anything is unwrapped."""
    found = _commanded(rows, system) + _heading(rows, system)
    return np.full(len(rows.t), bool(found)), found


def _commanded(rows: Rows, system: System) -> list[Finding]:
    """Actions in rad beyond pi / 2: no joint and no wheel turns that far."""
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


def _heading(rows: Rows, system: System) -> list[Finding]:
    """Compares the direction of the steps with yaw as it is and with yaw taken for degrees.

    agreement = |sum step exp(-i yaw)| / sum |step|: 1 when the car moves the way it looks, up to a constant angle.
    """
    if not {"x", "y", "yaw"} <= set(system.state_names):
        return []
    x, y, yaw = (rows.states[:, system.state_names.index(name)] for name in ("x", "y", "yaw"))
    steps = np.diff(x) + 1j * np.diff(y)
    good = np.isfinite(steps) & np.isfinite(yaw[:-1])
    steps, yaw = steps[good], yaw[:-1][good]
    total = float(np.abs(steps).sum())
    if len(steps) < _FEWEST_STEPS or total == 0.0 or float(np.abs(yaw).max()) < 2.0 * np.pi:
        return []
    as_it_is = float(np.abs(np.sum(steps * np.exp(-1j * yaw)))) / total
    as_degrees = float(np.abs(np.sum(steps * np.exp(-1j * np.radians(yaw))))) / total
    if as_degrees < 0.8 or as_degrees < as_it_is + 0.3:
        return []
    text = f"yaw follows the direction of motion only when it is read as degrees (agreement {as_degrees:.2f}, "
    text += f"{as_it_is:.2f} as radians), so every row was cut"
    return [finding("unit_mistake", text, len(rows.t), None, _DONE)]
