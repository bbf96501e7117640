"""The nearest point that keeps all conditions, and the one with slack, as functions of the conditions."""

from __future__ import annotations

from collections.abc import Iterable

from safedpa.safety.nearest import NearestKept, NearestWithSlack

Row = tuple[float, float, float]
"""a_1, a_2, b."""
Point = tuple[float, float]


def nearest_kept(rows: Iterable[Row], wish: Point, weights: Point) -> Point | None:
    """The point of the unit square; None where it has no answer."""
    problem = NearestKept(*wish, *weights)
    for row in rows:
        problem.add(*row)
    return (problem.x, problem.y) if problem.solve() else None


def nearest_with_slack(rows: Iterable[Row], wish: Point, weights: Point) -> Point | None:
    """The point of the unit square; None where it has no answer."""
    problem = NearestWithSlack(*wish, *weights)
    for row in rows:
        problem.add(*row)
    return (problem.x, problem.y) if problem.solve() else None
