"""The closed form of the nearest action as a function of its conditions."""

from __future__ import annotations

from collections.abc import Iterable

from safedpa.safety.nearest import NearestKept

Row = tuple[float, float, float]
"""a_1, a_2, b."""
Point = tuple[float, float]


def nearest_kept(rows: Iterable[Row], wish: Point, weights: Point) -> Point | None:
    """The point of the unit square; None where it has no answer."""
    problem = NearestKept(*wish, *weights)
    for row in rows:
        problem.add(*row)
    return (problem.x, problem.y) if problem.solve() else None
