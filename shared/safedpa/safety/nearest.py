"""The nearest point of the unit square that keeps linear conditions, in closed form where its optimality is certain.

    min  sum_j weight_j (u_j - wish_j)^2   subject to   a_i . u >= b_i,  0 <= u_j <= 1

Conditions are taken in one by one, each time the one most broken: over those taken in, the optimum lies on the newest
alone or in its corner with another one. A corner or foot is believed only if the Karush-Kuhn-Tucker conditions hold:
its multipliers are not negative, and what was taken in is kept. The optimum over some conditions that keeps all of them
is the optimum over all of them, so what is returned is the minimiser, whatever the way there.
"""

from __future__ import annotations

from typing import Final, final

__all__ = ["KEPT", "MOST", "PARALLEL", "NearestKept"]

KEPT: Final = 1e-12
"""A condition broken by less is kept: rounding errors of a corner are a thousand times smaller."""
PARALLEL: Final = 1e-9
"""Share of the product of two rows' sizes: below, their corner is not computed."""
MOST: Final = 8
"""Conditions that are taken in; then others have to answer."""


@final
class NearestKept:
    """One such problem: ``add`` its conditions, then ``solve``; the minimiser is (``x``, ``y``)."""

    def __init__(self, wish_x: float, wish_y: float, weight_x: float, weight_y: float) -> None:
        self._wish_x, self._wish_y = wish_x, wish_y
        self._weight_x, self._weight_y = weight_x, weight_y
        self._a: list[float] = [1.0, -1.0, 0.0, 0.0]
        self._b: list[float] = [0.0, 0.0, 1.0, -1.0]
        self._limit: list[float] = [0.0, -1.0, 0.0, -1.0]
        self._sum = 0.0
        self._taken: list[int] = []
        self.x, self.y = wish_x, wish_y

    def add(self, a: float, b: float, limit: float) -> None:
        """The condition a x + b y >= limit."""
        self._a.append(a)
        self._b.append(b)
        self._limit.append(limit)
        self._sum += a + b + limit

    def solve(self) -> bool:
        """Whether the minimiser was found: not where there is none, it takes many steps, or a number is not finite."""
        if self._sum - self._sum != 0.0:  # a number among them is not finite
            return False
        firsts, seconds, limits = self._a, self._b, self._limit
        for _ in range(MOST):
            worst, newest = KEPT, -1
            x, y = self.x, self.y
            for index in range(len(limits)):
                broken = limits[index] - firsts[index] * x - seconds[index] * y
                if broken > worst:
                    worst, newest = broken, index
            if newest < 0:
                return True
            if not self._takes(newest):
                return False
            self._taken.append(newest)
        return False

    def _takes(self, newest: int) -> bool:
        """Goes to the optimum over what is taken in and ``newest``, which the optimum so far breaks; False: none."""
        if self._foot(newest) and self._keeps():
            return True
        for other in self._taken:  # noqa: SIM110 - a generator would cost more than the corners
            if self._corner(other, newest) and self._keeps():
                return True
        return False

    def _foot(self, row: int) -> bool:
        """The optimum with one condition: 2 W (u - wish) = multiplier a."""
        a, b = self._a[row], self._b[row]
        along, across = a / self._weight_x, b / self._weight_y
        size = a * along + b * across
        if size == 0.0:
            return False
        share = (self._limit[row] - a * self._wish_x - b * self._wish_y) / size
        if not share >= 0.0:
            return False
        self.x, self.y = self._wish_x + share * along, self._wish_y + share * across
        return True

    def _corner(self, one: int, other: int) -> bool:
        """The optimum with two conditions: both hold with equality, 2 W (u - wish) = sum of multiplier a."""
        a, b, first = self._a[one], self._b[one], self._limit[one]
        c, d, second = self._a[other], self._b[other], self._limit[other]
        determinant = a * d - b * c
        if abs(determinant) <= PARALLEL * (abs(a) + abs(b)) * (abs(c) + abs(d)):
            return False
        x, y = (first * d - second * b) / determinant, (a * second - c * first) / determinant
        pull, push = 2.0 * self._weight_x * (x - self._wish_x), 2.0 * self._weight_y * (y - self._wish_y)
        if not (pull * d - push * c) / determinant >= 0.0:
            return False
        if not (a * push - b * pull) / determinant >= 0.0:
            return False
        self.x, self.y = x, y
        return True

    def _keeps(self) -> bool:
        """Whether the point keeps all that is taken in."""
        for row in self._taken:  # noqa: SIM110 - a generator would cost as much as all of it
            if not self._limit[row] - self._a[row] * self.x - self._b[row] * self.y <= KEPT:
                return False
        return True
