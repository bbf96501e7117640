"""Where something that moves may hide: what no one sees, and could have been reached since someone looked.

A thing of radius ``slimmest`` is hidden with its middle in a cell if no part of it is seen, and no part of it stands in
what is known to be solid. Wherever in the cell its middle is, it holds all that is within ``width`` of the cell's own
middle: one ray that passes there and goes on shows that it is not there, however many others were dropped. Each cell c
has the earliest moment A(c) at which the middle may be there. A look at time t

    A(c) = infinity              where a thing in c would be seen, or stuck in something solid
    P    = { c : A(c) <= t }     where something may be now
    A(c) = min(A(c), max(A(c'), S(c)) + |c - c'| / fastest)   for all c' in P within a few cells

S(c) is the moment of the newest look that saw c without it, so the front begins where it is, and not where the cells
that it has passed by a look end: else it would lose up to a cell with each look, and be slower than it says.

What was seen to be empty a moment ago stays empty until the front has come that far, and what lies behind walls all
around stays empty for ever. What was seen and goes out of sight is a beginning of such a front as well (``leaves``).
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


_FRONT = 0.3
"""m that the front is drawn ahead at each look: what it covers in 0.2 s at 1.5 m/s. The room that solid things take
from a middle is wider, so that no front jumps through a wall."""


@final
class OcclusionMap:
    """The front of what may hide on a grid of (size, size) cells; everything may hold something at first."""

    def __init__(self, size: int, slimmest: float, fastest: float) -> None:
        self._slimmest, self._fastest = slimmest, max(fastest, 1e-6)
        self.width = max(slimmest - CELL / 2**0.5, 0.0)
        """m around a cell's middle that the slimmest thing with its own middle in that cell always holds."""
        self._earliest: FloatArray = np.full((size, size), -inf)
        self.present: BoolArray = np.ones((size, size), dtype=bool)
        """(size, size) cells in which the middle of something hidden may be, as of the last look."""
        self._stuck: BoolArray = np.zeros((size, size), dtype=bool)
        self._left: FloatArray = np.full((size, size), -inf)
        """s; when something that may move was last seen in a cell."""
        self._shown: FloatArray = np.full((size, size), -inf)
        """s; the newest look that saw a cell without anybody in it, or something solid there."""
        self._newest = -inf
        """s; the newest look."""
        self.unoccupied: BoolArray = np.zeros((size, size), dtype=bool)
        """(size, size) cells in which a person says that no one hides: no one comes out of them. Who would come through
        them is told where he comes in."""

    def move(self, way: tuple[int, int]) -> None:
        """With the grid; what comes in may hold something."""
        self._earliest = shift_cells(self._earliest, way, -inf)
        self.present = shift_cells(self.present, way, True)
        self._stuck = shift_cells(self._stuck, way, False)
        self._left, self._shown = shift_cells(self._left, way, -inf), shift_cells(self._shown, way, -inf)
        self.unoccupied = shift_cells(self.unoccupied, way, False)

    def look(self, time: float, seen: BoolArray, solid: BoolArray, own: BoolArray, leaves: BoolArray) -> None:
        """Takes up what ``solid`` is at rest at ``time`` [s], the robot's ``own``, and cells past whose middle, within
        ``width``, a ray was ``seen`` to go on; (size, size).

        ``leaves``: cells in which something that may move is seen, and may have gone out of sight by the next look. A
        look that comes late, after another source's newer one, knows nothing of who went out of sight since: the front
        begins again at anyone who the newer one saw.
        """
        stuck = dilate(solid, self._slimmest, beyond=False)
        hidden = ~(seen | stuck | dilate(own, min(CELL, self.width), beyond=False))  # as far as it would overlap
        self._earliest[~hidden] = inf
        self._shown[~hidden] = np.maximum(self._shown[~hidden], time)
        self.present = hidden & (self._earliest <= time)
        later = self._left > time if time < self._newest else np.zeros_like(leaves)
        self._spread(time, dilate(leaves | later, self._slimmest, beyond=False))
        self._left[leaves], self._newest = np.maximum(self._left[leaves], time), max(self._newest, time)
        self._earliest[stuck] = inf
        self._stuck = stuck

    @property
    def ways_out(self) -> BoolArray:
        """(size, size) cells of ``present`` next to one that is neither: anyone who leaves a hiding place passes one.

        Between what hides and what is solid no one comes out: behind a wall someone may be, and stays there.
        """
        present = self.present & ~self.unoccupied
        open_room = ~present & ~self._stuck
        return present & dilate(open_room, 1.5 * CELL, beyond=False)

    def reached(self, time: float) -> BoolArray:
        """(size, size) cells in which the middle of something that moves may be at ``time`` [s] unless it is seen.

        Who comes out of where a person says that no one hides was not seen to come either.
        """
        return (self._earliest <= time) | self.unoccupied

    def wait(self, time: float) -> None:
        """No one looked until ``time`` [s]: the front goes on."""
        self.present = self._earliest <= time
        self._spread(time, np.zeros_like(self.present))

    @property
    def patience(self) -> float:
        """s after which someone has to look or wait again, for the front to keep its pace."""
        return (_FRONT - CELL) / self._fastest

    def _spread(self, time: float, leaves: BoolArray) -> None:
        start = np.where(leaves, time, inf)
        start = np.where(self.present, np.minimum(self._earliest, start), start)
        start[self.unoccupied] = inf
        np.minimum(self._earliest, _reached(start, self._shown, self._fastest), out=self._earliest)


def _reached(start: FloatArray, shown: FloatArray, fastest: float) -> FloatArray:
    """(size, size) min over c' near c of max(start(c'), shown(c)) + |c - c'| / fastest, start = -infinity beyond.

    Of all c' as far away the least start comes first: the later of two moments, and a sum, grow with each of them.
    One row after the other, with room between them, so that every neighbour is the same few numbers away.
    """
    pad, size = floor(_FRONT / CELL + 1e-9), len(start)
    row = size + pad
    wide, seen = np.full((size + 2 * pad + 1, row), -inf), np.full((size, row), inf)
    wide[pad : pad + size, :size], seen[:, :size] = start, shown
    line, least = wide.ravel(), seen.ravel()
    count = len(least)
    found, there = np.full(count, inf), np.empty(count)
    for distance, offsets in _offsets_by_distance(_FRONT):
        first, *others = (line[(pad + i) * row + j : (pad + i) * row + j + count] for i, j in offsets)
        for other in others:
            first = np.minimum(first, other, out=there)
        np.maximum(first, least, out=there)
        there += distance / fastest
        np.minimum(found, there, out=found)
    return found.reshape(size, row)[:, :size]


@cache
def _offsets_by_distance(radius: float) -> tuple[tuple[float, tuple[tuple[int, int], ...]], ...]:
    """Those of ``disc_offsets`` of which one distance [m] is true."""
    found: dict[float, list[tuple[int, int]]] = {}
    for i, j, distance in disc_offsets(radius):
        found.setdefault(distance, []).append((i, j))
    return tuple((distance, tuple(offsets)) for distance, offsets in found.items())
