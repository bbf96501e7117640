"""``NearestKept`` for many robots at once: the same conditions taken in in the same order, the same certainty."""

from __future__ import annotations

from typing import Any

import numpy as np

from safedpa.arrays import BoolArray, FloatArray
from safedpa.safety.solver.active_set_2d import KEPT, MOST, PARALLEL

__all__ = ["solve_hard_qp_2d_batch"]


def solve_hard_qp_2d_batch(
    slopes: FloatArray, limits: FloatArray, nominal: FloatArray, weights: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """The minimisers (robots, 2) for slopes (robots, rows, 2) . u >= limits (robots, rows), and where they are certain.

    ``nominal`` (robots, 2), ``weights`` (2,). A limit of -inf is none.
    """
    point, certain = nominal.copy(), np.zeros(len(nominal), dtype=bool)
    taken = np.zeros((len(nominal), 0), dtype=np.intp)
    numbers = np.isfinite(slopes).all(axis=(1, 2)) & (np.isfinite(limits) | (limits == -np.inf)).all(axis=1)
    left = np.flatnonzero(numbers)
    for _ in range(MOST):
        broken = limits[left] - (slopes[left] @ point[left][:, :, np.newaxis])[..., 0]
        newest = broken.argmax(axis=1)
        kept = broken[np.arange(len(left)), newest] <= KEPT
        certain[left[kept]] = True
        left, newest = left[~kept], newest[~kept]
        if len(left) == 0:
            break
        problem = _BatchQP(slopes[left], limits[left], nominal[left], weights)
        found, exists = problem.with_newest(taken[left], newest)
        point[left[exists]] = found[exists]
        taken = np.concatenate([taken, np.zeros((len(nominal), 1), dtype=np.intp)], axis=1)
        taken[left, -1] = newest
        left = left[exists]
    return point, certain


class _BatchQP:
    """The conditions of the robots that are not done yet."""

    def __init__(self, slopes: FloatArray, limits: FloatArray, nominal: FloatArray, weights: FloatArray) -> None:
        self._slopes, self._limits = slopes, limits
        self._nominal, self._weights = nominal, weights
        self._each = np.arange(len(nominal))

    def with_newest(self, taken: Any, newest: Any) -> tuple[FloatArray, BoolArray]:
        """The optima over ``taken`` (robots, t) and ``newest`` (robots,) rows, and where there are any."""
        found, exists = self._foot(newest)
        exists &= self._keeps(found, taken)
        for index in range(taken.shape[1]):
            corner, good = self._corner(taken[:, index], newest)
            good &= self._keeps(corner, taken) & ~exists
            found[good] = corner[good]
            exists |= good
        return found, exists

    def _foot(self, row: Any) -> tuple[FloatArray, BoolArray]:
        a, limit = self._slopes[self._each, row], self._limits[self._each, row]
        along = a / self._weights
        size = np.einsum("ki,ki->k", a, along)
        share = (limit - np.einsum("ki,ki->k", a, self._nominal)) / np.where(size == 0.0, np.nan, size)
        good = share >= 0.0
        return self._nominal + np.where(good, share, 0.0)[:, np.newaxis] * along, good

    def _corner(self, one: Any, other: Any) -> tuple[FloatArray, BoolArray]:
        (a, b), (c, d) = self._slopes[self._each, one].T, self._slopes[self._each, other].T
        first, second = self._limits[self._each, one], self._limits[self._each, other]
        determinant = a * d - b * c
        apart = np.abs(determinant) > PARALLEL * (np.abs(a) + np.abs(b)) * (np.abs(c) + np.abs(d))
        safe = np.where(apart, determinant, 1.0)
        point = np.stack([(first * d - second * b) / safe, (a * second - c * first) / safe], axis=1)
        pull, push = (2.0 * self._weights * (point - self._nominal)).T
        own, others = (pull * d - push * c) / safe, (a * push - b * pull) / safe
        good = apart & (own >= 0.0) & (others >= 0.0)
        return point, good

    def _keeps(self, point: FloatArray, taken: Any) -> BoolArray:
        each = self._each[:, np.newaxis]
        broken = self._limits[each, taken] - (self._slopes[each, taken] @ point[:, :, np.newaxis])[..., 0]
        kept: BoolArray = (broken <= KEPT).all(axis=1)
        return kept
