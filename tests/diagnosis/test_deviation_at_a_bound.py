"""The one-sided deviation at a bound, by hand and by the squares themselves: profile likelihood."""

from __future__ import annotations

import numpy as np
import pytest

from safedpa.diagnosis.fit.least_squares import Fit
from safedpa.dynamics import Setting, load_model
from safedpa.effects import effect


def at_a_bound(columns: list[float], residual: list[float]) -> Fit:
    """A fit of a drag of 0, by these slopes and residuals in units of the noise (windows,)."""
    model = load_model("car").with_effect(effect("car", "viscous_drag"), {"coefficient": Setting(0.0)})
    slopes, left = np.array(columns)[:, None, None], np.array(residual)[:, None]
    return Fit(
        model, ("viscous_drag.coefficient",), 0.0, np.ones(1), left, slopes, slopes[..., None, :],
        np.array([False]), (np.zeros((1, 1)), np.zeros(1)),
    )  # fmt: skip


def deviation(fit: Fit) -> float:
    return float(fit._at_bounds()[0])


def test_by_hand() -> None:
    """g = 4 x 3 = 12, h = 16: 2 x 12 d + 16 d^2 = 1, so d = (sqrt(144 + 16) - 12) / 16."""
    assert deviation(at_a_bound([4.0], [3.0])) == pytest.approx((160**0.5 - 12.0) / 16.0)


def test_without_a_slope_it_is_the_deviation_of_a_line() -> None:
    """Columns across the residual: 1 / sqrt(sum of squares)."""
    assert deviation(at_a_bound([3.0, 4.0], [4.0, -3.0])) == pytest.approx(1.0 / 5.0)


@pytest.mark.parametrize("seed", range(5))
def test_over_it_the_squares_grow_by_one(seed: int) -> None:
    random = np.random.default_rng(seed)
    columns, residual = random.normal(0.0, 5.0, 40), random.normal(0.0, 2.0, 40)
    far = deviation(at_a_bound(columns.tolist(), residual.tolist()))
    away = np.sign(columns @ residual) * columns  # into the side on which the squares grow
    assert ((residual + far * away) ** 2).sum() - (residual**2).sum() == pytest.approx(1.0)


def test_the_steeper_the_squares_rise_the_surer_the_bound() -> None:
    found = [deviation(at_a_bound([4.0, 1.0], [slope, 0.0])) for slope in (0.0, 0.5, 2.0, 8.0)]
    assert found == sorted(found, reverse=True)
    assert found[-1] < 0.1 * found[0]


def test_data_that_say_nothing_tell_no_number() -> None:
    assert np.isnan(deviation(at_a_bound([0.0], [3.0])))
