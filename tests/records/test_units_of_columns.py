"""Factors of units compared with SciPy's table, and mistakes of units and signs that the columns give away."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import constants
from tests.records.test_quality import car_rows, judge

from safedpa.errors import ColumnMapError
from safedpa.records.column_map.units import UNITS, factor_to_si
from safedpa.records.quality.consistency import consistency_findings
from safedpa.records.run import Stretch
from safedpa.robots.car.system import CAR

SCIPY = {
    "1": 1.0, "%": constants.centi, "s": 1.0, "ms": constants.milli, "us": constants.micro, "ns": constants.nano,
    "min": constants.minute, "m": 1.0, "mm": constants.milli, "cm": constants.centi, "km": constants.kilo,
    "in": constants.inch, "ft": constants.foot, "rad": 1.0, "deg": constants.degree, "rev": 360.0 * constants.degree,
    "m/s": 1.0, "mm/s": constants.milli, "cm/s": constants.centi, "km/h": constants.kmh, "mph": constants.mph,
    "rad/s": 1.0, "deg/s": constants.degree, "rpm": 360.0 * constants.degree / constants.minute, "N m": 1.0,
    "mN m": constants.milli, "N cm": constants.centi,
}  # fmt: skip


@pytest.mark.parametrize("unit", UNITS)
def test_a_unit_has_the_factor_of_scipy_and_measures_one_quantity(unit: str) -> None:
    own = UNITS[unit].si
    assert factor_to_si(unit, own, "columns.x") == pytest.approx(SCIPY[unit], rel=1e-12)
    for other in {one.si for one in UNITS.values()} - {own}:
        with pytest.raises(ColumnMapError, match=rf"^key: got unit '{unit}', wanted one for {other}: {other}"):
            factor_to_si(unit, other, "key")


def test_an_unknown_unit_is_refused() -> None:
    with pytest.raises(ColumnMapError, match=r"^columns.x.unit: unknown unit 'metre'; "):
        factor_to_si("metre", "m", "columns.x.unit")


@pytest.mark.parametrize(
    ("factor", "phrase"),
    [
        (1.0 / constants.kmh, "km/h"), (constants.kmh, "scaled the other way"), (1.0 / constants.mph, "mph"),
        (100.0, "cm/s"), (1000.0, "mm/s"), (1.0 / constants.degree, "deg/s"), (constants.degree, "radians while"),
        (60.0 / (2.0 * np.pi), "rpm"), (0.001, "positions are in mm"), (0.01, "positions are in cm"),
    ],
)  # fmt: skip
def test_a_speed_in_another_unit_is_named(factor: float, phrase: str) -> None:
    rows = car_rows()
    scaled = replace(rows, states=rows.states * (1.0, 1.0, 1.0, factor))
    (found,) = consistency_findings(scaled, [Stretch(0, len(rows.t))], CAR, [True] * 4)
    assert found.kind == "unit_mistake"
    assert phrase in found.message


@pytest.mark.parametrize("degrees", [-150, -60, 60, 150])
def test_the_angle_of_a_turned_heading_is_reported_in_degrees(degrees: int) -> None:
    rows = car_rows()
    (found,) = judge(replace(rows, states=rows.states - np.array([0.0, 0.0, np.radians(degrees), 0.0]))).findings
    assert found.kind == "yaw_offset"
    reported = float(found.message.split("turned by ")[1].split(" degrees")[0])
    assert reported == pytest.approx(degrees, abs=3.0)
