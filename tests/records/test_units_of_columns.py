"""Factors of units against a table that is not ours, and mistakes of units in a speed by the words that name them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import constants
from tests.records.test_quality import car_rows, judge

from safedpa.records.consistency import _scale
from safedpa.records.units import UNITS, factor_to_si

SCIPY = {
    "1": 1.0, "%": constants.centi, "s": 1.0, "ms": constants.milli, "us": constants.micro, "ns": constants.nano,
    "min": constants.minute, "m": 1.0, "mm": constants.milli, "cm": constants.centi, "km": constants.kilo,
    "in": constants.inch, "ft": constants.foot, "rad": 1.0, "deg": constants.degree, "rev": 360.0 * constants.degree,
    "m/s": 1.0, "mm/s": constants.milli, "cm/s": constants.centi, "km/h": constants.kmh, "mph": constants.mph,
    "rad/s": 1.0, "deg/s": constants.degree, "rpm": 360.0 * constants.degree / constants.minute, "N m": 1.0,
    "mN m": constants.milli, "N cm": constants.centi,
}  # fmt: skip


@pytest.mark.parametrize("unit", UNITS)
def test_a_factor_is_that_of_scipys_table(unit: str) -> None:
    assert factor_to_si(unit, UNITS[unit].si, "columns.x") == pytest.approx(SCIPY[unit], rel=1e-12)


@pytest.mark.parametrize(
    ("shown", "words"),
    [
        (1.0 / constants.kmh, "km/h"), (constants.kmh, "scaled the other way"), (1.0 / constants.mph, "mph"),
        (100.0, "cm/s"), (1000.0, "mm/s"), (1.0 / constants.degree, "deg/s"), (constants.degree, "radians while"),
        (60.0 / (2.0 * np.pi), "rpm"), (0.001, "positions are in mm"), (0.01, "positions are in cm"),
    ],
)  # fmt: skip
def test_a_speed_that_is_so_many_times_too_large_has_its_unit_named(shown: float, words: str) -> None:
    moved = np.linspace(0.5, 3.0, 200)
    (found,) = _scale("speed", "position", shown * moved, moved)
    assert found.kind == "unit_mistake"
    assert words in found.message


@pytest.mark.parametrize("degrees", [-150, -60, 60, 150])
def test_a_heading_that_is_turned_is_told_by_how_many_degrees(degrees: int) -> None:
    rows = car_rows()
    (found,) = judge(replace(rows, states=rows.states - np.array([0.0, 0.0, np.radians(degrees), 0.0]))).findings
    assert found.kind == "yaw_offset"
    told = float(found.message.split("turned by ")[1].split(" degrees")[0])
    assert told == pytest.approx(degrees, abs=3.0)
