"""The linear program behind the least unsafe action: of several heights, the least one as high as it can be."""

from __future__ import annotations

from collections.abc import Sequence
from math import isnan
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

__all__ = ["HighestProgram"]

Values = NDArray[np.float64]
Rows = Sequence[Sequence[float]] | Values
Numbers = Sequence[float] | Values

_ALWAYS = -1.0
"""Right-hand side of padding rows 0 >= -1."""
_MOST = 1e9
"""Heights beyond are never the least, or cannot be changed; PIQP takes much larger ones for infinite."""
_ACCURACY = 1e-10
_CENTRED = 1e-9
"""Cost of an action's distance from the middle of its range, squared: which of several optima is all the same here."""


@final
class HighestProgram:
    """max over u, t of t  s.t.  slopes_i u + height_i >= t for every free row, >= level_i for the others, 0 <= u <= 1.

    Always feasible where the levels are. One workspace of PIQP for each power of two of rows.
    """

    def __init__(self, actions: int) -> None:
        self._actions = actions
        self._workspaces: dict[int, _Workspace] = {}

    def solve(self, slopes: Rows, heights: Numbers, levels: Numbers) -> Values | None:
        """u (actions,) for slopes (m, actions), heights (m,) at u = 0, levels (m,), NaN of a free row; or None."""
        rows = len(slopes)
        size = 1 << (rows - 1).bit_length()
        if size not in self._workspaces:
            self._workspaces[size] = _Workspace(self._actions, size)
        return self._workspaces[size].solve(slopes, heights, levels)


@final
class _Workspace:
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

    def solve(self, slopes: Rows, heights: Numbers, levels: Numbers) -> Values | None:
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
        return None if any(map(isnan, found)) else np.array(found)
