"""The slope of every operation that an equation may use, over plain numbers and over arrays, beside dual numbers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from tests.safety.dual_numbers import DUALS, Dual, dual

from safedpa.equations.given import Given
from safedpa.equations.many_rows import ManyRows
from safedpa.equations.plain_rows import plain_rows
from safedpa.equations.rows import RowGroup, RowTape
from safedpa.operations import Operations

POINTS = [(0.3, -0.7), (-0.4, 0.9), (1.2, 1.2), (0.0, 0.5), (0.5, 0.0), (-1.0, 1.0), (0.0, 0.0), (2.0, -3.0)]
FORMS: dict[str, Callable[[Any, Any, Any, Operations], Any]] = {
    "sum": lambda x, y, e, o: x + y + e,
    "difference": lambda x, y, e, o: e - x - y,
    "product": lambda x, y, e, o: x * y * e,
    "quotient": lambda x, y, e, o: (x + e) / (y * y + 1.0),
    "under a constant": lambda x, y, e, o: 2.0 / (x * x + e * e) - y,
    "square": lambda x, y, e, o: x**2 * e + (+y) ** 2.0,
    "sign of both": lambda x, y, e, o: -x * e - (-y),
    "sin": lambda x, y, e, o: o.sin(x * e + y),
    "cos": lambda x, y, e, o: o.cos(x * e) * o.sin(x * e) + y,
    "tan": lambda x, y, e, o: o.tan(0.3 * x) * e + o.tan(0.1 * y),
    "atan": lambda x, y, e, o: o.atan(x * y + e),
    "tanh": lambda x, y, e, o: o.tanh(x - e * y),
    "exp": lambda x, y, e, o: o.exp(0.5 * x + e * y),
    "sqrt": lambda x, y, e, o: o.sqrt(x * x + y * y + e * e),
    "absolute": lambda x, y, e, o: o.absolute(x - e) + o.absolute(y + 0.1),
    "sign": lambda x, y, e, o: o.sign(x + 0.01) * y + e,
    "minimum": lambda x, y, e, o: o.minimum(x, y) * e + o.minimum(e, x),
    "maximum": lambda x, y, e, o: o.maximum(x, y) * e + o.maximum(y, e),
    "clip": lambda x, y, e, o: o.clip(x, y - 3.0, e) + o.clip(e, x, 5.0),
    "where": lambda x, y, e, o: o.where(x < y, x * e, o.where(y >= 0.5, y, -y)) + o.where(x != y, y, x),
    "hypot": lambda x, y, e, o: o.hypot(x, y) + o.hypot(x - e, 2.0 * y),
    "of the state alone": lambda x, y, e, o: o.sin(x) * y,
    "of neither": lambda x, y, e, o: e + 0.0 * e,
}
EACH = (0.5, 1.5)


def recorded(form: Callable[[Any, Any, Any, Operations], Any]) -> RowTape:
    def equation(given: Given, operations: Operations) -> Sequence[Any]:
        x, y = given.state
        return form(x, y, given.each[0], operations), form(y, x, given.shared[0] * given.each[0], operations)

    return RowTape(2, [RowGroup(equation, 1, 1)])


def by_dual_numbers(form: Callable[..., Any], point: Sequence[float], shared: float) -> tuple[Any, Any]:
    h, slopes = [], []
    for each in EACH:
        for turned, number in ((False, each), (True, shared * each)):
            found = []
            for nudged in range(2):
                x, y = (Dual(value, float(index == nudged)) for index, value in enumerate(point))
                found.append(dual(form(y, x, number, DUALS) if turned else form(x, y, number, DUALS)))
            h.append(found[0].value)
            slopes.append([entry.slope for entry in found])
    return np.array(h), np.array(slopes)


@pytest.mark.parametrize("name", FORMS)
def test_values_and_slopes_are_those_of_dual_numbers(name: str) -> None:
    tape, shared = recorded(FORMS[name]), 0.7
    rows = plain_rows(tape)(((shared,),), (tuple((each,) for each in EACH),))
    many, robots = ManyRows(tape), len(POINTS)
    columns = [[np.full((robots, 1), shared)]], [[np.tile(EACH, (robots, 1))]]
    values, slopes = many.heights(np.array(POINTS), *columns), many.slopes(np.array(POINTS), *columns)
    for index, point in enumerate(POINTS):
        h, expected = by_dual_numbers(FORMS[name], point, shared)
        assert rows.heights(point) == pytest.approx(h, abs=1e-14)
        np.testing.assert_allclose(rows.slopes(point, range(4)), expected, rtol=1e-13, atol=1e-14)
        np.testing.assert_allclose(rows.slopes(point, [3, 1]), expected[[3, 1]], rtol=1e-13, atol=1e-14)
        np.testing.assert_allclose(values[index], h, rtol=0.0, atol=1e-14)
        np.testing.assert_allclose(slopes[index], expected, rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize("form", [lambda x, y, e, o: x**3, lambda x, y, e, o: x**y])
def test_a_power_without_a_rule_is_refused_and_never_level(form: Callable[..., Any]) -> None:
    with pytest.raises(KeyError, match="exponent"):
        plain_rows(recorded(form))


def test_pythons_own_absolute_value_has_a_slope_as_well() -> None:
    rows = plain_rows(recorded(lambda x, y, e, o: abs(x)))(((1.0,),), (((1.0,),),))
    assert rows.slopes((-2.0, 3.0), range(2)) == [(-1.0, 0.0), (0.0, 1.0)]
    assert rows.slopes((0.0, 0.0), range(2)) == [(0.0, 0.0), (0.0, 0.0)]


def test_groups_with_the_same_body_share_what_they_compute() -> None:
    def reach(given: Given, operations: Operations) -> Sequence[Any]:
        return (operations.sin(given.state[0]) * given.shared[0] - given.each[0],)

    alone = RowTape(1, [RowGroup(reach, 1, 1)])
    both = RowTape(1, [RowGroup(reach, 1, 1), RowGroup(reach, 1, 1, body=0)])
    apart = RowTape(1, [RowGroup(reach, 1, 1), RowGroup(reach, 1, 1)])
    assert len(both.of("state", [name for names in both.results for name in names])) == 2
    assert len(apart.of("state", [name for names in apart.results for name in names])) == 3
    assert alone.steepest is None
    rows = plain_rows(both)(((2.0,), ()), (((1.0,),), ((3.0,), (4.0,))))
    assert rows.heights([0.0]) == [-1.0, -3.0, -4.0]
    assert rows.steepest([0.0]) is None
