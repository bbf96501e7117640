"""The CBF constraints linearised about one candidate: the Lie derivative p'g of each row."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf
from typing import Any, Final, final

from safedpa.safety.errors import NotFiniteError

__all__ = ["MARK", "Linearization"]

Plain = Sequence[float]

_ROUNDING: Final = 1e-9
"""Share by which the bound on a row's change is enlarged, so that no rounding error leaves a row out."""

MARK: Final = 1e-10
"""Share of a row's reach by which a solution shall exceed its constraint: more than the rounding errors of the solver,
so that the solution satisfies the constraint exactly."""


@final
class Linearization:
    """h(x+) is approximated by h + p'(x - x+), and x by x+ + g (a - about).

    x+ (states,) is the predicted state under ``about``, g (states, actions), ``widths`` (actions,) the actions' ranges.
    ``barriers`` have ``lie_derivative_floats`` and ``grad_bound``. A row p'g is computed when it is first needed, and
    only if some action might violate it. ``scales`` (m,) are raised to what the actions can change in h.
    """

    def __init__(self, barriers: Any, g: list[list[float]], state: Plain, widths: list[float], scales: list[float]):
        self._barriers, self._g, self._state, self._widths = barriers, g, state, widths
        self._scales = scales
        self._rows: dict[int, list[float]] = {}
        self._changes: dict[int, float] = {}
        self._reach = inf
        """No action within its range changes a row by more: sum_kj |p_k| |g_kj| width_j."""
        grad_bound = barriers.grad_bound(state)
        if grad_bound is not None:
            self._reach = self._largest_change(grad_bound, widths) * (1.0 + _ROUNDING)

    def at(self, residual: Plain, action: Plain, overshoot: float) -> tuple[list[list[float]], list[float]]:
        """Returns A (rows, actions) and b (rows,) of A a >= b for the rows that some action might violate.

        ``residual`` (m,) is the true one under ``action`` (actions,). ``overshoot`` is the share of a violation that is
        requested on top, to compensate for the curvature of h.
        """
        near = self._rows_in_reach(residual)
        A: list[list[float]] = []
        b: list[float] = []
        for index in near:
            row = self._rows[index]
            residual_now: float = residual[index]
            # The true residual, not the linearised one: successive programs then converge to the model's own boundary.
            limit = MARK * self._changes[index] - residual_now
            if residual_now < 0.0:
                limit -= overshoot * residual_now
            for column in range(len(row)):
                value: float = action[column]
                limit += row[column] * value
            A.append(row)
            b.append(limit)
        return A, b

    def all(self, count: int) -> list[list[float]]:
        """The rows p'g with indices 0 to ``count`` - 1."""
        # Computed rows are kept: the max-min program needs all of them, the QP only some.
        unknown = [index for index in range(count) if index not in self._rows]
        if unknown:
            self._compute_rows(unknown)
        return [self._rows[index] for index in range(count)]

    # Most obstacles are far away: skipping their gradients is the largest single saving of a decision.
    def _rows_in_reach(self, residual: Plain) -> list[int]:
        rows, reach = self._rows, self._reach
        near: list[int] = []
        unknown: list[int] = []
        for index in range(len(residual)):
            # Written as "not >", so that a residual of NaN keeps its row.
            if not residual[index] > reach:
                near.append(index)
                if index not in rows:
                    unknown.append(index)
        if unknown:
            self._compute_rows(unknown)
        return near

    def _largest_change(self, grad_bound: Plain, widths: list[float]) -> float:
        g, reach = self._g, 0.0
        if len(grad_bound) != len(g):
            raise ValueError(f"the model has slopes of {len(g)} states, the barriers of {len(grad_bound)}")
        for index in range(len(g)):
            bound: float = grad_bound[index]
            row = g[index]
            for column in range(len(row)):
                reach += bound * abs(row[column]) * widths[column]
        return reach

    def _compute_rows(self, unknown: list[int]) -> None:
        found: list[list[float]] = self._barriers.lie_derivative_floats(self._state, self._g, self._widths, unknown)
        for place in range(len(unknown)):
            row, index = found[place], unknown[place]
            change = 0.0
            for column in range(len(row)):
                change += abs(row[column]) * self._widths[column]
            # x - x is NaN for infinity and NaN: the row is scanned only if its sum is not finite.
            if change - change != 0.0:
                _require_finite(row)
            # Only ever raised: residuals of earlier candidates stay comparable.
            self._scales[index] = max(self._scales[index], change)
            self._changes[index] = change
            self._rows[index] = row


def _require_finite(row: list[float]) -> None:
    for value in row:
        if value - value != 0.0:
            raise NotFiniteError("gradient of h: got NaN or infinity, wanted finite numbers")
