"""The closed form for many robots says what the closed form for one robot says."""

from __future__ import annotations

from math import inf, nan
from typing import Any

import numpy as np
import pytest
from tests.safety.closed_form import Row, nearest_kept

from safedpa.safety.batch_nearest import nearest_kept_by_many

WEIGHTS = np.array([1.0, 2.0])
BOX = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
BOX_LIMITS = np.array([0.0, -1.0, 0.0, -1.0])


def alone(slopes: Any, limits: Any, wish: Any) -> tuple[float, float] | None:
    """What one robot's form says without the rows that are none."""
    rows: list[Row] = [
        (float(a), float(b), float(limit)) for (a, b), limit in zip(slopes, limits, strict=True) if limit > -inf
    ]
    return nearest_kept(rows, (float(wish[0]), float(wish[1])), (float(WEIGHTS[0]), float(WEIGHTS[1])))


@pytest.mark.parametrize("rows", range(1, 10))
def test_every_robot_gets_what_it_gets_alone(rows: int) -> None:
    random = np.random.default_rng(rows)
    robots = 300
    slopes = np.concatenate([random.normal(size=(robots, rows, 2)), np.tile(BOX, (robots, 1, 1))], axis=1)
    limits = np.concatenate([random.normal(0.0, 0.7, (robots, rows)), np.tile(BOX_LIMITS, (robots, 1))], axis=1)
    limits[:, :rows][random.random((robots, rows)) < 0.1] = -inf
    wish = random.uniform(-1.0, 2.0, (robots, 2))
    points, certain = nearest_kept_by_many(slopes, limits, wish, WEIGHTS)
    for robot in range(robots):
        own = alone(slopes[robot, :rows], limits[robot, :rows], wish[robot])
        assert certain[robot] == (own is not None)
        if own is not None:
            np.testing.assert_allclose(points[robot], own, rtol=0.0, atol=1e-9)
    assert certain.any()


def one(slopes: Any, limits: Any, wish: Any) -> tuple[list[float], bool]:
    """The answer for a single robot among the box's rows."""
    all_slopes = np.concatenate([np.array(slopes, dtype=float), BOX])[np.newaxis]
    all_limits = np.concatenate([np.array(limits, dtype=float), BOX_LIMITS])[np.newaxis]
    points, certain = nearest_kept_by_many(all_slopes, all_limits, np.array([wish]), np.ones(2))
    return points[0].tolist(), bool(certain[0])


def test_the_wish_a_foot_and_a_corner() -> None:
    assert one([[1.0, 0.0]], [0.2], (0.5, 0.5)) == ([0.5, 0.5], True)
    assert one([[1.0, 0.0]], [0.75], (0.5, 0.5)) == ([0.75, 0.5], True)
    assert one([[1.0, 0.0], [0.0, 2.0]], [0.75, 1.5], (0.5, 0.5)) == ([0.75, 0.75], True)


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
def test_no_condition_is_too_dear_however_steep_it_is(size: float) -> None:
    found, certain = one([[size, 0.0], [0.0, size]], [0.75 * size, 0.75 * size], (0.5, 0.5))
    assert certain
    np.testing.assert_allclose(found, 0.75, atol=1e-6)


def test_what_cannot_be_kept_or_is_no_number_is_not_certain() -> None:
    for slopes, limits in (
        ([[0.0, 0.0]], [0.5]),  # no action helps
        ([[1.0, 0.0], [-1.0, 0.0]], [0.8, -0.2]),  # one excludes the other
        ([[nan, 0.0]], [0.5]),
        ([[1.0, inf]], [0.5]),
        ([[1.0, 0.0]], [nan]),
        ([[1.0, 0.0]], [inf]),
    ):
        assert not one(slopes, limits, (0.5, 0.5))[1]


def test_a_robot_without_numbers_changes_nothing_for_the_next() -> None:
    slopes = np.tile(np.concatenate([[[1.0, 0.0]], BOX]), (3, 1, 1))
    limits = np.tile(np.concatenate([[0.75], BOX_LIMITS]), (3, 1))
    slopes[1, 0, 0] = nan
    points, certain = nearest_kept_by_many(slopes, limits, np.full((3, 2), 0.5), np.ones(2))
    assert certain.tolist() == [True, False, True]
    np.testing.assert_array_equal(points[[0, 2]], [[0.75, 0.5], [0.75, 0.5]])


@pytest.mark.parametrize("size", [1.0, 100.0])
def test_the_corner_of_almost_parallel_conditions_is_not_believed(size: float) -> None:
    """x >= 0.75 and 1e-10 y >= x - 0.75 + 5e-11 meet at y = 0.5, but not so that rounding could tell."""
    slopes = [[size, 0.0], [-size, 1e-10 * size]]
    assert not one(slopes, [0.75 * size, (-0.75 + 5e-11) * size], (0.5, 0.2))[1]


def by_trying_all(slopes: Any, limits: Any, wish: Any) -> Any:
    """The nearest of all points that could be it: the wish, its foot on every row, and every corner; None: no one."""
    rows = [(a, b) for a, b in zip(slopes, limits, strict=True) if b > -inf and a.any()]
    A, b = np.array([a for a, _ in rows]), np.array([b for _, b in rows])
    points = [wish]
    for first in range(len(A)):
        along = A[first] / WEIGHTS
        points.append(wish + (b[first] - A[first] @ wish) / (A[first] @ along) * along)
        for second in range(first):
            if abs(np.linalg.det(A[[first, second]])) > 1e-9:
                points.append(np.linalg.solve(A[[first, second]], b[[first, second]]))
    inside = [point for point in points if (A @ point >= b - 1e-9).all()]
    return min(inside, key=lambda point: ((point - wish) ** 2) @ WEIGHTS, default=None)


@pytest.mark.parametrize("rows", [2, 5, 9])
def test_what_is_certain_is_the_nearest_of_all_points(rows: int) -> None:
    """Around a place that keeps all of them, seen from far away: many are taken in before it is found."""
    random, robots = np.random.default_rng(rows), 300
    slopes = np.concatenate([random.normal(size=(robots, rows, 2)), np.tile(BOX, (robots, 1, 1))], axis=1)
    inside = random.uniform(0.2, 0.8, (robots, 2))
    own = (slopes[:, :rows] @ inside[:, :, np.newaxis])[..., 0] - random.uniform(0.0, 0.2, (robots, rows))
    limits = np.concatenate([own, np.tile(BOX_LIMITS, (robots, 1))], axis=1)
    wish = inside + random.normal(0.0, 3.0, (robots, 2))
    points, certain = nearest_kept_by_many(slopes, limits, wish, WEIGHTS)
    for robot in np.flatnonzero(certain).tolist():
        nearest = by_trying_all(slopes[robot], limits[robot], wish[robot])
        np.testing.assert_allclose(points[robot], nearest, rtol=0.0, atol=1e-6)
    assert certain.mean() > 0.9
