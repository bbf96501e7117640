"""Computes where a mover may be hidden: cells that are unseen now and reachable since they were last seen empty.

A mover of radius ``slimmest`` with its centre in a cell is hidden if no part of it is seen and no part overlaps a solid
obstacle. Wherever in the cell its centre is, it covers everything within ``width`` of the middle of the cell, so one
ray that passes there shows that it is not there. Each cell c has the earliest time A(c) at which the centre of a hidden
mover may be there. An observation at time t updates

    A(c) = infinity              where a mover in c would be seen, or would overlap a solid obstacle
    P    = { c : A(c) <= t }     where a mover may be now
    A(c) = min(A(c), max(A(c'), S(c)) + |c - c'| / fastest)   for all c' in P within a few cells

S(c) is the time when c was last seen empty. With it the front starts from its exact position instead of the border of
the cells passed so far; otherwise it would lose up to one cell per observation and be too slow.

A cell that was seen empty stays empty until the front reaches it; a region enclosed by walls stays empty forever. A
mover that goes out of sight starts a new front (``leaves``).
Source of the idea: reachability of phantom vehicles behind occlusions (Orzechowski, Meyer, Lauer, Tackling occlusions
and limited sensor range with set-based safety verification, ITSC 2018); here on cells, with memory.
"""

from __future__ import annotations

from functools import cache
from math import floor, inf
from typing import final

import numpy as np

from safedpa.arrays import BoolArray, FloatArray
from safedpa.perception.occupancy_grid import CELL, dilate, disc_offsets, shift_cells

__all__ = ["OcclusionMap"]


_FRONT_STEP = 0.3
"""m by which the front can advance per update: 0.2 s at 1.5 m/s. It is less than the width that a solid obstacle
blocks, so the front cannot jump through a wall."""


@final
class OcclusionMap:
    """Arrival-time front of hidden movers on a grid of (size, size) cells; at first every cell may hide one."""

    def __init__(self, size: int, slimmest: float, fastest: float) -> None:
        self._slimmest, self._fastest = slimmest, max(fastest, 1e-6)
        self.width = max(slimmest - CELL / 2**0.5, 0.0)
        """m around the middle of a cell that the slimmest mover with its centre in that cell always covers."""
        self._earliest: FloatArray = np.full((size, size), -inf)
        self.present: BoolArray = np.ones((size, size), dtype=bool)
        """Cells (size, size) in which the centre of a hidden mover may be, at the last observation."""
        self._stuck: BoolArray = np.zeros((size, size), dtype=bool)
        self._left: FloatArray = np.full((size, size), -inf)
        """Time when a mover was last seen in a cell, s."""
        self._seen_clear: FloatArray = np.full((size, size), -inf)
        """Time of the newest observation that saw a cell empty or solid, s."""
        self._newest = -inf
        """Time of the newest observation, s."""
        self.unoccupied: BoolArray = np.zeros((size, size), dtype=bool)
        """Cells (size, size) that the user declared unoccupied: no mover comes out of them. One that crosses them is
        reported where it enters."""

    def move(self, way: tuple[int, int]) -> None:
        """Shifts all cells with the grid; new cells may hide a mover."""
        self._earliest = shift_cells(self._earliest, way, -inf)
        self.present = shift_cells(self.present, way, True)
        self._stuck = shift_cells(self._stuck, way, False)
        self._left, self._seen_clear = shift_cells(self._left, way, -inf), shift_cells(self._seen_clear, way, -inf)
        self.unoccupied = shift_cells(self.unoccupied, way, False)

    def look(self, time: float, seen: BoolArray, solid: BoolArray, own: BoolArray, leaves: BoolArray) -> None:
        """Updates the map with an observation at ``time`` [s]; all arrays have shape (size, size).

        ``seen`` are cells with a ray that passes within ``width`` of their middle, ``solid`` cells at rest, ``own``
        cells of the robot, and ``leaves`` cells with a visible mover, which may be out of sight at the next one.
        A late observation, older than one of another source, does not know which movers have gone out of sight since:
        the front restarts at every mover that the newer one saw.
        """
        stuck = dilate(solid, self._slimmest, beyond=False)
        hidden = ~(seen | stuck | dilate(own, min(CELL, self.width), beyond=False))  # it would overlap the robot
        self._earliest[~hidden] = inf
        self._seen_clear[~hidden] = np.maximum(self._seen_clear[~hidden], time)
        self.present = hidden & (self._earliest <= time)
        later = self._left > time if time < self._newest else np.zeros_like(leaves)
        self._spread(time, dilate(leaves | later, self._slimmest, beyond=False))
        self._left[leaves], self._newest = np.maximum(self._left[leaves], time), max(self._newest, time)
        self._earliest[stuck] = inf
        self._stuck = stuck

    @property
    def exits(self) -> BoolArray:
        """Cells (size, size) of ``present`` next to open space: every mover that leaves a hidden region passes one.

        Cells next to a solid obstacle do not count: nothing can come out through a wall.
        """
        present = self.present & ~self.unoccupied
        open_room = ~present & ~self._stuck
        return present & dilate(open_room, 1.5 * CELL, beyond=False)

    def reached(self, time: float) -> BoolArray:
        """Cells (size, size) in which the centre of a mover may be at ``time`` [s] unless it is seen.

        They include cells that the user declared unoccupied, because those are not observed either.
        """
        return (self._earliest <= time) | self.unoccupied

    def wait(self, time: float) -> None:
        """Advances the front to ``time`` [s] without an observation."""
        self.present = self._earliest <= time
        self._spread(time, np.zeros_like(self.present))

    @property
    def patience(self) -> float:
        """s after which ``look`` or ``wait`` must be called again, so that the front keeps its speed."""
        return (_FRONT_STEP - CELL) / self._fastest

    def _spread(self, time: float, leaves: BoolArray) -> None:
        start = np.where(leaves, time, inf)
        start = np.where(self.present, np.minimum(self._earliest, start), start)
        start[self.unoccupied] = inf
        np.minimum(self._earliest, _advance_front(start, self._seen_clear, self._fastest), out=self._earliest)


def _advance_front(start: FloatArray, seen_clear: FloatArray, fastest: float) -> FloatArray:
    """min over c' near c of max(start(c'), seen_clear(c)) + |c - c'| / fastest (size, size); outside start = -inf.

    For cells c' at equal distance only the smallest start matters, because max and sum are monotonic. The rows are
    stored one after the other with padding, so that each neighbour is at a constant offset.
    """
    pad, size = floor(_FRONT_STEP / CELL + 1e-9), len(start)
    row = size + pad
    wide, seen = np.full((size + 2 * pad + 1, row), -inf), np.full((size, row), inf)
    wide[pad : pad + size, :size], seen[:, :size] = start, seen_clear
    line, least = wide.ravel(), seen.ravel()
    count = len(least)
    found, there = np.full(count, inf), np.empty(count)
    for distance, offsets in _offsets_by_distance(_FRONT_STEP):
        first, *others = (line[(pad + i) * row + j : (pad + i) * row + j + count] for i, j in offsets)
        for other in others:
            first = np.minimum(first, other, out=there)
        np.maximum(first, least, out=there)
        there += distance / fastest
        np.minimum(found, there, out=found)
    return found.reshape(size, row)[:, :size]


@cache
def _offsets_by_distance(radius: float) -> tuple[tuple[float, tuple[tuple[int, int], ...]], ...]:
    """Groups ``disc_offsets`` by distance [m]."""
    found: dict[float, list[tuple[int, int]]] = {}
    for i, j, distance in disc_offsets(radius):
        found.setdefault(distance, []).append((i, j))
    return tuple((distance, tuple(offsets)) for distance, offsets in found.items())
