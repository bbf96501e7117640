"""Recognises what the columns of a table are: time, commands, measured states, and pairs of position and rate."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.records.column_map.form import is_time, unit_named
from safedpa.records.column_map.propose import COMMANDED
from safedpa.records.column_map.units import UNITS, join_units

__all__ = [
    "LoggedColumn", "PlanarMotion", "changes", "is_command", "logged_column", "planar_motion", "rate_pairs",
    "time_column",
]  # fmt: skip

_COMMAND_PARTS = {
    "throttle", "motor", "duty", "torque", "tau", "effort", "current", "voltage", "pump", "valve", "thrust", "rudder",
    "steer", "steering", "force", "pwm", "u", "input", "servo", "brake", "power", "i", "cmd", "ref",
}  # fmt: skip
"""Parts of the names of columns with commands."""
_UNIT_PARTS: Mapping[str, str] = {
    "rad/s": "rate omega dq qd gyro wx wy wz w yawrate spin turn r",
    "m/s": "v vx vy vz vel velo velocity speed surge sway heave",
    "rad": "angle theta q yaw pitch roll heading psi phi joint steer steering delta rudder",
    "m": "x y z pos position level height depth",
    "A": "current i", "V": "voltage pump", "N": "force", "N m": "torque tau effort",
}  # fmt: skip
"""Usual unit of a quantity by a part of its name; the first unit with a matching part is taken."""
_HELD = 0.5
"""Share of equal neighbouring values from which a column is piecewise constant, as a command is."""
_JUMP = 0.05
"""Least size of the usual jump of a command, as a share of its range: a quantised measurement moves in small steps."""
_SPANS = (2, 4, 8, 16, 32)
"""Rows over which changes are compared: more of them average noise, fewer follow quick changes."""
_LEAST_FIT, _GAINS = 0.9, (0.85, 1.15)
"""Share of the changes that a rate must explain, and the gain with which it must do so."""


@dataclass(frozen=True)
class LoggedColumn:
    """One quantity: ``name`` in the model, ``source`` in the log, ``unit`` there (empty: SI), ``si`` and SI values."""

    name: str
    source: str
    unit: str
    si: str
    values: FloatArray

    def with_si(self, si: str) -> LoggedColumn:
        """The column with another SI unit, unless its name in the log has a unit."""
        return self if self.unit else replace(self, si=si)


def logged_column(source: str, values: FloatArray, name: str = "") -> LoggedColumn:
    """The column ``source`` in SI units; without ``name`` it is named as in the log, without unit."""
    unit = unit_named(source)
    parts = join_units(re.sub(r"[^a-z0-9]+", " ", re.sub(r"([a-z])([A-Z])", r"\1 \2", source).lower())).split()
    ending = {"deg", "degrees", "ms", "mm", "cm", "kmh", "mps", "rpm", "dps", "nm", unit} if unit else set()
    plain = [part for index, part in enumerate(parts) if not (index and part in ending)] or ["column"]
    own = re.sub(r"^(?=\d)", "c", name or "_".join(plain))
    bare = {re.sub(r"\d+$", "", part) for part in own.split("_")}
    guessed = next((si for si, known in _UNIT_PARTS.items() if bare & set(known.split())), "1")
    if not unit:
        return LoggedColumn(own, source, "", guessed, values)
    return LoggedColumn(own, source, unit, UNITS[unit].si, UNITS[unit].factor * values)


def time_column(columns: Mapping[str, FloatArray]) -> str:
    """The column with the time: by its name, or the first that never decreases; empty if there is none."""
    named = [name for name in columns if is_time(name)]
    growing = [name for name, values in columns.items() if len(values) > 1 and bool(np.all(np.diff(values) > 0.0))]
    return next(iter([*named, *growing]), "")


def is_command(column: LoggedColumn) -> bool:
    """Whether a column is a command: by its name, or because it is constant between jumps."""
    parts = {re.sub(r"\d+$", "", part) for part in column.name.split("_")}
    if COMMANDED.search(column.source) or parts & _COMMAND_PARTS:
        return True
    steps = np.abs(np.diff(column.values))
    jumps = steps[steps > 0.0]
    return bool(len(jumps) and len(jumps) < (1.0 - _HELD) * len(steps) and np.median(jumps) > _JUMP * _range(column))


def _range(column: LoggedColumn) -> float:
    return float(np.ptp(column.values))


def rate_pairs(t: FloatArray, columns: Sequence[LoggedColumn]) -> dict[str, str]:
    """Names of the rates by the names of the columns whose slope they are; a column is in one pair at most."""
    scored = []
    for position in columns:
        for rate in columns:
            fit, gain = max(
                (_fit(changes(t, position.values, span)[0], changes(t, rate.values, span)[1]) for span in _SPANS),
                default=(0.0, 0.0),
            )
            if position is not rate and fit > _LEAST_FIT and _GAINS[0] < gain < _GAINS[1]:
                scored.append((fit, position.name, rate.name))
    pairs: dict[str, str] = {}
    for _, position_name, rate_name in sorted(scored, reverse=True):
        if not {position_name, rate_name} & {*pairs, *pairs.values()}:
            pairs[position_name] = rate_name
    return pairs


def changes(t: FloatArray, values: FloatArray, span: int) -> tuple[FloatArray, FloatArray]:
    """Changes of a column over every ``span`` rows, and its integrals over the same rows (trapezoidal rule)."""
    areas = np.concatenate([[0.0], np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(t))])
    return values[span:] - values[:-span], areas[span:] - areas[:-span]


def _fit(changed: FloatArray, area: FloatArray) -> tuple[float, float]:
    """Share of the changes that the area explains, and its gain."""
    power, total = float(area @ area), float(changed @ changed)
    if power <= 0.0 or total <= 0.0:
        return 0.0, 0.0
    gain = float(area @ changed) / power
    rest = changed - gain * area
    return 1.0 - float(rest @ rest) / total, gain


@dataclass(frozen=True)
class PlanarMotion:
    """Names of the columns of a body on a plane: position on the floor, heading, and velocities in its own frame."""

    x: str
    y: str
    yaw: str
    forward: str
    lateral: str = ""
    """Velocity to the left; empty if there is none."""


def planar_motion(t: FloatArray, columns: Sequence[LoggedColumn]) -> PlanarMotion | None:
    """The columns with x' = v cos(yaw) - w sin(yaw) and y' = v sin(yaw) + w cos(yaw), or None.

    They must explain 90 % of the changes of x and y, in their units; w is left out where it explains little.
    """
    positions, angles, speeds = (
        [item for item in columns if item.si == unit][:_MOST_TRIED] for unit in ("m", "rad", "m/s")
    )
    best, found = _LEAST_FIT, None
    for x, y in permutations(positions, 2):
        for yaw, forward in product(angles, speeds):
            for lateral in (None, *(item for item in speeds if item is not forward)):
                fit = _planar_fit(t, x.values, y.values, yaw.values, forward.values, lateral)
                # a lateral velocity has to explain a fifth of what remains without it
                if (1.0 - fit) < (1.0 if lateral is None else _LATERAL) * (1.0 - best):
                    best = fit
                    found = PlanarMotion(x.name, y.name, yaw.name, forward.name, lateral.name if lateral else "")
    return found


_MOST_TRIED, _LATERAL = 4, 0.8
"""Columns of one unit that are tried, and the share of the rest that may remain with a lateral velocity."""


def _planar_fit(
    t: FloatArray, x: FloatArray, y: FloatArray, yaw: FloatArray, forward: FloatArray, lateral: LoggedColumn | None
) -> float:
    side = np.zeros_like(forward) if lateral is None else lateral.values
    cos, sin = np.cos(yaw), np.sin(yaw)
    fits = []
    for span in _SPANS:
        rest, total = 0.0, 0.0
        for position, velocity in ((x, cos * forward - sin * side), (y, sin * forward + cos * side)):
            changed, area = changes(t, position, span)[0], changes(t, velocity, span)[1]
            rest, total = rest + float(((changed - area) ** 2).sum()), total + float((changed**2).sum())
        fits.append(1.0 - rest / total if total > 0.0 else 0.0)
    return max(fits)
