"""Parts of perception that treat many cells at once, compared with the same for each cell."""

from dataclasses import replace
from math import hypot, inf, pi

import numpy as np
import pytest
from tests.sensing.test_sensed_far import state_of

from safedpa.perception.occlusion import _FRONT_STEP, _advance_front
from safedpa.perception.occupancy_grid import CELL, Grid
from safedpa.perception.scan import _roll, _within_a_turn, within_body
from safedpa.perception.surroundings import _own_cells


def test_the_front_goes_from_each_cell_to_each_other_at_its_pace() -> None:
    draw = np.random.default_rng(3)
    start = np.where(draw.uniform(size=(9, 9)) < 0.6, draw.uniform(0.0, 5.0, (9, 9)), inf)
    start[2, 3] = -inf
    shown = np.where(draw.uniform(size=(9, 9)) < 0.6, draw.uniform(0.0, 5.0, (9, 9)), -inf)
    found = _advance_front(start, shown, 1.5)
    near = [(i, j) for i in range(-3, 4) for j in range(-3, 4) if CELL * hypot(i, j) <= _FRONT_STEP + 1e-9]
    for i in range(9):
        for j in range(9):
            begins = []
            for a, b in near:
                inside = 0 <= i + a < 9 and 0 <= j + b < 9
                there = start[i + a, j + b] if inside else -inf
                begins.append(max(there, shown[i, j]) + CELL * hypot(a, b) / 1.5)
            assert found[i, j] == min(begins)


def test_angles_come_within_a_turn_to_the_last_bit() -> None:
    draw, turn = np.random.default_rng(5), 2.0 * pi
    edges = np.array([0.0, -0.0, -turn, turn, np.nextafter(turn, 0.0), np.nextafter(0.0, -1.0), -1e-300])
    for most in (turn, 2.0 * turn - 1e-9, 40.0):
        angles = np.concatenate([draw.uniform(-min(most, turn), most, 2000), edges])
        np.testing.assert_array_equal(_within_a_turn(angles), np.mod(angles, turn))
    far = np.array([-7.0, 100.0, -100.0])
    np.testing.assert_array_equal(_within_a_turn(far), np.mod(far, turn))
    assert len(_within_a_turn(np.empty(0))) == 0


@pytest.mark.parametrize("shift", [0, 1, 3, 7, 8, 20, -1, -7, -20])
def test_a_row_is_rolled(shift: int) -> None:
    row = np.arange(7.0)
    np.testing.assert_array_equal(_roll(row, shift), np.roll(row, shift))


@pytest.mark.parametrize("towed", [(), (0.1, 0.5, 0.6)])
def test_the_cells_of_the_robot_are_those_of_the_whole_grid_within_its_body(towed: tuple[float, ...]) -> None:
    draw = np.random.default_rng(7)
    for _ in range(30):
        pose = (*draw.uniform(-1.5, 1.5, 2).tolist(), float(draw.uniform(-4.0, 4.0)))
        grid, state = Grid(1.0, 0.0, 0.0), replace(state_of((*pose, 0.0)), towed=towed)
        middles = np.column_stack([part.ravel() for part in grid.middles])
        wanted = within_body(middles, pose, state, CELL).reshape(grid.size, grid.size)
        np.testing.assert_array_equal(_own_cells(grid, pose, state), wanted)
    assert not _own_cells(grid, pose, replace(state, footprint=())).any()
