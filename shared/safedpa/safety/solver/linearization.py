"""The barrier conditions linearised about one outcome: what each action changes in h, row by row."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf
from typing import Any, Final, final

from safedpa.safety.errors import NotFiniteError

__all__ = ["MARK", "Linearization"]

Plain = Sequence[float]

_ROUNDING: Final = 1e-9
"""Share by which the reach of an action is taken too far, so that no rounding error leaves a row out."""

MARK: Final = 1e-10
"""Share of a row's reach by which a solution shall exceed its condition: more than the rounding errors of the program's
solution, so that it satisfies the condition, not almost."""


@final
class Linearization:
    """h(x+) is taken as h + p'(x - x+) and x as x+ + g (a - about).

    x+ (states,) is the predicted state under ``about``, g (states, actions), ``widths`` (actions,) the actions' ranges.
    ``barriers`` have ``along`` and ``steepest``. A row's slopes p'g are computed when it is asked for, and only if some
    action might break it; ``scales`` (m,) learn what the actions can change in h by them.
    """

    def __init__(self, barriers: Any, g: list[list[float]], state: Plain, widths: list[float], scales: list[float]):
        self._barriers, self._g, self._state, self._widths = barriers, g, state, widths
        self._scales = scales
        self._rows: dict[int, list[float]] = {}
        self._changes: dict[int, float] = {}
        self._most = inf
        """By more than this no action within its range changes a row: sum_kj |p_k| |g_kj| width_j at the most."""
        steepest = barriers.steepest(state)
        if steepest is not None:
            self._most = self._furthest(steepest, widths) * (1.0 + _ROUNDING)

    def at(self, residual: Plain, action: Plain, overshoot: float) -> tuple[list[list[float]], list[float]]:
        """A (rows, actions) and b (rows,) of A a >= b for the rows that actions might break.

        ``residual`` (m,) is the true one under ``action`` (actions,). Of what a row misses there the share
        ``overshoot`` is asked for on top: what curvature will take away.
        """
        near = self._near(residual)
        slopes: list[list[float]] = []
        limits: list[float] = []
        for index in near:
            row = self._rows[index]
            rest: float = residual[index]
            total = MARK * self._changes[index] - rest
            if rest < 0.0:
                total -= overshoot * rest
            for column in range(len(row)):
                value: float = action[column]
                total += row[column] * value
            slopes.append(row)
            limits.append(total)
        return slopes, limits

    def all(self, count: int) -> list[list[float]]:
        """p'g of the rows 0 to ``count`` - 1."""
        missing = [index for index in range(count) if index not in self._rows]
        if missing:
            self._add(missing)
        return [self._rows[index] for index in range(count)]

    def _near(self, residual: Plain) -> list[int]:
        rows, most = self._rows, self._most
        near: list[int] = []
        missing: list[int] = []
        for index in range(len(residual)):
            if not residual[index] > most:
                near.append(index)
                if index not in rows:
                    missing.append(index)
        if missing:
            self._add(missing)
        return near

    def _furthest(self, steepest: Plain, widths: list[float]) -> float:
        g, reach = self._g, 0.0
        if len(steepest) != len(g):
            raise ValueError(f"the model has slopes of {len(g)} states, the barriers of {len(steepest)}")
        for index in range(len(g)):
            slope: float = steepest[index]
            row = g[index]
            for column in range(len(row)):
                reach += slope * abs(row[column]) * widths[column]
        return reach

    def _add(self, missing: list[int]) -> None:
        found: list[list[float]] = self._barriers.along(self._state, self._g, self._widths, missing)
        for place in range(len(missing)):
            row, index = found[place], missing[place]
            change = 0.0
            for column in range(len(row)):
                change += abs(row[column]) * self._widths[column]
            if change - change != 0.0:
                _refuse_infinite(row)
            if change > self._scales[index]:  # noqa: PLR1730 - max() of two floats costs a call when compiled
                self._scales[index] = change
            self._changes[index] = change
            self._rows[index] = row


def _refuse_infinite(row: list[float]) -> None:
    for value in row:
        if value - value != 0.0:
            raise NotFiniteError("gradient of h: got NaN or infinity, wanted finite numbers")
