"""The band learned from errors knows no side: what is too low by as much is as far outside."""

from __future__ import annotations

import numpy as np
import pytest

from safedpa.live.forecasts import Forecast, channel_errors
from safedpa.live.watch import learned_band


def forecasts(sign: float, count: int = 40) -> list[Forecast]:
    """Straight drives whose predictions are off to one side by up to 0.2 in each channel, each by another amount."""
    random = np.random.default_rng(2)
    sizes = 0.02 + 0.18 * random.uniform(0.0, 1.0, (count, 4))
    made = []
    for start, size in enumerate(sizes):
        began = np.array([0.0, 0.0, 0.0, 1.0])
        measured = np.array([1.0 + 0.01 * start, 0.0, 0.0, 1.0 + 0.02 * (start % 5)])
        made.append(Forecast(start, start + 20, began, measured, measured - sign * size, np.zeros(2), np.ones(2)))
    return made


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_edges_hold_every_error_that_taught_them_with_half_as_much_to_spare(car, sign):
    """Errors of one sign, as a slow servo or a tail wind makes them: none of them may look like a new fault."""
    seen = forecasts(sign)
    band = learned_band(car.system, seen)
    largest = max(np.abs(channel_errors(car.system, item)).max() for item in seen)
    assert largest > 0.1
    ratios = np.array([band.ratios(car.system, item) for item in seen])
    assert (ratios <= 1.0 / 1.5 + 1e-9).all()


def test_errors_to_the_other_side_teach_the_same_band(car):
    scale = np.full(4, 0.5)
    low, high = (learned_band(car.system, forecasts(sign), scale) for sign in (-1.0, 1.0))
    np.testing.assert_allclose(low.edges, high.edges)
    assert low.error == pytest.approx(high.error)
