"""Units that a column map may name, with their factors to SI units and radians."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from safedpa.errors import ColumnMapError, did_you_mean

__all__ = ["UNITS", "Unit", "factor_to_si", "join_units"]


@dataclass(frozen=True)
class Unit:
    """A unit: value in ``si`` = ``factor`` * value in this unit."""

    factor: float
    si: str


_SPEED = "m/s"
UNITS: dict[str, Unit] = {
    "1": Unit(1.0, "1"),
    "%": Unit(0.01, "1"),
    "s": Unit(1.0, "s"),
    "ms": Unit(1e-3, "s"),
    "us": Unit(1e-6, "s"),
    "ns": Unit(1e-9, "s"),
    "min": Unit(60.0, "s"),
    "m": Unit(1.0, "m"),
    "mm": Unit(1e-3, "m"),
    "cm": Unit(1e-2, "m"),
    "km": Unit(1e3, "m"),
    "in": Unit(0.0254, "m"),
    "ft": Unit(0.3048, "m"),
    "rad": Unit(1.0, "rad"),
    "deg": Unit(math.pi / 180.0, "rad"),
    "rev": Unit(2.0 * math.pi, "rad"),
    "m/s": Unit(1.0, _SPEED),
    "mm/s": Unit(1e-3, _SPEED),
    "cm/s": Unit(1e-2, _SPEED),
    "km/h": Unit(1.0 / 3.6, _SPEED),
    "mph": Unit(0.44704, _SPEED),
    "rad/s": Unit(1.0, "rad/s"),
    "deg/s": Unit(math.pi / 180.0, "rad/s"),
    "rpm": Unit(2.0 * math.pi / 60.0, "rad/s"),
    "N m": Unit(1.0, "N m"),
    "mN m": Unit(1e-3, "N m"),
    "N cm": Unit(1e-2, "N m"),
}
"""Every unit by its name."""


def join_units(name: str) -> str:
    """Joins the parts of compound units: ``speed m s`` and ``speed m per sec`` become ``speed m/s``.

    Column names cannot contain a slash in many tools, and without the join ``v_m_s`` would be read as metres.
    """
    rates = re.sub(r"\b(mm|cm|m|rad|deg) (?:per )?s(?:ec)?\b", r"\1/s", name)
    speeds = re.sub(r"\bkm (?:per )?h\b", "km/h", rates)
    return re.sub(r"\b(torque|effort|tau|moment) n m\b", r"\1 nm", speeds)  # not pos_n_m, a position to the north


def factor_to_si(unit: str, wanted: str, key: str) -> float:
    """Returns the factor from ``unit`` to the SI unit ``wanted``.

    Raises ColumnMapError that names ``key`` if the unit is unknown or measures another quantity.
    """
    if unit not in UNITS:
        raise ColumnMapError(f"{key}: unknown unit '{unit}'; {did_you_mean(unit, UNITS)}")
    found = UNITS[unit]
    if found.si != wanted:
        fitting = [name for name, other in UNITS.items() if other.si == wanted]
        raise ColumnMapError(f"{key}: got unit '{unit}', wanted one for {wanted}: {', '.join(fitting)}")
    return found.factor
