"""The filter's quadratic program: the action nearest to the nominal one under linear constraints with slack."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.safety.solver.active_set_2d import LINEAR_PRICE, QUADRATIC_PRICE
from safedpa.safety.solver.qp_scaling import ScaledRow, Side, presolve, weighted_distance
from safedpa.safety.solver.solution import Solution

__all__ = ["QuadraticProgram", "Solution"]


_PADDING_RHS = -1.0
"""Right-hand side of padding rows 0 a + s >= -1, which always hold."""

_ACCURACY: Final = (1e-11, 1e-8)
"""Tolerances of residuals and duality gap. PIQP's default of 1e-8 leaves an error of 1e-4 in flat directions; one more
iteration costs 3 us. If the first tolerance is not reached, the second is tried."""


@final
class QuadraticProgram:
    """min (a - nominal)' W (a - nominal) + rho |s|^2 + rho1 sum s  s.t.  A a + r s >= b,  low <= a <= high,  s >= 0.

    W = diag(weights / (high - low)^2), the largest weight taken as 1; r (m,) is each row's reach sum_j |A_ij| (high_j -
    low_j), so that neither the units of the rows nor those of the actions matter. It is always feasible: any a within
    its bounds with enough slack. It is solved in u = (a - low) / (high - low), from 0 to 1. Rows that no action within
    the bounds can violate are left out (exact: their slack is 0), and so are rows that no action changes. For one or
    two actions an active-set method finds the solution in a few steps, and proves it by the KKT conditions; constraints
    that can be satisfied together then need no slack, whatever its price. All else is solved by PIQP, with the rows
    padded to a power of two so that each workspace is built once.
    """

    def __init__(self, low: FloatArray, high: FloatArray, weights: FloatArray) -> None:
        self.low, self.high, self.range = low, high, high - low
        self.weights = weights / weights.max()
        self.sides: tuple[Side, ...] = tuple(zip(low.tolist(), high.tolist(), self.range.tolist(), strict=True))
        """Lowest value, highest value and range of each action, as Python floats."""
        self._weights: tuple[float, ...] = tuple(self.weights.tolist())
        self._workspaces: dict[tuple[int, float], _Workspace] = {}

    def solve(self, A: Sequence[Sequence[float]], b: Sequence[float], nominal: Sequence[float]) -> Solution:
        """The minimiser for constraints A (m, actions), b (m,) and a nominal action (actions,), in Python floats."""
        answer, rows = presolve(A, b, nominal, self.sides, self._weights)
        return answer or self._by_solver(rows, nominal, len(b))

    def _by_solver(self, rows: Sequence[ScaledRow], nominal: Sequence[float], count: int) -> Solution:
        """The minimiser by PIQP; with a looser tolerance if the first attempt fails."""
        actions = len(self.sides)
        target = [(value - low) / width for value, (low, _, width) in zip(nominal, self.sides, strict=True)]
        left, right = [row[0] for row in rows], [row[1] for row in rows]
        # An interior-point method: dense and small, it needs about ten iterations whatever the number of active rows.
        for accuracy in _ACCURACY:
            solved, status, solution = self._workspace(len(rows), accuracy).solve(left, right, target)
            if solved:
                break
        action = [low + width * share for share, (low, _, width) in zip(solution[:actions], self.sides, strict=True)]
        slack = [0.0] * count
        # The solver's slack is scaled by the row's reach; the caller gets it in the unit of the constraint.
        for value, (_, _, index, reach) in zip(solution[actions : actions + len(rows)], rows, strict=True):
            slack[index] = value * reach
        return Solution(action, slack, solved, status)

    def distance(self, action: Sequence[float], nominal: Sequence[float]) -> float:
        """(action - nominal)' W (action - nominal)."""
        return weighted_distance(action, nominal, self.sides, self._weights)

    def _workspace(self, rows: int, accuracy: float) -> _Workspace:
        # Padding to a power of two keeps the number of workspaces small: setup costs more than solving.
        size = 1 << (rows - 1).bit_length()
        known = self._workspaces.get((size, accuracy))
        if known is None:
            known = self._workspaces[size, accuracy] = _Workspace(size, self.weights, accuracy)
        return known


@final
class _Workspace:
    """A PIQP solver for a fixed number of rows, in the scaled variables (u, s)."""

    def __init__(self, rows: int, weights: FloatArray, accuracy: float) -> None:
        # Imported here: most processes with one or two actions never need the solver.
        import piqp

        self._actions, self._pull = len(weights), (-2.0 * weights).tolist()
        self._solved = piqp.PIQP_SOLVED
        # 1/2 x'Px + c'x in PIQP's form, hence the factors 2; a linear price makes the slack exactly 0 where possible.
        self._solver: Any = piqp.DenseSolver()
        self._costs = np.concatenate([np.zeros(len(weights)), np.full(rows, LINEAR_PRICE)])
        self._left = np.zeros((rows, len(weights) + rows), order="F")
        self._left[:, len(weights) :] = np.eye(rows)
        self._gradients = self._left[:, : len(weights)]
        self._right = np.full(rows, _PADDING_RHS)
        for name in ("eps_abs", "eps_rel", "eps_duality_gap_abs", "eps_duality_gap_rel"):
            setattr(self._solver.settings, name, accuracy)
        hessian = np.asfortranarray(np.diag(2.0 * np.concatenate([weights, np.full(rows, QUADRATIC_PRICE)])))
        upper = np.concatenate([np.ones(len(weights)), np.full(rows, np.inf)])
        self._solver.setup(hessian, self._costs, None, None, self._left, self._right, None, np.zeros(len(upper)), upper)

    def solve(self, left: list[list[float]], right: list[float], nominal: list[float]) -> tuple[bool, str, list[float]]:
        """Whether it was solved, the solver's status, and (u, s) (actions + rows,)."""
        rows = len(right)
        self._gradients[:rows], self._gradients[rows:] = left, 0.0
        self._right[:rows], self._right[rows:] = right, _PADDING_RHS
        self._costs[: self._actions] = [pull * target for pull, target in zip(self._pull, nominal, strict=True)]
        # Only what changes from tick to tick is passed on; the factorisation structure is kept.
        self._solver.update(c=self._costs, G=self._left, h_l=self._right)
        status = self._solver.solve()
        solution: list[float] = self._solver.result.x.tolist()
        if status == self._solved:
            return True, "solved", solution
        return False, str(status.name).removeprefix("PIQP_").lower().replace("_", " "), solution
