"""What comes in is taken or refused alike, by whichever road it is read."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from safedpa.safety.inputs import Plausible, Unusable, checked_input

NAMES = ("a", "b", "c", "d", "e")
BELIEVED = Plausible(np.array([-1.0, -2.0, -3.0, -4.0, -5.0]), np.array([1.0, 2.0, 3.0, 4.0, 5.0]), NAMES)
ROADS = {
    "array": np.array,
    "list": list,
    "tuple": tuple,
    "single precision": lambda values: np.array(values, dtype=np.float32),
    "mixed": lambda values: [np.float64(values[0]), *values[1:]],
}


@pytest.mark.parametrize("road", ROADS)
def test_the_entry_that_is_out_of_its_range_is_named_and_what_is_no_number_is_not(road: str) -> None:
    made: Any = ROADS[road]
    assert checked_input("state", made([1.0, -2.0, 3.0, -4.0, 5.0]), BELIEVED) == (1.0, -2.0, 3.0, -4.0, 5.0)
    assert checked_input("state", made([0.5] * 3), None) == (0.5,) * 3
    for entry, name in enumerate(NAMES):
        for side in (-1.0, 1.0):
            values = [0.0] * 5
            values[entry] = side * (entry + 1.5)
            told = checked_input("state", made(values), BELIEVED)
            assert isinstance(told, Unusable)
            assert f" {name} = {values[entry]:g}, wanted {-entry - 1:g} to {entry + 1:g}" in told.reason
        for number in (np.nan, np.inf, -np.inf):
            values = [9.0] * 5
            values[entry] = number
            assert checked_input("state", made(values), BELIEVED) == Unusable("state holds NaN or infinity")


@pytest.mark.parametrize("value", [np.array(1.0), np.zeros((5, 5)), np.zeros((1, 5)), np.zeros(4), [0.0] * 6, []])
def test_another_shape_is_refused_and_reported(value: Any) -> None:
    told = checked_input("state", value, BELIEVED)
    assert told == Unusable(f"state has shape {np.shape(value)}, wanted (5,)")
