"""Two-dimensional quadratic programs in the unit square by active sets: with hard constraints, and with slack.

``HardQP2D``:

    min  sum_j weight_j (u_j - nominal_j)^2   subject to   a_i . u >= b_i,  0 <= u_j <= 1

Constraints become active one by one, each time the one most violated. The optimum over the active ones lies on the
newest line alone or at its intersection with another. A point is accepted only if the Karush-Kuhn-Tucker (KKT)
conditions hold: its multipliers are not negative and the active constraints are satisfied. An optimum over some
constraints that satisfies all of them is the optimum over all, so the result is the minimiser whatever the order.

``SoftQP2D``:

    min  sum_j weight_j (u_j - nominal_j)^2 + sum_i (rho1 s_i + rho s_i^2)
    subject to   a_i . u + s_i >= b_i,   s_i >= 0,   0 <= u_j <= 1

With s_i = max(0, b_i - a_i . u) this is a convex function of u, quadratic between the lines a_i . u = b_i, with a kink
on each line. The primal active-set method (Nocedal and Wright, Numerical Optimization, 2nd edition, section 16.5)
descends from the nominal action: to the minimum of the current piece, or to the first line on the step, which becomes
active. The multiplier (price) of a constraint is rho1 + 2 rho s_i where it is violated, 0 where it is satisfied, and
between 0 and rho1 on its line; that of a bound is 0 or more. An active line whose price is outside this interval is
dropped, to the side that its sign shows. If all prices are inside and the piece descends no further, the KKT conditions
hold: the problem is convex, so this is the minimum.
"""

from __future__ import annotations

from typing import Final, final

__all__ = [
    "FEASIBILITY_TOLERANCE",
    "LINEAR_PRICE",
    "MAX_ACTIVE",
    "MIN_WEIGHT",
    "PARALLEL_TOLERANCE",
    "QP2D",
    "QUADRATIC_PRICE",
    "HardQP2D",
    "SoftQP2D",
]

FEASIBILITY_TOLERANCE: Final = 1e-12
"""A constraint violated by less counts as satisfied: rounding errors of a corner are a thousand times smaller."""
PARALLEL_TOLERANCE: Final = 1e-9
"""Share of the product of two rows' norms; with a smaller determinant their intersection is not computed."""
MAX_ACTIVE: Final = 8
"""Largest number of active constraints; beyond it the caller uses the general solver."""

LINEAR_PRICE: Final = 1e4
"""rho1: price of slack, relative to what the actions can change in its constraint. A constraint is violated only if
satisfying a ten-thousandth of that would take the whole range of an action."""
QUADRATIC_PRICE: Final = 1e5
"""rho: price of the same slack squared; of two constraints that conflict it shares the violation between both."""

MAX_STEPS: Final = 32
"""Largest number of steps and dropped lines; beyond it the general solver is used. A drive takes two to four."""
MIN_STEP: Final = 1e-10
"""A shorter step counts as none: with two contradicting lines rounding alone makes steps of 1e-11."""
PRICE_TOLERANCE: Final = 1e-9
"""Tolerance of a price, some of its rounding errors. Times half of 1 / weight it is an error of u."""
MIN_WEIGHT: Final = 1e-6
"""Below this weight such an error of a price would be a visible error of u; the caller uses the general solver."""
_PARALLEL_COSINE: Final = 1e-12
"""Cosine below which a line counts as parallel to a step, so that they do not intersect."""
_BOUNDS: Final = 4


class QP2D:
    """The data of a problem: a nominal action, weights and constraints, of which the first four are the unit square."""

    def __init__(self, nominal_x: float, nominal_y: float, weight_x: float, weight_y: float) -> None:
        self._nominal_x, self._nominal_y = nominal_x, nominal_y
        self._weight_x, self._weight_y = weight_x, weight_y
        self._a: list[float] = [1.0, -1.0, 0.0, 0.0]
        self._b: list[float] = [0.0, 0.0, 1.0, -1.0]
        self._limit: list[float] = [0.0, -1.0, 0.0, -1.0]
        self._sum = nominal_x + nominal_y
        """Sum of all numbers given: finite only if each of them is."""

    def add(self, a: float, b: float, limit: float) -> None:
        """Adds the constraint a x + b y >= limit, or with slack a x + b y + s >= limit."""
        self._a.append(a)
        self._b.append(b)
        self._limit.append(limit)
        self._sum += a + b + limit


@final
class HardQP2D(QP2D):
    """A problem with hard constraints: ``add`` them, then ``solve``; the minimiser is (``x``, ``y``)."""

    def __init__(self, nominal_x: float, nominal_y: float, weight_x: float, weight_y: float) -> None:
        super().__init__(nominal_x, nominal_y, weight_x, weight_y)
        self._active: list[int] = []
        # The unconstrained minimum; every constraint that it violates becomes active in turn.
        self.x, self.y = nominal_x, nominal_y

    def solve(self) -> bool:
        """Returns whether the minimiser was found; False if there is none, after many steps, or for NaN."""
        if self._sum - self._sum != 0.0:  # NaN or infinity among the data
            return False
        a, b, limits = self._a, self._b, self._limit
        for _ in range(MAX_ACTIVE):
            # The most violated constraint first: it is active at the optimum more often than any other.
            worst, newest = FEASIBILITY_TOLERANCE, -1
            x, y = self.x, self.y
            for index in range(len(limits)):
                broken = limits[index] - a[index] * x - b[index] * y
                if broken > worst:
                    worst, newest = broken, index
            if newest < 0:
                return True
            if not self._add_to_active_set(newest):
                return False
            self._active.append(newest)
        return False

    def _add_to_active_set(self, newest: int) -> bool:
        """Moves to the optimum over the active constraints and ``newest``, which the point violates; False if none."""
        if self._project_on_line(newest) and self._satisfies_active():
            return True
        for other in self._active:  # noqa: SIM110 - a generator would take longer than the corners
            if self._solve_corner(other, newest) and self._satisfies_active():
                return True
        return False

    def _project_on_line(self, row: int) -> bool:
        """The optimum with one active constraint: 2 W (u - nominal) = multiplier a."""
        a, b = self._a[row], self._b[row]
        along, across = a / self._weight_x, b / self._weight_y
        size = a * along + b * across
        if size == 0.0:
            return False
        share = (self._limit[row] - a * self._nominal_x - b * self._nominal_y) / size
        # Not >= also refuses NaN. A negative multiplier would mean that the constraint is not active.
        if not share >= 0.0:
            return False
        self.x, self.y = self._nominal_x + share * along, self._nominal_y + share * across
        return True

    def _solve_corner(self, one: int, other: int) -> bool:
        """The optimum with two active constraints: both hold with equality, 2 W (u - nominal) = sum of multiplier a."""
        a, b, first = self._a[one], self._b[one], self._limit[one]
        c, d, second = self._a[other], self._b[other], self._limit[other]
        determinant = a * d - b * c
        # Nearly parallel lines intersect far outside the unit square, at a point that is mostly rounding error.
        if abs(determinant) <= PARALLEL_TOLERANCE * (abs(a) + abs(b)) * (abs(c) + abs(d)):
            return False
        x, y = (first * d - second * b) / determinant, (a * second - c * first) / determinant
        pull, push = 2.0 * self._weight_x * (x - self._nominal_x), 2.0 * self._weight_y * (y - self._nominal_y)
        # Both multipliers by Cramer's rule; a negative one means that its constraint would be inactive at the optimum.
        if not (pull * d - push * c) / determinant >= 0.0:
            return False
        if not (a * push - b * pull) / determinant >= 0.0:
            return False
        self.x, self.y = x, y
        return True

    def _satisfies_active(self) -> bool:
        """Whether the point satisfies all active constraints."""
        for row in self._active:
            if not self._limit[row] - self._a[row] * self.x - self._b[row] * self.y <= FEASIBILITY_TOLERANCE:
                return False
        return True


@final
class SoftQP2D(QP2D):
    """A problem with slack: ``add`` its constraints, then ``solve``; the minimiser is (``x``, ``y``)."""

    def __init__(self, nominal_x: float, nominal_y: float, weight_x: float, weight_y: float) -> None:
        super().__init__(nominal_x, nominal_y, weight_x, weight_y)
        self._violated: list[bool] = [False] * _BOUNDS
        """Which constraints are violated; an active line counts as not violated."""
        self._first_line, self._second_line = -1, -1
        """Active lines, the first one filled first; -1: none."""
        self.x, self.y = 0.0, 0.0
        self._neg_grad_x, self._neg_grad_y = 0.0, 0.0
        """Minus the gradient of the current piece, without the forces of the active lines."""
        self._hess_xx, self._hess_xy, self._hess_yy = 0.0, 0.0, 0.0
        """The Hessian of the current piece."""

    def solve(self) -> bool:
        """Returns whether the minimiser was found; False after many steps, for NaN and infinity, or a tiny weight."""
        if self._sum - self._sum != 0.0 or not (self._weight_x >= MIN_WEIGHT and self._weight_y >= MIN_WEIGHT):
            return False
        # The start must lie within the bounds: a bound has no slack, so the method never leaves them.
        self.x = min(max(self._nominal_x, 0.0), 1.0)
        self.y = min(max(self._nominal_y, 0.0), 1.0)
        for row in range(_BOUNDS, len(self._limit)):
            self._violated.append(self._a[row] * self.x + self._b[row] * self.y < self._limit[row])
        for _ in range(MAX_STEPS):
            self._update_derivatives()
            if not self._descend() and not self._drop_from_active_set():
                # NaN also ends the loop, since no comparison with it is true: it must not be returned.
                return self.x - self.x == 0.0 and self.y - self.y == 0.0
        return False

    def _update_derivatives(self) -> None:
        """Gradient and Hessian of the current piece."""
        down_x = 2.0 * self._weight_x * (self._nominal_x - self.x)
        down_y = 2.0 * self._weight_y * (self._nominal_y - self.y)
        xx, xy, yy = 2.0 * self._weight_x, 0.0, 2.0 * self._weight_y
        for row in range(_BOUNDS, len(self._limit)):
            if self._violated[row]:
                a, b = self._a[row], self._b[row]
                price = LINEAR_PRICE + 2.0 * QUADRATIC_PRICE * (self._limit[row] - a * self.x - b * self.y)
                down_x += price * a
                down_y += price * b
                xx += 2.0 * QUADRATIC_PRICE * a * a
                xy += 2.0 * QUADRATIC_PRICE * a * b
                yy += 2.0 * QUADRATIC_PRICE * b * b
        self._neg_grad_x, self._neg_grad_y = down_x, down_y
        self._hess_xx, self._hess_xy, self._hess_yy = xx, xy, yy

    def _descend(self) -> bool:
        """Steps to the minimum of the piece on the active line, or to the first other line; False: already there."""
        # Two active lines fix the point.
        if self._second_line >= 0:
            return False
        if self._first_line >= 0:
            along, across = -self._b[self._first_line], self._a[self._first_line]
            curvature = (
                along * along * self._hess_xx + 2.0 * along * across * self._hess_xy + across * across * self._hess_yy
            )
            share = (along * self._neg_grad_x + across * self._neg_grad_y) / curvature
            step_x, step_y = share * along, share * across
        else:
            # Newton's step is exact here, since the piece is quadratic; the Hessian is positive definite by the
            # weights.
            determinant = self._hess_xx * self._hess_yy - self._hess_xy * self._hess_xy
            step_x = (self._hess_yy * self._neg_grad_x - self._hess_xy * self._neg_grad_y) / determinant
            step_y = (self._hess_xx * self._neg_grad_y - self._hess_xy * self._neg_grad_x) / determinant
        if not abs(step_x) + abs(step_y) > MIN_STEP:
            return False
        self._move_along(step_x, step_y)
        return True

    def _move_along(self, step_x: float, step_y: float) -> None:
        """Moves along the step to its lowest point; a line where it ends becomes active."""
        derivative = -(self._neg_grad_x * step_x + self._neg_grad_y * step_y)
        curvature = (
            step_x * step_x * self._hess_xx + 2.0 * step_x * step_y * self._hess_xy + step_y * step_y * self._hess_yy
        )
        # The curvature is updated by differences; it can never be less than that of the weights alone.
        least_curvature = 2.0 * (self._weight_x * step_x * step_x + self._weight_y * step_y * step_y)
        travelled, line = 0.0, -1
        for _ in range(len(self._limit) + 1):  # a step crosses each line at most once
            distance, rate, line = self._first_crossing(step_x, step_y, travelled - derivative / curvature)
            distance = max(distance, travelled)
            derivative += curvature * (distance - travelled)
            travelled = distance
            # At a line the derivative jumps by rho1 |rate|. The minimum along the step is there if this makes it
            # positive.
            if line < _BOUNDS or derivative + LINEAR_PRICE * abs(rate) >= 0.0:
                break
            derivative += LINEAR_PRICE * abs(rate)  # still descending on the other side
            curvature += 2.0 * QUADRATIC_PRICE * (rate * rate if rate < 0.0 else -(rate * rate))
            curvature = max(curvature, least_curvature)
            self._violated[line] = rate < 0.0
        self.x = min(max(self.x + travelled * step_x, 0.0), 1.0)
        self.y = min(max(self.y + travelled * step_y, 0.0), 1.0)
        if line < 0:
            return
        if line < _BOUNDS:  # exactly the bound: a rounded value would count as violated in the next step
            end = -self._limit[line]
            self.x, self.y = (end, self.y) if line < 2 else (self.x, end)
        self._violated[line] = False
        if self._first_line < 0:
            self._first_line = line
        else:
            self._second_line = line

    def _first_crossing(self, step_x: float, step_y: float, end: float) -> tuple[float, float, int]:
        """Share of the step, change per share and index of the first line before ``end``; else ``end`` and -1."""
        share, change, line = end, 0.0, -1
        none = _PARALLEL_COSINE * (abs(step_x) + abs(step_y))
        for row in range(len(self._limit)):
            if row == self._first_line:
                continue
            a, b = self._a[row], self._b[row]
            rate = a * step_x + b * step_y
            if not abs(rate) > none * (abs(a) + abs(b)) or (rate > 0.0) != self._violated[row]:
                continue  # no crossing ahead: the step is parallel to the line or leads away from it
            distance = (self._limit[row] - a * self.x - b * self.y) / rate
            if distance < share:
                share, change, line = distance, rate, row
        return share, change, line

    def _drop_from_active_set(self) -> bool:
        """Drops the active line whose price is furthest outside its interval; False if none is."""
        if self._first_line < 0:
            return False
        a, b = self._a[self._first_line], self._b[self._first_line]
        if self._second_line < 0:
            return self._drop_by_price((a * self._neg_grad_x + b * self._neg_grad_y) / -(a * a + b * b), 0.0)
        c, d = self._a[self._second_line], self._b[self._second_line]
        determinant = b * c - a * d
        one = (d * self._neg_grad_x - c * self._neg_grad_y) / determinant
        other = (a * self._neg_grad_y - b * self._neg_grad_x) / determinant
        return self._drop_by_price(one, other)

    def _drop_by_price(self, one: float, other: float) -> bool:
        """Drops one of both lines by their prices."""
        first, second = _exceeds_bounds(one, self._first_line), _exceeds_bounds(other, self._second_line)
        # Within the tolerance a price counts as inside; a line would otherwise be dropped and added again for ever.
        if not max(first, second) > PRICE_TOLERANCE:
            return False
        if first >= second:
            dropped, price = self._first_line, one
            self._first_line = self._second_line
        else:
            dropped, price = self._second_line, other
        self._second_line = -1
        self._violated[dropped] = price > 0.0
        return True


def _exceeds_bounds(price: float, line: int) -> float:
    """By how much a price lies outside its interval."""
    excess = price - LINEAR_PRICE if line >= _BOUNDS else 0.0
    return excess if excess > -price else -price
