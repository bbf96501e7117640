"""Operations on all cells of a grid at once, compared with the same for each cell."""

from __future__ import annotations

import numpy as np
import pytest

from safedpa.perception.grid import CELL, Grid, disc_offsets, grown, shrunk


def _flag(cells: np.ndarray, i: int, j: int, beyond: bool) -> bool:
    inside = 0 <= i < len(cells) and 0 <= j < len(cells)
    return bool(cells[i, j]) if inside else beyond


@pytest.mark.parametrize("beyond", [False, True])
@pytest.mark.parametrize("radius", [0.0, 0.1, 0.15, 0.2, 0.25, 0.3, 0.42, 1.3])
@pytest.mark.parametrize("size", [1, 2, 5, 9])
def test_cells_grow_by_a_disc(size: int, radius: float, beyond: bool) -> None:
    draw = np.random.default_rng([size, int(100 * radius)])
    for share in (0.0, 0.1, 0.9, 1.0):
        cells = draw.uniform(size=(size, size)) < share
        before = cells.copy()
        wanted = [
            [any(_flag(cells, i + a, j + b, beyond) for a, b, _ in disc_offsets(radius)) for j in range(size)]
            for i in range(size)
        ]
        found = grown(cells, radius, beyond=beyond)
        assert found.dtype == np.bool_
        np.testing.assert_array_equal(found, wanted)
        np.testing.assert_array_equal(shrunk(~cells, radius, beyond=not beyond), ~found)
        found[:] = True  # the result is a copy
        np.testing.assert_array_equal(cells, before)


def test_the_middles_move_with_the_grid_and_are_read_only() -> None:
    grid = Grid(0.3, 0.0, 0.0)
    x, y = grid.middles
    assert grid.middles[0] is x
    with pytest.raises(ValueError, match="read-only"):
        x[0, 0] = 1.0
    grid.move((2, -1))
    np.testing.assert_allclose(grid.middles[0], x + 2 * CELL, atol=1e-12)
    np.testing.assert_allclose(grid.middles[1], y - CELL, atol=1e-12)
