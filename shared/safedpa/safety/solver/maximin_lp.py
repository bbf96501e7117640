"""The linear program behind the least-violation action: of several heights, the least one as high as it can be.

    max over u, t of t   subject to   slopes_i u + height_i >= t for every free row, >= level_i for the others,
                                      0 <= u_j <= 1

With z = (u, t) and rows G z >= g, n + 1 rows that hold with equality are a vertex, and their multipliers the solution
of G' multipliers = (0, ..., 0, -1). It begins where one free row alone would be highest, at bounds of u, whose
multipliers are the row's slopes: none is negative. As long as a row is broken it takes the place of the one whose
multiplier is used up first (Nocedal and Wright, Numerical Optimization, 2nd edition, section 13.6). Where several u are
as high, the one nearest to the middle is wanted: a vertex is believed only where the pull towards the middle leaves no
multiplier negative, and then the Karush-Kuhn-Tucker conditions of the problem with that pull hold. Else PIQP answers.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isnan
from typing import Any, Final, final

import numpy as np

__all__ = ["MaxMinProgram", "solve_by_dual_simplex"]

Rows = Sequence[Sequence[float]]
Numbers = Sequence[float]

_ALWAYS: Final = -1.0
"""Right-hand side of padding rows 0 >= -1."""
_MOST: Final = 1e9
"""Heights beyond are never the least, or cannot be changed; PIQP takes much larger ones for infinite."""
_ACCURACY: Final = 1e-10
_CENTRED: Final = 1e-9
"""Cost of u's distance from the middle of its range, squared: which of several optima is all the same here."""
_KEPT: Final = 1e-12
"""A row broken by less, as a share of 1 and the size of its limit, is kept."""
_TIGHT: Final = 1e-9
"""By how much, as the same share, a row of the vertex may miss equality."""
_MOVES: Final = 1e-9
"""A row that changes another one's multiplier by less cannot take its place."""
_TURNS: Final = 32
"""Rows that take the place of others; then others have to answer. Problems of a drive take two to seven."""


@final
class MaxMinProgram:
    """max over u, t of t  s.t.  slopes_i u + height_i >= t for every free row, >= level_i for the others, 0 <= u <= 1.

    Always feasible where the levels are. A vertex that proves to be the only optimum is taken; else PIQP solves it, in
    one workspace for each power of two of rows.
    """

    def __init__(self, actions: int) -> None:
        self._actions = actions
        self._workspaces: dict[int, _SimplexWorkspace] = {}

    def solve(self, slopes: Rows, heights: Numbers, levels: Numbers) -> list[float] | None:
        """u (actions,) for slopes (m, actions), heights (m,) at u = 0, levels (m,), NaN of a free row; or None."""
        return solve_by_dual_simplex(slopes, heights, levels) or self._by_solver(slopes, heights, levels)

    def _by_solver(self, slopes: Rows, heights: Numbers, levels: Numbers) -> list[float] | None:
        rows = len(slopes)
        size = 1 << (rows - 1).bit_length()
        if size not in self._workspaces:
            self._workspaces[size] = _SimplexWorkspace(self._actions, size)
        return self._workspaces[size].solve(slopes, heights, levels)


@final
class _SimplexWorkspace:
    def __init__(self, actions: int, rows: int) -> None:
        import piqp

        self._solved = piqp.PIQP_SOLVED
        self._solver: Any = piqp.DenseSolver()
        for name in ("eps_abs", "eps_rel", "eps_duality_gap_abs", "eps_duality_gap_rel"):
            setattr(self._solver.settings, name, _ACCURACY)
        self._left = np.zeros((rows, actions + 1), order="F")
        self._right = np.full(rows, _ALWAYS)
        hessian = np.asfortranarray(np.diag([*[_CENTRED] * actions, 0.0]))
        cost = np.array([*[-0.5 * _CENTRED] * actions, -1.0])
        low, high = np.array([*[0.0] * actions, -np.inf]), np.array([*[1.0] * actions, np.inf])
        self._solver.setup(hessian, cost, None, None, self._left, self._right, None, low, high)

    def solve(self, slopes: Rows, heights: Numbers, levels: Numbers) -> list[float] | None:
        rows, right, marks = len(slopes), list[float](), list[float]()
        for height, level in zip(heights, levels, strict=True):  # in plain numbers: numpy costs more for so few
            free = isnan(level)
            right.append(min(max((0.0 if free else level) - height, -_MOST), _MOST))
            marks.append(-1.0 if free else 0.0)
        self._left[:rows, :-1], self._left[:rows, -1], self._left[rows:] = slopes, marks, 0.0
        self._right[:rows], self._right[rows:] = right, _ALWAYS
        self._solver.update(G=self._left, h_l=self._right)
        if self._solver.solve() != self._solved:
            return None
        found = [min(max(share, 0.0), 1.0) for share in self._solver.result.x.tolist()[:-1]]
        return None if any(map(isnan, found)) else found


def solve_by_dual_simplex(
    slopes: Sequence[Sequence[float]], heights: Sequence[float], levels: Sequence[float]
) -> list[float] | None:
    """u (actions,) for slopes (m, actions), heights (m,) at u = 0 and levels (m,), NaN of a free row.

    None: it is no vertex, there is none, or a number is not finite. Raises ValueError when rows, heights and levels are
    not as many.
    """
    if len(heights) != len(slopes) or len(levels) != len(slopes):
        raise ValueError(f"{len(slopes)} rows of slopes, {len(heights)} heights and {len(levels)} levels")
    if len(slopes) == 0:
        return None
    return _LinearProgram(slopes, heights, levels).solved()


@final
class _LinearProgram:
    """One such problem."""

    def __init__(self, slopes: Sequence[Sequence[float]], heights: Sequence[float], levels: Sequence[float]) -> None:
        self._actions = len(slopes[0])
        self._rows: list[list[float]] = []
        self._limits: list[float] = []
        self._free: list[int] = []
        self._sum = 0.0
        for row in range(len(slopes)):
            self._add(slopes[row], heights[row], levels[row])
        self._bounds = len(self._rows)
        for column in range(self._actions):
            for sign, limit in ((1.0, 0.0), (-1.0, -1.0)):
                bound = [0.0] * (self._actions + 1)
                bound[column] = sign
                self._rows.append(bound)
                self._limits.append(limit)
        self._basis: list[int] = []
        self._multipliers: list[float] = []
        self._inverse: list[list[float]] = []
        """(n + 1, n + 1) of the basis's rows."""
        self._z: list[float] = []

    def _add(self, slopes: Sequence[float], height: float, level: float) -> None:
        free = level != level  # noqa: PLR0124 - a call of isnan costs more
        own: list[float] = []
        for column in range(self._actions):
            slope: float = slopes[column]
            own.append(slope)
            self._sum += slope
        own.append(-1.0 if free else 0.0)
        limit = -height if free else level - height
        self._sum += limit
        if free:
            self._free.append(len(self._rows))
        self._rows.append(own)
        self._limits.append(limit)

    def solved(self) -> list[float] | None:
        """u (actions,) of the vertex, or None."""
        if self._sum - self._sum != 0.0 or not self._free:
            return None
        self._begin()
        for _ in range(_TURNS):
            self._stand()
            broken = self._most_broken()
            if broken < 0:
                return [min(max(share, 0.0), 1.0) for share in self._z[:-1]] if self._certain() else None
            if not self._takes(broken):
                return None
        return None

    def _begin(self) -> None:
        """Where the row that is lowest at its best alone is highest."""
        size, lowest, first = self._actions, 0.0, -1
        for row in self._free:
            highest = -self._limits[row]
            for column in range(size):
                slope = self._rows[row][column]
                highest += slope if slope > 0.0 else 0.0
            if first < 0 or highest < lowest:
                lowest, first = highest, row
        own = self._rows[first]
        for column in range(size):
            upper = own[column] >= 0.0
            self._basis.append(self._bounds + 2 * column + (1 if upper else 0))
            self._multipliers.append(abs(own[column]))
            inverse = [0.0] * (size + 1)
            inverse[column] = -1.0 if upper else 1.0
            self._inverse.append(inverse)
        self._basis.append(first)
        self._multipliers.append(1.0)
        self._inverse.append([own[column] * self._inverse[column][column] for column in range(size)] + [-1.0])

    def _stand(self) -> None:
        """z = G^-1 g of the basis."""
        z: list[float] = []
        for inverse in self._inverse:
            value = 0.0
            for place in range(len(inverse)):
                value += inverse[place] * self._limits[self._basis[place]]
            z.append(value)
        self._z = z

    def _short(self, row: int) -> float:
        """What the row misses at z, as a share of 1 and the size of its limit."""
        own, z, limit = self._rows[row], self._z, self._limits[row]
        missing = limit
        for place in range(len(z)):
            missing -= own[place] * z[place]
        return missing / (1.0 + abs(limit))

    def _most_broken(self) -> int:
        """The row that is broken most; -1: none."""
        worst, broken = _KEPT, -1
        for row in range(len(self._rows)):
            missing = self._short(row)
            if missing > worst:
                worst, broken = missing, row
        return broken

    def _takes(self, entering: int) -> bool:
        """Puts a row into the basis, for the one whose multiplier is used up first; False: there is none."""
        own, inverse, size = self._rows[entering], self._inverse, self._actions + 1
        changes: list[float] = []
        leaving, least = -1, 0.0
        for place in range(size):
            change = 0.0
            for row in range(size):
                change += own[row] * inverse[row][place]
            changes.append(change)
            if change > _MOVES:
                ratio = self._multipliers[place] / change
                if leaving < 0 or ratio < least:
                    leaving, least = place, ratio
        if leaving < 0:
            return False
        for row in range(size):
            own_inverse = inverse[row]
            share = own_inverse[leaving] / changes[leaving]
            for place in range(size):
                own_inverse[place] = share if place == leaving else own_inverse[place] - changes[place] * share
        for place in range(size):
            self._multipliers[place] = least if place == leaving else self._multipliers[place] - least * changes[place]
        self._basis[leaving] = entering
        return True

    def _certain(self) -> bool:
        """Whether the vertex is one, and no multiplier is negative with the pull towards the middle."""
        for place in range(len(self._basis)):
            missing = self._short(self._basis[place])
            if not abs(missing) <= _TIGHT:
                return False
            multiplier = -self._inverse[self._actions][place]
            for column in range(self._actions):
                multiplier += _CENTRED * (self._z[column] - 0.5) * self._inverse[column][place]
            if not multiplier >= 0.0:
                return False
        return True
