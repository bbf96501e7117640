"""The nearest point that keeps linear conditions in the plane, in closed form where its optimality is certain.

    min  sum_j weight_j (u_j - wish_j)^2   subject to   a_i . u >= b_i

Conditions are taken in one by one, each time the one most broken: over those taken in, the optimum lies on the newest
alone or in its corner with another one. A corner or foot is believed only if the Karush-Kuhn-Tucker conditions hold:
its multipliers are not negative, and what was taken in is kept. The optimum over some conditions that keeps all of them
is the optimum over all of them, so what is returned is the minimiser, whatever the way there.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite

__all__ = ["KEPT", "MOST", "PARALLEL", "Row", "nearest_kept"]

Row = tuple[float, float, float, float]
"""a_1, a_2, b, and the largest multiplier: the price of slack per unit, infinite where there is none."""

KEPT = 1e-12
"""A condition broken by less is kept: rounding errors of a corner are a thousand times smaller."""
PARALLEL = 1e-9
"""Share of the product of two rows' sizes: below, their corner is not computed."""
MOST = 8
"""Conditions that are taken in; then others have to answer."""

Point = tuple[float, float]


def nearest_kept(rows: Sequence[Row], wish: Point, weights: Point) -> Point | None:
    """The minimiser; None where it needs slack, is not found in a few steps, or a number is not finite."""
    if not isfinite(sum([a + b + limit for a, b, limit, _ in rows])):
        return None
    point, taken = wish, list[Row]()
    for _ in range(MOST):
        worst, newest = KEPT, None
        x, y = point
        for row in rows:
            a, b, limit, _ = row
            broken = limit - a * x - b * y
            if broken > worst:
                worst, newest = broken, row
        if newest is None:
            return point
        found = _with_newest(taken, newest, wish, weights)
        if found is None:
            return None
        point = found
        taken.append(newest)
    return None


def _with_newest(taken: Sequence[Row], newest: Row, wish: Point, weights: Point) -> Point | None:
    """The optimum over ``taken`` and ``newest``, which the optimum over ``taken`` alone breaks."""
    foot = _foot(newest, wish, weights)
    if foot is not None and _keeps(foot, taken):
        return foot
    for other in taken:
        corner = _corner(other, newest, wish, weights)
        if corner is not None and _keeps(corner, taken):
            return corner
    return None


def _foot(row: Row, wish: Point, weights: Point) -> Point | None:
    """The optimum with one condition: 2 W (u - wish) = multiplier a."""
    a, b, limit, price = row
    along, across = a / weights[0], b / weights[1]
    size = a * along + b * across
    if size == 0.0:
        return None
    share = (limit - a * wish[0] - b * wish[1]) / size
    if not 0.0 <= 2.0 * share <= price:
        return None
    return wish[0] + share * along, wish[1] + share * across


def _corner(one: Row, other: Row, wish: Point, weights: Point) -> Point | None:
    """The optimum with two conditions: both hold with equality, 2 W (u - wish) = sum of multiplier a."""
    a, b, first, _ = one
    c, d, second, _ = other
    determinant = a * d - b * c
    if abs(determinant) <= PARALLEL * (abs(a) + abs(b)) * (abs(c) + abs(d)):
        return None
    x, y = (first * d - second * b) / determinant, (a * second - c * first) / determinant
    pull, push = 2.0 * weights[0] * (x - wish[0]), 2.0 * weights[1] * (y - wish[1])
    multipliers = (pull * d - push * c) / determinant, (a * push - b * pull) / determinant
    if all(0.0 <= multiplier <= row[3] for multiplier, row in zip(multipliers, (one, other), strict=True)):
        return x, y
    return None


def _keeps(point: Point, rows: Sequence[Row]) -> bool:
    return all(limit - a * point[0] - b * point[1] <= KEPT for a, b, limit, _ in rows)
