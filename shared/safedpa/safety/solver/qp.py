"""The filter's quadratic program: the nearest action to the nominal action that keeps linear conditions, with slack."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.safety.solver.active_set_2d import LINEAR, QUADRATIC
from safedpa.safety.solver.qp_scaling import ScaledRow, Side, apart, presolve
from safedpa.safety.solver.solution import Solution

__all__ = ["QuadraticProgram", "Solution"]


_NO_CONDITION = -1.0
"""Right-hand side of padding rows 0 a + s >= -1, which always hold."""

_ACCURACY: Final = (1e-11, 1e-8)
"""Of residuals and duality gap; PIQP's own 1e-8 leaves 1e-4 in flat directions; one more iteration costs 3 us. Where it
gives up, a second solver that is content with less is asked."""


@final
class QuadraticProgram:
    """min (a - nominal)' W (a - nominal) + rho |s|^2 + rho1 sum s  s.t.  A a + r s >= b,  low <= a <= high,  s >= 0.

    W = diag(weights / (high - low)^2), the largest weight taken as 1; r (m,) is each row's reach sum_j |A_ij| (high_j -
    low_j), so that neither the rows' units nor the actions' matter. Always feasible: any a in its bounds with enough
    slack. Solved in the variables u = (a - low) / (high - low) of [0, 1]; rows that no action within the bounds can
    break are left out (exact: their slack is 0), as are those that no action changes. Of one or two actions the
    solution is found in a few steps, and taken where it proves to be the optimum; conditions that can all be kept are
    kept there, whatever their price. Else PIQP solves it, the rows padded
    to a power of two, so that each of its workspaces is built once.
    """

    def __init__(self, low: FloatArray, high: FloatArray, weights: FloatArray) -> None:
        self.low, self.high, self.range = low, high, high - low
        self.weights = weights / weights.max()
        self.sides: tuple[Side, ...] = tuple(zip(low.tolist(), high.tolist(), self.range.tolist(), strict=True))
        """Lowest, highest and range of each action, as plain numbers."""
        self._weights: tuple[float, ...] = tuple(self.weights.tolist())
        self._workspaces: dict[tuple[int, float], _Workspace] = {}

    def solve(self, A: Sequence[Sequence[float]], b: Sequence[float], nominal: Sequence[float]) -> Solution:
        """The minimiser for conditions A (m, actions), b (m,) and a nominal action (actions,), all of them plain numbers."""
        answer, rows = presolve(A, b, nominal, self.sides, self._weights)
        return answer or self._by_solver(rows, nominal, len(b))

    def _by_solver(self, rows: Sequence[ScaledRow], nominal: Sequence[float], count: int) -> Solution:
        """The minimiser by PIQP; by a second, less exacting one where the first gives up."""
        actions = len(self.sides)
        wanted = [(value - low) / width for value, (low, _, width) in zip(nominal, self.sides, strict=True)]
        left, right = [row[0] for row in rows], [row[1] for row in rows]
        for accuracy in _ACCURACY:
            solved, status, solution = self._workspace(len(rows), accuracy).solve(left, right, wanted)
            if solved:
                break
        action = [low + width * share for share, (low, _, width) in zip(solution[:actions], self.sides, strict=True)]
        slack = [0.0] * count
        for value, (_, _, index, reach) in zip(solution[actions : actions + len(rows)], rows, strict=True):
            slack[index] = value * reach
        return Solution(action, slack, solved, status)

    def distance(self, action: Sequence[float], nominal: Sequence[float]) -> float:
        """(action - nominal)' W (action - nominal)."""
        return apart(action, nominal, self.sides, self._weights)

    def _workspace(self, rows: int, accuracy: float) -> _Workspace:
        size = 1 << (rows - 1).bit_length()
        known = self._workspaces.get((size, accuracy))
        if known is None:
            known = self._workspaces[size, accuracy] = _Workspace(size, self.weights, accuracy)
        return known


@final
class _Workspace:
    """PIQP for a fixed number of rows, in the scaled variables (u, s)."""

    def __init__(self, rows: int, weights: FloatArray, accuracy: float) -> None:
        import piqp

        self._actions, self._pull = len(weights), (-2.0 * weights).tolist()
        self._solved = piqp.PIQP_SOLVED
        self._solver: Any = piqp.DenseSolver()
        self._costs = np.concatenate([np.zeros(len(weights)), np.full(rows, LINEAR)])
        self._left = np.zeros((rows, len(weights) + rows), order="F")
        self._left[:, len(weights) :] = np.eye(rows)
        self._slopes = self._left[:, : len(weights)]
        self._right = np.full(rows, _NO_CONDITION)
        for name in ("eps_abs", "eps_rel", "eps_duality_gap_abs", "eps_duality_gap_rel"):
            setattr(self._solver.settings, name, accuracy)
        hessian = np.asfortranarray(np.diag(2.0 * np.concatenate([weights, np.full(rows, QUADRATIC)])))
        upper = np.concatenate([np.ones(len(weights)), np.full(rows, np.inf)])
        self._solver.setup(hessian, self._costs, None, None, self._left, self._right, None, np.zeros(len(upper)), upper)

    def solve(self, left: list[list[float]], right: list[float], nominal: list[float]) -> tuple[bool, str, list[float]]:
        """Whether it was solved, the solver's word, and (u, s) (actions + rows,)."""
        rows = len(right)
        self._slopes[:rows], self._slopes[rows:] = left, 0.0
        self._right[:rows], self._right[rows:] = right, _NO_CONDITION
        self._costs[: self._actions] = [pull * wanted for pull, wanted in zip(self._pull, nominal, strict=True)]
        self._solver.update(c=self._costs, G=self._left, h_l=self._right)
        status = self._solver.solve()
        solution: list[float] = self._solver.result.x.tolist()
        if status == self._solved:
            return True, "solved", solution
        return False, str(status.name).removeprefix("PIQP_").lower().replace("_", " "), solution
