"""``HardQP2D`` for many robots at once: the same order of active constraints and the same proof of optimality."""

from __future__ import annotations

from typing import Any

import numpy as np

from safedpa.arrays import BoolArray, FloatArray
from safedpa.safety.solver.active_set_2d import FEASIBILITY_TOLERANCE, MAX_ACTIVE, PARALLEL_TOLERANCE

__all__ = ["solve_hard_qp_2d_batch"]


def solve_hard_qp_2d_batch(
    gradients: FloatArray, limits: FloatArray, nominal: FloatArray, weights: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Returns minimisers (robots, 2) for gradients (robots, rows, 2) . u >= limits (robots, rows), and which are
    proven.

    ``nominal`` (robots, 2), ``weights`` (2,). A limit of -inf means no constraint.
    """
    point, certain = nominal.copy(), np.zeros(len(nominal), dtype=bool)
    active = np.zeros((len(nominal), 0), dtype=np.intp)
    numbers = np.isfinite(gradients).all(axis=(1, 2)) & (np.isfinite(limits) | (limits == -np.inf)).all(axis=1)
    left = np.flatnonzero(numbers)
    for _ in range(MAX_ACTIVE):
        # Only robots without a result are computed further: most are done after one or two constraints.
        violation = limits[left] - (gradients[left] @ point[left][:, :, np.newaxis])[..., 0]
        newest = violation.argmax(axis=1)
        satisfied = violation[np.arange(len(left)), newest] <= FEASIBILITY_TOLERANCE
        certain[left[satisfied]] = True
        left, newest = left[~satisfied], newest[~satisfied]
        if len(left) == 0:
            break
        problem = _BatchQP(gradients[left], limits[left], nominal[left], weights)
        found, exists = problem.with_newest(active[left], newest)
        point[left[exists]] = found[exists]
        active = np.concatenate([active, np.zeros((len(nominal), 1), dtype=np.intp)], axis=1)
        active[left, -1] = newest
        left = left[exists]
    return point, certain


class _BatchQP:
    """The constraints of the robots without a result."""

    def __init__(self, gradients: FloatArray, limits: FloatArray, nominal: FloatArray, weights: FloatArray) -> None:
        self._gradients, self._limits = gradients, limits
        self._nominal, self._weights = nominal, weights
        self._each = np.arange(len(nominal))

    def with_newest(self, active: Any, newest: Any) -> tuple[FloatArray, BoolArray]:
        """The optima over ``active`` (robots, t) and ``newest`` (robots,) rows, and where they exist."""
        found, exists = self._project_on_line(newest)
        exists &= self._satisfies_active(found, active)
        for index in range(active.shape[1]):
            corner, good = self._solve_corner(active[:, index], newest)
            good &= self._satisfies_active(corner, active) & ~exists
            # The first point that satisfies all active constraints wins, in the same order as for one robot.
            found[good] = corner[good]
            exists |= good
        return found, exists

    def _project_on_line(self, row: Any) -> tuple[FloatArray, BoolArray]:
        a, limit = self._gradients[self._each, row], self._limits[self._each, row]
        along = a / self._weights
        size = np.einsum("ki,ki->k", a, along)
        # NaN instead of a division by zero: the comparison below then refuses it.
        share = (limit - np.einsum("ki,ki->k", a, self._nominal)) / np.where(size == 0.0, np.nan, size)
        good = share >= 0.0
        return self._nominal + np.where(good, share, 0.0)[:, np.newaxis] * along, good

    def _solve_corner(self, one: Any, other: Any) -> tuple[FloatArray, BoolArray]:
        (a, b), (c, d) = self._gradients[self._each, one].T, self._gradients[self._each, other].T
        first, second = self._limits[self._each, one], self._limits[self._each, other]
        determinant = a * d - b * c
        intersects = np.abs(determinant) > PARALLEL_TOLERANCE * (np.abs(a) + np.abs(b)) * (np.abs(c) + np.abs(d))
        # Parallel lines divide by 1 and are masked out below.
        safe = np.where(intersects, determinant, 1.0)
        point = np.stack([(first * d - second * b) / safe, (a * second - c * first) / safe], axis=1)
        pull, push = (2.0 * self._weights * (point - self._nominal)).T
        own, others = (pull * d - push * c) / safe, (a * push - b * pull) / safe
        good = intersects & (own >= 0.0) & (others >= 0.0)
        return point, good

    def _satisfies_active(self, point: FloatArray, active: Any) -> BoolArray:
        each = self._each[:, np.newaxis]
        violation = self._limits[each, active] - (self._gradients[each, active] @ point[:, :, np.newaxis])[..., 0]
        satisfied: BoolArray = (violation <= FEASIBILITY_TOLERANCE).all(axis=1)
        return satisfied
