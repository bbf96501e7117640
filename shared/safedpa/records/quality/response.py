"""How the states of a log answer to states and commands: one regression that checks of channels compare.

For each state x over a window of m rows, x[k + m] - x[k] = T sum_f theta_f mean(f). T is the duration of the window;
f are states, commands of the window and of up to three windows before (for lags and delays), their products, and what
turns with an angle. It is linear in theta, so a changed channel is judged by one more least-squares fit. No physics is
assumed beyond that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.records.run import RawRows, Stretch
from safedpa.systems import System

__all__ = ["Response", "Sums", "response_of", "without_worst"]

_SHORTEST, _LONGEST = 4, 20
"""Rows of a window: as few as show a change of this many standard deviations of the noise."""
_CLEAR = 15.0
_HISTORY = 3
"""Windows before the current one whose commands are regressors."""
_MOST_WINDOWS = 1000
_LEAST_WINDOWS = 200
_PER_FEATURE = 6
"""Fewest windows for each regressor; with fewer only states and commands themselves are regressors."""
_STAND, _AROUND = 20, 80
"""Rows in which a state reads the same, and rows around them, in which brakes and stops act."""
_TURNS = 0.3
"""rad; an angle that moves less needs no sine and cosine."""
_RIDGE = 1e-7
_PERFECT = 3e-5
"""Share of the squared changes that is always added to what is unexplained: simulated logs have no noise."""
_MOST_ROWS, _THINNED = 8000, 10
"""Rows of a longer log are thinned by up to this factor; of a still longer one, evenly spread pieces are used."""
_PIECE = 200
"""Rows of such a piece."""


@dataclass(frozen=True)
class Sums:
    """Sums of products over windows: regressors (p, p), with changes (p, states), and squared changes (states,)."""

    gram: NDArray[np.float64]
    moment: NDArray[np.float64]
    power: FloatArray
    count: int

    def __add__(self, other: Sums) -> Sums:
        return Sums(
            self.gram + other.gram, self.moment + other.moment, self.power + other.power, self.count + other.count
        )

    def scaled(self, factors: FloatArray) -> Sums:
        """The sums as they are after each regressor is multiplied by its factor."""
        gram, moment = self.gram * factors * factors[:, None], self.moment * factors[:, None]
        return Sums(gram, moment, self.power, self.count)

    def where(self, retained: NDArray[np.bool_]) -> Sums:
        """The sums with some of the regressors only."""
        return Sums(self.gram[np.ix_(retained, retained)], self.moment[retained], self.power, self.count)

    def solution(self) -> NDArray[np.float64]:
        """theta (p, states) by least squares; a little ridge separates equal regressors."""
        size = self.gram.shape[0]
        ridge = _RIDGE * float(np.trace(self.gram)) / size
        return np.asarray(np.linalg.solve(self.gram + ridge * np.eye(size), self.moment))

    def rest(self, solution: NDArray[np.float64] | None = None) -> FloatArray:
        """Sum of squared residuals of each state (states,), with its own solution or a given one."""
        theta = self.solution() if solution is None else solution
        explained = 2.0 * (theta * self.moment).sum(axis=0) - (theta * (self.gram @ theta)).sum(axis=0)
        return np.asarray(np.maximum(self.power - explained, 0.0) + _PERFECT * self.power + 1e-300)


@dataclass(frozen=True)
class Response:
    """Windows of a log: ``start`` is the first row of each, and ``rows`` how many rows each has."""

    t: FloatArray
    states: NDArray[np.float64]
    actions: NDArray[np.float64]
    system: System
    start: NDArray[np.intp]
    rows: int
    simple: bool = False
    scale: FloatArray = field(default_factory=lambda: np.empty(0))

    def design(
        self, states: NDArray[np.float64] | None = None, actions: NDArray[np.float64] | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Regressors (windows, p) and changes (windows, states), for other values of some channels if given."""
        x, u = self.states if states is None else states, self.actions if actions is None else actions
        k, m = self.start, self.rows
        columns, factors = self._columns(x)
        means = self._means(columns, x=True)(k, k + m)
        command = self._means(u, x=False)
        half = k + m - m // 2
        parts = [(k, half), (half, k + m), *((k - (back + 1) * m, k - back * m) for back in range(_HISTORY))]
        found = [np.ones((len(k), 1)), means, *(command(low, high) for low, high in parts)]
        if not self.simple:
            around = means[:, factors]
            for mean in (command(k, k + m), command(k - m, k)):
                found += [mean[:, [index]] * around for index in range(u.shape[1])]
                found += [mean[:, [one]] * mean[:, [other]] for one, other in self._pairs]
        seconds = self.t[k + m] - self.t[k]
        return np.concatenate(found, axis=1) * (seconds / np.median(seconds))[:, None], x[k + m] - x[k]

    @cached_property
    def powers(self) -> NDArray[np.intp]:
        """How often each command is a factor of each regressor (p, actions)."""
        count = self.actions.shape[1]
        one = np.eye(count, dtype=np.intp)
        columns, factors = self._columns(self.states[:2])
        found = [np.zeros((1 + columns.shape[1], count), dtype=np.intp), *([one] * (2 + _HISTORY))]
        if not self.simple:
            for _ in range(2):
                found += [np.repeat(one[[index]], len(factors), axis=0) for index in range(count)]
                found += [(one[first] + one[second])[None] for first, second in self._pairs]
        return np.concatenate(found)

    @cached_property
    def _pairs(self) -> list[tuple[int, int]]:
        count = self.actions.shape[1]
        return [(one, other) for one in range(count) for other in range(one + 1, count)]

    @cached_property
    def _turning(self) -> list[int]:
        angles = [at for at, item in enumerate(self.system.state) if item.unit == "rad"]
        return [at for at in angles if np.ptp(self.states[:, at]) > _TURNS]

    def _columns(self, x: NDArray[np.float64]) -> tuple[NDArray[np.float64], list[int]]:
        """States and their products (rows, columns), and which of them multiply commands."""
        rates = [at for at, item in enumerate(self.system.state) if item.unit.endswith("/s")]
        turned = np.concatenate([np.sin(x[:, self._turning]), np.cos(x[:, self._turning])], axis=1)
        columns = [x, turned]
        if not self.simple:
            for place, at in enumerate(rates):
                columns += [np.abs(x[:, [at]]) * x[:, [at]], x[:, [at]] * turned, x[:, [at]] * x[:, rates[place:]]]
            columns += [] if rates else [x**2]
        size = x.shape[1]
        return np.concatenate(columns, axis=1), [*(rates or range(size)), *range(size, size + turned.shape[1])]

    def _means(self, values: NDArray[np.float64], *, x: bool) -> _Means:
        return _Means(self.t, values, between=x)

    def sums(
        self,
        states: NDArray[np.float64] | None = None,
        actions: NDArray[np.float64] | None = None,
        parts: Sequence[NDArray[np.intp]] | None = None,
    ) -> list[Sums]:
        """Sums over each part of the windows (indices; default: all of them in one part)."""
        matrix, changes = self.design(states, actions)
        matrix = matrix / (self.scale if len(self.scale) else 1.0)
        return [
            Sums(
                matrix[part].T @ matrix[part],
                matrix[part].T @ changes[part],
                (changes[part] ** 2).sum(axis=0),
                len(part),
            )
            for part in (parts if parts is not None else [np.arange(len(matrix))])
        ]


def _sums(matrix: NDArray[np.float64], changes: NDArray[np.float64]) -> Sums:
    return Sums(matrix.T @ matrix, matrix.T @ changes, (changes**2).sum(axis=0), len(matrix))


def without_worst(response: Response, share: float) -> Response:
    """The response without the windows that the regression explains worst, such as impacts and emergency brakes."""
    matrix, changes = response.design()
    rest = changes - matrix / response.scale @ response.sums()[0].solution()
    worst = np.abs(rest / (1.4826 * np.median(np.abs(rest), axis=0) + 1e-300)).max(axis=1)
    return replace(response, start=response.start[worst <= np.quantile(worst, 1.0 - share)])


class _Means:
    """Means of columns over ranges of rows: straight between rows, or held until the next one."""

    def __init__(self, t: FloatArray, values: NDArray[np.float64], *, between: bool) -> None:
        inner = 0.5 * (values[1:] + values[:-1]) if between else values[:-1]
        self._area = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(inner * np.diff(t)[:, None], axis=0)])
        self._t = t

    def __call__(self, low: NDArray[np.intp], high: NDArray[np.intp]) -> NDArray[np.float64]:
        return np.asarray((self._area[high] - self._area[low]) / (self._t[high] - self._t[low])[:, None])


def response_of(rows: RawRows, stretches: Sequence[Stretch], system: System, window: int = 0) -> Response | None:
    """The windows of a log within its stretches, in which every state changes; None if they are too few.

    Where a state reads the same throughout, the robot or its sensor stands, and other rules hold. ``window`` fixes the
    rows of a window.
    """
    if not system.action or not system.state:
        return None
    usable = [part for part in stretches if np.isfinite(rows.states[part.start : part.stop]).all()]
    if not usable:
        return None
    pieces = _pieces(usable)
    inside = rows.taken(np.concatenate(pieces))
    t, x, u = inside.t, inside.states, inside.actions
    bounds = np.cumsum([0, *map(len, pieces)])
    parts = [Stretch(int(low), int(high)) for low, high in pairwise(bounds)]
    length = window or _window(x, parts)
    reach = _HISTORY * length
    start = np.concatenate([np.arange(part.start + reach, part.stop - length) for part in parts])
    start = start[_moving(x, start, length)]
    if len(start) < _LEAST_WINDOWS:
        return None
    if not window:
        start = start[:: max(1, -(-len(start) // _MOST_WINDOWS))]
    found = Response(t, x, u, system, start, length)
    simple = found.powers.shape[0] * _PER_FEATURE > len(start)
    found = replace(found, simple=simple)
    return replace(found, scale=np.sqrt((found.design()[0] ** 2).mean(axis=0)) + 1e-12)


def _pieces(stretches: Sequence[Stretch]) -> list[NDArray[np.intp]]:
    """Rows of each stretch; of a long log every so many of them, and of a still longer one pieces."""
    total = sum(len(part) for part in stretches)
    step = min(_THINNED, -(-total // _MOST_ROWS))
    found = [np.arange(part.start, part.stop, step) for part in stretches]
    every = -(-total // (step * _MOST_ROWS))
    if every > 1:
        blocks = [rows[at : at + _PIECE] for rows in found for at in range(0, len(rows), _PIECE)]
        found = blocks[::every]
    return found


def _moving(x: NDArray[np.float64], start: NDArray[np.intp], length: int) -> NDArray[np.bool_]:
    """Windows in which every state changes, not close to a longer time in which one does not."""
    same = np.diff(x, axis=0) == 0.0
    moved = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(~same, axis=0)])
    stands = np.zeros(len(x), dtype=bool)
    for column in range(x.shape[1]):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], same[:, column], [False]]).astype(np.int8)))
        for low, high in edges.reshape(-1, 2)[np.diff(edges.reshape(-1, 2)).ravel() >= _STAND].tolist():
            stands[max(0, low - _AROUND) : high + _AROUND] = True
    return np.asarray((moved[start + length] > moved[start]).all(axis=1) & ~stands[start])


def _window(states: NDArray[np.float64], stretches: Sequence[Stretch]) -> int:
    """Rows of a window in which half of the states change clearly more than their noise."""
    longest = max(stretches, key=len, default=Stretch(0, 0))
    x = states[longest.start : longest.stop]
    if len(x) <= 2 * _LONGEST:
        return _SHORTEST
    # the second difference of a smooth signal is its noise, of variance 6; 0.455 is the median of chi squared
    noise = np.sqrt(np.median((x[2:] - 2.0 * x[1:-1] + x[:-2]) ** 2, axis=0) / 0.455 / 6.0) + 1e-300
    for rows in range(_SHORTEST, _LONGEST):
        change = np.sqrt(np.mean((x[rows:] - x[:-rows]) ** 2, axis=0))
        if float(np.median(change / noise)) > _CLEAR * np.sqrt(2.0):
            return rows
    return _LONGEST
