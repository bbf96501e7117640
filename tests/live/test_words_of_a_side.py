"""The side that words name is where errors are large, whatever their signs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from safedpa.live.forecasts import Forecast
from safedpa.live.watch import Band, place_in_words


def forecast(yaw_error: float, speed: float) -> Forecast:
    began = np.array([0.0, 0.0, 0.0, speed])
    measured = began + np.array([speed, 0.0, 0.0, 0.0])
    return Forecast(
        0, 20, began, measured, measured - np.array([0.0, 0.0, yaw_error, 0.0]), np.array([1.0, 0.0]), np.ones(2)
    )


def words(car, slow: Sequence[float], fast: Sequence[float]) -> str:
    band = Band(scale=np.ones(4), usual=np.ones(2), edges=np.full(4, 0.01), error=0.1)
    seen = [forecast(error, 0.5) for error in slow] + [forecast(error, 1.5) for error in fast]
    return place_in_words(car.system, band, seen, 1.0)


@pytest.mark.parametrize(("one", "other"), [(1, 1), (1, -1), (-1, 1), (-1, -1)], ids=str)
@pytest.mark.parametrize("large_when", ["slow", "fast"])
def test_the_signs_of_the_errors_have_no_say(car, one, other, large_when):
    """Errors of 0.3 rad on one side of 1 m/s and of 0.05 rad on the other; on each side they turn as they like."""
    large, small = [0.3 * one, 0.3 * other] * 4, [0.05 * other, 0.05 * one] * 4
    told = words(car, large, small) if large_when == "slow" else words(car, small, large)
    assert told.startswith("yaw: ")
    assert told.endswith(f"speed is {'below' if large_when == 'slow' else 'above'} 1 m/s")


def test_errors_alike_on_both_sides_name_none(car):
    assert "most where" not in words(car, [0.2, -0.2] * 4, [-0.2, 0.2] * 4)
