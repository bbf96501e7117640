"""Edges of bins: round widths, where they begin and end, and which are merged, by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from safedpa.compare.bins import angle_edges, merged, round_edges


@pytest.mark.parametrize(
    ("low", "high", "width"),
    [
        (0.0, 8.0, 1.0), (0.0, 8.08, 2.0), (0.0, 16.0, 2.0), (0.0, 16.2, 2.5), (0.0, 20.0, 2.5), (0.0, 20.3, 5.0),
        (0.0, 40.0, 5.0), (0.0, 40.5, 10.0), (0.0, 80.0, 10.0), (0.0, 0.8, 0.1), (-4.0, 4.0, 1.0), (0.0, 800.0, 100.0),
        (0.0, 8e-6, 1e-6),
    ],
)  # fmt: skip
def test_the_width_is_the_least_round_one_of_which_eight_hold_the_range(low: float, high: float, width: float) -> None:
    """1, 2, 2.5 or 5 times a power of ten; the outermost hundredth is a copy of the ends."""
    values = np.concatenate([np.full(50, low), np.linspace(low, high, 200), np.full(50, high)])
    edges = round_edges(values)
    assert np.diff(edges) == pytest.approx(np.full(len(edges) - 1, width))
    assert edges[0] == pytest.approx(width * math.floor(low / width + 1e-9), abs=1e-12)
    assert edges[-1] == pytest.approx(width * math.ceil(high / width - 1e-9), abs=1e-12)


def test_so_many_bins_as_are_asked_for() -> None:
    values = np.concatenate([np.zeros(50), np.linspace(0.0, 10.0, 200), np.full(50, 10.0)])
    assert round_edges(values, most=2).tolist() == [0.0, 5.0, 10.0]
    assert round_edges(values, most=4).tolist() == [0.0, 2.5, 5.0, 7.5, 10.0]


def test_few_that_lie_far_out_move_the_outer_edges_alone() -> None:
    values = np.concatenate([np.zeros(500), np.linspace(0.0, 8.0, 2000), np.full(500, 8.0), [-7.4, 93.2]])
    assert round_edges(values).tolist() == [-8.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 94.0]


def test_the_outer_edges_are_multiples_of_the_width_too() -> None:
    values = np.concatenate([np.zeros(500), np.linspace(0.0, 20.0, 2000), np.full(500, 20.0), [-7.4, 93.2]])
    assert round_edges(values).tolist() == [-7.5, *np.arange(2.5, 20.0, 2.5), 95.0]


def test_the_middle_ninety_nine_hundredths_decide() -> None:
    """0.4 % at either end do not count for the width, 0.6 % do."""
    middle = np.linspace(0.0, 8.0, 1001)
    few = np.concatenate([middle, np.full(4, 80.0)])
    many = np.concatenate([middle, np.full(8, 80.0)])
    below = np.concatenate([middle, np.full(8, -72.0)])
    assert round_edges(few)[1] - round_edges(few)[0] == 1.0
    assert round_edges(many)[1] - round_edges(many)[0] == 10.0
    assert round_edges(below)[-1] - round_edges(below)[-2] == 10.0


@pytest.mark.parametrize("value", [0.0, 0.3, -0.3, 2.0])
def test_values_that_are_all_one_have_one_bin_of_width_one(value: float) -> None:
    edges = round_edges(np.full(30, value))
    assert edges[-1] - edges[0] == 1.0
    assert edges[0] <= value <= edges[-1]
    assert len(edges) == 2


def test_sectors_go_once_round() -> None:
    assert angle_edges() == pytest.approx([math.pi * part / 4.0 for part in range(-4, 5)])
    assert angle_edges(2) == pytest.approx([-math.pi, 0.0, math.pi])


@pytest.mark.parametrize(
    ("smallest", "wanted"),
    [(1, [0.0, 1.0, 2.0, 3.0, 4.0]), (2, [0.0, 2.0, 3.0, 4.0]), (3, [0.0, 2.0, 4.0]), (4, [0.0, 4.0]), (5, [0.0, 4.0]),
     (7, [0.0, 4.0]), (8, [0.0, 4.0]), (9, [0.0, 4.0])],
)  # fmt: skip
def test_a_bin_of_too_few_joins_the_one_on_its_right_and_the_last_the_one_on_its_left(
    smallest: int, wanted: list[float]
) -> None:
    """One, two, two and two values in bins of width 1; what is left over at the end belongs to the last bin."""
    values = np.array([0.5, 1.2, 1.4, 2.2, 2.4, 3.2, 3.4])
    found = merged(values, np.arange(5.0), smallest)
    assert found.tolist() == wanted
