"""The max-min linear program of the least-violation action: raises the smallest of several linear functions.

    max over u, t of t   subject to   gradient_i . u + offset_i >= t for every free row, >= level_i for the others,
                                      0 <= u_j <= 1

Solved by the dual simplex method (Nocedal and Wright, Numerical Optimization, 2nd edition, section 13.6). With z = (u,
t) and rows G z >= g, n + 1 rows that hold with equality form a vertex; their multipliers solve G' multipliers = (0,
..., 0, -1). The start is the maximum of one free row alone, at bounds of u: its multipliers are the sizes of the row's
entries, so none is negative. While a row is violated, it replaces the row whose multiplier reaches 0 first. If several
u are optimal, the one nearest to the middle is wanted. A vertex is the only optimum if no multiplier is negative with a
small quadratic cost of the distance from the middle added: the KKT conditions of that problem then hold. Otherwise, for
one or two actions, an active-set method finds the u nearest to the middle at which every free row reaches t. All else
is solved by PIQP.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isnan
from typing import Any, Final, final

import numpy as np

from safedpa.safety.solver.active_set_2d import HardQP2D

__all__ = ["MaxMinProgram", "solve_by_dual_simplex"]

Rows = Sequence[Sequence[float]]
Numbers = Sequence[float]

_PADDING_RHS: Final = -1.0
"""Right-hand side of padding rows 0 >= -1, which always hold."""
_MAX_OFFSET: Final = 1e9
"""Larger offsets are never the minimum, or cannot be changed; PIQP treats much larger values as infinite."""
_ACCURACY: Final = 1e-10
"""Tolerance of PIQP; the least-violation action gives away 2e-3, so this error has no effect."""
_CENTERING_WEIGHT: Final = 1e-9
"""Quadratic cost of the distance of u from the middle of its range: it makes the optimum unique."""
_FEASIBILITY_TOLERANCE: Final = 1e-12
"""A row violated by less, relative to 1 + |limit|, counts as satisfied."""
_EQUALITY_TOLERANCE: Final = 1e-9
"""Largest deviation from equality of a row of the vertex, relative to 1 + |limit|."""
_MIN_PIVOT: Final = 1e-9
"""A row that changes a multiplier by less cannot replace its row: the pivot would be rounding error."""
_MAX_PIVOTS: Final = 32
"""Largest number of pivots; beyond it PIQP is used. A drive takes two to seven."""


@final
class MaxMinProgram:
    """max over u, t of t  s.t.  gradient_i . u + offset_i >= t for free rows, >= level_i for the others, 0 <= u <= 1.

    Feasible whenever the levels are. A vertex that is proven to be the only optimum is returned; otherwise PIQP solves
    the program, in one workspace for each power of two of rows.
    """

    def __init__(self, actions: int) -> None:
        self._actions = actions
        self._workspaces: dict[int, _Workspace] = {}

    def solve(self, gradients: Rows, offsets: Numbers, levels: Numbers) -> list[float] | None:
        """u (actions,) for gradients (m, actions), offsets (m,) at u = 0, levels (m,), NaN for a free row; or None."""
        return solve_by_dual_simplex(gradients, offsets, levels) or self._by_solver(gradients, offsets, levels)

    def _by_solver(self, gradients: Rows, offsets: Numbers, levels: Numbers) -> list[float] | None:
        rows = len(gradients)
        # Padded to a power of two: a workspace is expensive to set up and cheap to reuse.
        size = 1 << (rows - 1).bit_length()
        if size not in self._workspaces:
            self._workspaces[size] = _Workspace(self._actions, size)
        return self._workspaces[size].solve(gradients, offsets, levels)


@final
class _Workspace:
    """PIQP for a fixed number of rows, in z = (u, t)."""

    def __init__(self, actions: int, rows: int) -> None:
        # Imported here: the simplex method answers nearly all programs without it.
        import piqp

        self._solved = piqp.PIQP_SOLVED
        self._solver: Any = piqp.DenseSolver()
        for name in ("eps_abs", "eps_rel", "eps_duality_gap_abs", "eps_duality_gap_rel"):
            setattr(self._solver.settings, name, _ACCURACY)
        self._left = np.zeros((rows, actions + 1), order="F")
        self._right = np.full(rows, _PADDING_RHS)
        hessian = np.asfortranarray(np.diag([*[_CENTERING_WEIGHT] * actions, 0.0]))
        cost = np.array([*[-0.5 * _CENTERING_WEIGHT] * actions, -1.0])
        low, high = np.array([*[0.0] * actions, -np.inf]), np.array([*[1.0] * actions, np.inf])
        self._solver.setup(hessian, cost, None, None, self._left, self._right, None, low, high)

    def solve(self, gradients: Rows, offsets: Numbers, levels: Numbers) -> list[float] | None:
        rows, right, marks = len(gradients), list[float](), list[float]()
        for offset, level in zip(offsets, levels, strict=True):  # Python floats: numpy is slower for so few
            free = isnan(level)
            right.append(min(max((0.0 if free else level) - offset, -_MAX_OFFSET), _MAX_OFFSET))
            marks.append(-1.0 if free else 0.0)
        self._left[:rows, :-1], self._left[:rows, -1], self._left[rows:] = gradients, marks, 0.0
        self._right[:rows], self._right[rows:] = right, _PADDING_RHS
        self._solver.update(G=self._left, h_l=self._right)
        if self._solver.solve() != self._solved:
            return None
        # The interior point may lie outside the bounds by its tolerance.
        found = [min(max(share, 0.0), 1.0) for share in self._solver.result.x.tolist()[:-1]]
        return None if any(map(isnan, found)) else found


def solve_by_dual_simplex(
    gradients: Sequence[Sequence[float]], offsets: Sequence[float], levels: Sequence[float]
) -> list[float] | None:
    """u (actions,) for gradients (m, actions), offsets (m,) at u = 0 and levels (m,), NaN for a free row.

    Returns None if the optimum is not a proven vertex, does not exist, or a number is not finite. Raises ValueError if
    the numbers of rows, offsets and levels differ.
    """
    if len(offsets) != len(gradients) or len(levels) != len(gradients):
        raise ValueError(f"{len(gradients)} rows, {len(offsets)} offsets and {len(levels)} levels")
    if len(gradients) == 0:
        return None
    return _LinearProgram(gradients, offsets, levels).solve()


@final
class _LinearProgram:
    """One program in the form G z >= g."""

    def __init__(self, gradients: Sequence[Sequence[float]], offsets: Sequence[float], levels: Sequence[float]) -> None:
        self._actions = len(gradients[0])
        self._rows: list[list[float]] = []
        self._limits: list[float] = []
        self._free: list[int] = []
        self._sum = 0.0
        for row in range(len(gradients)):
            self._add_row(gradients[row], offsets[row], levels[row])
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
        """(n + 1, n + 1) inverse of the rows of the basis, updated at every pivot."""
        self._z: list[float] = []

    def _add_row(self, gradients: Sequence[float], offset: float, level: float) -> None:
        free = level != level  # noqa: PLR0124 - NaN; a call of isnan takes longer
        own: list[float] = []
        for column in range(self._actions):
            entry: float = gradients[column]
            own.append(entry)
            self._sum += entry
        own.append(-1.0 if free else 0.0)
        limit = -offset if free else level - offset
        self._sum += limit
        if free:
            self._free.append(len(self._rows))
        self._rows.append(own)
        self._limits.append(limit)

    def solve(self) -> list[float] | None:
        """u (actions,) of the optimal vertex, or None."""
        # Without a free row t is unbounded; a sum that is not finite shows NaN or infinity among the data.
        if self._sum - self._sum != 0.0 or not self._free:
            return None
        self._start_basis()
        for _ in range(_MAX_PIVOTS):
            self._solve_basis()
            violated = self._most_violated()
            if violated < 0:
                if not self._holds_with_equality():
                    return None
                if self._is_only_optimum():
                    return [min(max(share, 0.0), 1.0) for share in self._z[:-1]]
                return self._nearest_to_middle()
            if not self._pivot(violated):
                return None
        return None

    def _start_basis(self) -> None:
        """The vertex that maximises the free row with the smallest maximum."""
        # That row is the bottleneck: no u can raise the minimum above its maximum, so few pivots follow.
        size, lowest, first = self._actions, 0.0, -1
        for row in self._free:
            maximum = -self._limits[row]
            for column in range(size):
                entry = self._rows[row][column]
                maximum += entry if entry > 0.0 else 0.0
            if first < 0 or maximum < lowest:
                lowest, first = maximum, row
        own = self._rows[first]
        for column in range(size):
            # At its maximum each u_j lies at the bound that the sign of its entry asks for.
            upper = own[column] >= 0.0
            self._basis.append(self._bounds + 2 * column + (1 if upper else 0))
            self._multipliers.append(abs(own[column]))
            inverse = [0.0] * (size + 1)
            inverse[column] = -1.0 if upper else 1.0
            self._inverse.append(inverse)
        self._basis.append(first)
        self._multipliers.append(1.0)
        self._inverse.append([own[column] * self._inverse[column][column] for column in range(size)] + [-1.0])

    def _solve_basis(self) -> None:
        """z = G^-1 g of the basis."""
        z: list[float] = []
        for inverse in self._inverse:
            value = 0.0
            for place in range(len(inverse)):
                value += inverse[place] * self._limits[self._basis[place]]
            z.append(value)
        self._z = z

    def _scaled_violation(self, row: int) -> float:
        """The violation of the row at z, relative to 1 + |limit|."""
        own, z, limit = self._rows[row], self._z, self._limits[row]
        violation = limit
        for place in range(len(z)):
            violation -= own[place] * z[place]
        return violation / (1.0 + abs(limit))

    def _most_violated(self) -> int:
        """The most violated row; -1: none."""
        worst, violated = _FEASIBILITY_TOLERANCE, -1
        for row in range(len(self._rows)):
            violation = self._scaled_violation(row)
            if violation > worst:
                worst, violated = violation, row
        return violated

    def _pivot(self, entering: int) -> bool:
        """Puts a row into the basis in place of the one whose multiplier reaches 0 first; False: there is none."""
        own, inverse, size = self._rows[entering], self._inverse, self._actions + 1
        changes: list[float] = []
        leaving, step = -1, 0.0
        for place in range(size):
            change = 0.0
            for row in range(size):
                change += own[row] * inverse[row][place]
            changes.append(change)
            # Only positive changes shrink a multiplier. None at all: the dual is unbounded, so the levels are
            # infeasible.
            if change > _MIN_PIVOT:
                ratio = self._multipliers[place] / change
                if leaving < 0 or ratio < step:
                    leaving, step = place, ratio
        if leaving < 0:
            return False
        # Rank-one update of the inverse, O(n^2) instead of solving the basis again.
        for row in range(size):
            own_inverse = inverse[row]
            share = own_inverse[leaving] / changes[leaving]
            for place in range(size):
                own_inverse[place] = share if place == leaving else own_inverse[place] - changes[place] * share
        for place in range(size):
            self._multipliers[place] = step if place == leaving else self._multipliers[place] - step * changes[place]
        self._basis[leaving] = entering
        return True

    def _nearest_to_middle(self) -> list[float] | None:
        """u (actions,), of several optimal ones the one nearest to the middle; None if that is not proven."""
        if self._actions > 2:
            return None
        two, t = self._actions > 1, self._z[-1]
        t -= _FEASIBILITY_TOLERANCE * (1.0 + abs(t))  # rounding of t must not make the rows contradict each other
        problem = HardQP2D(0.5, 0.5 if two else 0.0, 1.0, 1.0)
        for row in range(self._bounds):
            own, limit = self._rows[row], self._limits[row]
            a, b = own[0], own[1] if two else 0.0
            size = abs(a) + abs(b)
            if size > 0.0:
                problem.add(a / size, b / size, (limit + t if own[-1] < 0.0 else limit) / size)
        if not problem.solve():
            return None
        found = [problem.x, problem.y] if two else [problem.x]
        return [min(max(share, 0.0), 1.0) for share in found]

    def _holds_with_equality(self) -> bool:
        """Whether all rows of the vertex do: rounding errors add up in the updated inverse."""
        return all(abs(self._scaled_violation(row)) <= _EQUALITY_TOLERANCE for row in self._basis)

    def _is_only_optimum(self) -> bool:
        """Whether no multiplier is negative with the centring cost added."""
        for place in range(len(self._basis)):
            multiplier = -self._inverse[self._actions][place]
            for column in range(self._actions):
                multiplier += _CENTERING_WEIGHT * (self._z[column] - 0.5) * self._inverse[column][place]
            if not multiplier >= 0.0:
                return False
        return True
