"""The nearest point of the unit square to a nominal action, where conditions hold, and where some of them cost slack.

    min  sum_j weight_j (u_j - nominal_j)^2   subject to   a_i . u >= b_i,  0 <= u_j <= 1

Conditions are taken in one by one, each time the one most broken: over those taken in, the optimum lies on the newest
alone or in its corner with another one. A corner or foot is believed only if the Karush-Kuhn-Tucker conditions hold:
its multipliers are not negative, and what was taken in is kept. The optimum over some conditions that keeps all of them
is the optimum over all of them, so what is returned is the minimiser, whatever the way there.

    min  sum_j weight_j (u_j - nominal_j)^2 + sum_i (rho1 s_i + rho s_i^2)
    subject to   a_i . u + s_i >= b_i,   s_i >= 0,   0 <= u_j <= 1

With s_i = max(0, b_i - a_i . u) that is a convex function of u: quadratic between the lines a_i . u = b_i, with an edge
along each of them. The primal active-set method (Nocedal and Wright, Numerical Optimization, 2nd edition, section 16.5)
goes down in it, from the nominal action: to the minimum of the piece that it is on, or to the first line on the way, which it
then holds. A condition pulls with its price, rho1 + 2 rho s_i where it is short, 0 where it is kept, anything between 0
and rho1 on its line, and a bound with anything from 0 on. A line whose price is another is let go, to the side that the
price tells. Where no price is another and the piece goes down no further, the Karush-Kuhn-Tucker conditions hold: of a
convex problem that is the minimum.
"""

from __future__ import annotations

from typing import Final, final

__all__ = [
    "FAINT",
    "KEPT",
    "LINEAR",
    "MOST",
    "PARALLEL",
    "QP2D",
    "QUADRATIC",
    "HardQP2D",
    "SoftQP2D",
]

KEPT: Final = 1e-12
"""A condition broken by less is kept: rounding errors of a corner are a thousand times smaller."""
PARALLEL: Final = 1e-9
"""Share of the product of two rows' sizes: below, their corner is not computed."""
MOST: Final = 8
"""Conditions that are taken in; then others have to answer."""

LINEAR: Final = 1e4
"""rho1: price of slack, as a share of what the actions can change in its condition. A condition is given up only where
a ten-thousandth of that would cost the whole range of an action."""
QUADRATIC: Final = 1e5
"""rho: price of the same slack squared: of two that must be given up, neither wholly."""

TURNS: Final = 32
"""Steps and lines let go; then others have to answer. Problems of a drive take two to four."""
STILL: Final = 1e-10
"""A step that is shorter is none: along two lines that contradict each other rounding alone makes some of 1e-11."""
PRICED: Final = 1e-9
"""By how much a price may be another: some rounding errors of it. Times half of 1 / weight it is an error of u."""
FAINT: Final = 1e-6
"""A weight below which such an error of a price would be one of u that counts; then others have to answer."""
_ALONG: Final = 1e-12
"""Cosine below which a line is taken to be parallel to a step, and is not met."""
_BOUNDS: Final = 4


class QP2D:
    """A nominal action and weights; the square's four sides are the first conditions."""

    def __init__(self, nominal_x: float, nominal_y: float, weight_x: float, weight_y: float) -> None:
        self._nominal_x, self._nominal_y = nominal_x, nominal_y
        self._weight_x, self._weight_y = weight_x, weight_y
        self._a: list[float] = [1.0, -1.0, 0.0, 0.0]
        self._b: list[float] = [0.0, 0.0, 1.0, -1.0]
        self._limit: list[float] = [0.0, -1.0, 0.0, -1.0]
        self._sum = nominal_x + nominal_y
        """Of all numbers given: finite where they all are."""

    def add(self, a: float, b: float, limit: float) -> None:
        """The condition a x + b y >= limit, or with slack a x + b y + s >= limit."""
        self._a.append(a)
        self._b.append(b)
        self._limit.append(limit)
        self._sum += a + b + limit


@final
class HardQP2D(QP2D):
    """One such problem: ``add`` its conditions, then ``solve``; the minimiser is (``x``, ``y``)."""

    def __init__(self, nominal_x: float, nominal_y: float, weight_x: float, weight_y: float) -> None:
        super().__init__(nominal_x, nominal_y, weight_x, weight_y)
        self._taken: list[int] = []
        self.x, self.y = nominal_x, nominal_y

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
        """The optimum with one condition: 2 W (u - nominal) = multiplier a."""
        a, b = self._a[row], self._b[row]
        along, across = a / self._weight_x, b / self._weight_y
        size = a * along + b * across
        if size == 0.0:
            return False
        share = (self._limit[row] - a * self._nominal_x - b * self._nominal_y) / size
        if not share >= 0.0:
            return False
        self.x, self.y = self._nominal_x + share * along, self._nominal_y + share * across
        return True

    def _corner(self, one: int, other: int) -> bool:
        """The optimum with two conditions: both hold with equality, 2 W (u - nominal) = sum of multiplier a."""
        a, b, first = self._a[one], self._b[one], self._limit[one]
        c, d, second = self._a[other], self._b[other], self._limit[other]
        determinant = a * d - b * c
        if abs(determinant) <= PARALLEL * (abs(a) + abs(b)) * (abs(c) + abs(d)):
            return False
        x, y = (first * d - second * b) / determinant, (a * second - c * first) / determinant
        pull, push = 2.0 * self._weight_x * (x - self._nominal_x), 2.0 * self._weight_y * (y - self._nominal_y)
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


@final
class SoftQP2D(QP2D):
    """One such problem: ``add`` its conditions, then ``solve``; the minimiser is (``x``, ``y``)."""

    def __init__(self, nominal_x: float, nominal_y: float, weight_x: float, weight_y: float) -> None:
        super().__init__(nominal_x, nominal_y, weight_x, weight_y)
        self._short: list[bool] = [False] * _BOUNDS
        """Which conditions are not satisfied; a line that is held is neither short nor kept."""
        self._one, self._other = -1, -1
        """Lines held, ``_one`` before ``_other``; -1: none."""
        self.x, self.y = 0.0, 0.0
        self._down_x, self._down_y = 0.0, 0.0
        """Where the function falls, that is minus its slopes, without what the lines held pull."""
        self._xx, self._xy, self._yy = 0.0, 0.0, 0.0
        """Its second derivatives."""

    def solve(self) -> bool:
        """Whether the minimiser was found: not after many steps, where a number is not finite or a weight is faint."""
        if self._sum - self._sum != 0.0 or not (self._weight_x >= FAINT and self._weight_y >= FAINT):
            return False
        self.x = min(max(self._nominal_x, 0.0), 1.0)
        self.y = min(max(self._nominal_y, 0.0), 1.0)
        for row in range(_BOUNDS, len(self._limit)):
            self._short.append(self._a[row] * self.x + self._b[row] * self.y < self._limit[row])
        for _ in range(TURNS):
            self._pulls()
            if not self._goes_down() and not self._lets_go():
                return self.x - self.x == 0.0 and self.y - self.y == 0.0  # no number goes down no further either
        return False

    def _pulls(self) -> None:
        """Slopes and second derivatives of the piece."""
        down_x = 2.0 * self._weight_x * (self._nominal_x - self.x)
        down_y = 2.0 * self._weight_y * (self._nominal_y - self.y)
        xx, xy, yy = 2.0 * self._weight_x, 0.0, 2.0 * self._weight_y
        for row in range(_BOUNDS, len(self._limit)):
            if self._short[row]:
                a, b = self._a[row], self._b[row]
                price = LINEAR + 2.0 * QUADRATIC * (self._limit[row] - a * self.x - b * self.y)
                down_x += price * a
                down_y += price * b
                xx += 2.0 * QUADRATIC * a * a
                xy += 2.0 * QUADRATIC * a * b
                yy += 2.0 * QUADRATIC * b * b
        self._down_x, self._down_y = down_x, down_y
        self._xx, self._xy, self._yy = xx, xy, yy

    def _goes_down(self) -> bool:
        """A step to the piece's minimum on the line held, if any, or to the first other line; False: it is there."""
        if self._other >= 0:
            return False
        if self._one >= 0:
            along, across = -self._b[self._one], self._a[self._one]
            bend = along * along * self._xx + 2.0 * along * across * self._xy + across * across * self._yy
            share = (along * self._down_x + across * self._down_y) / bend
            step_x, step_y = share * along, share * across
        else:
            determinant = self._xx * self._yy - self._xy * self._xy
            step_x = (self._yy * self._down_x - self._xy * self._down_y) / determinant
            step_y = (self._xx * self._down_y - self._xy * self._down_x) / determinant
        if not abs(step_x) + abs(step_y) > STILL:
            return False
        self._walk(step_x, step_y)
        return True

    def _walk(self, step_x: float, step_y: float) -> None:
        """Goes the way of the step to its lowest point; a line that it ends on is held then."""
        slope = -(self._down_x * step_x + self._down_y * step_y)
        bend = step_x * step_x * self._xx + 2.0 * step_x * step_y * self._xy + step_y * step_y * self._yy
        least_bend = 2.0 * (self._weight_x * step_x * step_x + self._weight_y * step_y * step_y)
        here, met = 0.0, -1
        for _ in range(len(self._limit) + 1):  # each line is passed once at the most
            way, rate, met = self._first_met(step_x, step_y, here - slope / bend)
            way = max(way, here)
            slope += bend * (way - here)
            here = way
            if met < _BOUNDS or slope + LINEAR * abs(rate) >= 0.0:
                break
            slope += LINEAR * abs(rate)  # lower still, on the other side
            bend += 2.0 * QUADRATIC * (rate * rate if rate < 0.0 else -(rate * rate))
            bend = max(bend, least_bend)
            self._short[met] = rate < 0.0
        self.x = min(max(self.x + here * step_x, 0.0), 1.0)
        self.y = min(max(self.y + here * step_y, 0.0), 1.0)
        if met < 0:
            return
        if met < _BOUNDS:  # exactly: what was rounded is no bound
            end = -self._limit[met]
            self.x, self.y = (end, self.y) if met < 2 else (self.x, end)
        self._short[met] = False
        if self._one < 0:
            self._one = met
        else:
            self._other = met

    def _first_met(self, step_x: float, step_y: float, end: float) -> tuple[float, float, int]:
        """Share of the step, change per share and place of the first line that is met before ``end``; else that, -1."""
        share, change, met = end, 0.0, -1
        none = _ALONG * (abs(step_x) + abs(step_y))
        for row in range(len(self._limit)):
            if row == self._one:
                continue
            a, b = self._a[row], self._b[row]
            rate = a * step_x + b * step_y
            if not abs(rate) > none * (abs(a) + abs(b)) or (rate > 0.0) != self._short[row]:
                continue  # along it, or away from it
            way = (self._limit[row] - a * self.x - b * self.y) / rate
            if way < share:
                share, change, met = way, rate, row
        return share, change, met

    def _lets_go(self) -> bool:
        """Lets the line go whose price is furthest from what it may be; False: none."""
        if self._one < 0:
            return False
        a, b = self._a[self._one], self._b[self._one]
        if self._other < 0:
            return self._let_go((a * self._down_x + b * self._down_y) / -(a * a + b * b), 0.0)
        c, d = self._a[self._other], self._b[self._other]
        determinant = b * c - a * d
        one = (d * self._down_x - c * self._down_y) / determinant
        other = (a * self._down_y - b * self._down_x) / determinant
        return self._let_go(one, other)

    def _let_go(self, one: float, other: float) -> bool:
        """By the prices of both lines."""
        first, second = _exceeds_bounds(one, self._one), _exceeds_bounds(other, self._other)
        if not max(first, second) > PRICED:
            return False
        if first >= second:
            gone, price = self._one, one
            self._one = self._other
        else:
            gone, price = self._other, other
        self._other = -1
        self._short[gone] = price > 0.0
        return True


def _exceeds_bounds(price: float, line: int) -> float:
    """By how much a price is not what it may be."""
    dear = price - LINEAR if line >= _BOUNDS else 0.0
    return dear if dear > -price else -price
