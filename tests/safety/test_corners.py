"""A corner of two actions' range is told where it is the minimiser, whatever slack costs, and nowhere else."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from safedpa.safety.program_rows import ScaledRow, cornered

SIDES = ((-1.0, 3.0, 4.0), (0.5, 2.5, 2.0))
CLOSE = np.array([0.0, 1e-6, 1e-4, 0.01, *np.linspace(0.05, 0.95, 10), 0.99, 1.0 - 1e-4, 1.0 - 1e-6, 1.0])
GRID = np.array([(x, y) for x in CLOSE for y in CLOSE])
CORNERS = np.array([(0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0)])


def cost(
    points: Any, rows: list[ScaledRow], wish: Any, weights: Any, prices: tuple[float, float]
) -> NDArray[np.float64]:
    """Of points (n, 2) of the unit square, as the program has it."""
    wanted = (np.array(wish) - [low for low, _, _ in SIDES]) / [width for _, _, width in SIDES]
    found = ((points - wanted) ** 2) @ np.array(weights)
    for slopes, limit, _, _ in rows:
        slack = np.maximum(0.0, limit - points @ np.array(slopes))
        found = found + prices[0] * slack + prices[1] * slack**2
    return np.asarray(found)


@pytest.mark.parametrize("prices", [(0.5, 0.7), (3.0, 0.1), (0.1, 5.0), (1e4, 1e5)])
@pytest.mark.parametrize("count", [0, 1, 3])
def test_a_corner_is_told_where_no_other_action_costs_less(prices: tuple[float, float], count: int) -> None:
    random, told = np.random.default_rng(count), [0, 0]
    for _ in range(150):
        slopes, limits = random.normal(size=(count, 2)), random.normal(0.5, 1.0, count)
        rows = [(a, float(b), index, 1.0) for index, (a, b) in enumerate(zip(slopes.tolist(), limits, strict=True))]
        wish, weights = random.uniform((-5.0, -1.0), (7.0, 4.0)).tolist(), random.uniform(0.2, 3.0, 2).tolist()
        corner = cornered(rows, wish, SIDES, weights, *prices)  # type: ignore[arg-type]
        elsewhere = cost(GRID, rows, wish, weights, prices).min()  # type: ignore[arg-type]
        told[corner is not None] += 1
        if corner is None:
            assert elsewhere < cost(CORNERS, rows, wish, weights, prices).min()  # type: ignore[arg-type]
        else:
            assert cost(np.array([corner]), rows, wish, weights, prices)[0] <= elsewhere + 1e-9  # type: ignore[arg-type]
    assert min(told) > 10
