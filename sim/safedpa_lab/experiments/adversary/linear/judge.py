"""What is right in a linear problem, found without the filter: a linear program and a least-distance program.

In u = (a - low) / (high - low) of [0, 1] a row is h_i = offset_i + slope_i . u. Its scale is the largest of |h_i| now,
its margin, and what the actions can change in it: sum_j |slope_ij|. What adding up P x + q rounds away is no one's
fault: it is taken from a fault before the fault is measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.safety import Verdict
from safedpa_lab.experiments.adversary.attack import BROKEN, Judged
from safedpa_lab.experiments.adversary.linear.problem import LinearProblem

_ROUNDED = 16.0 * float(np.finfo(np.float64).eps)
"""Share of the terms |P| |x| + |q| that their sum may have lost."""
_UNMOVED = 1e-12
"""Share of its scale by which the actions change a row that they do not change."""
_KEPT = 1e-10
"""Share of its scale by which the reference's own answer may break a row before it is not used."""

_EXACT: dict[str, object] = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
_WAYS: tuple[tuple[str, dict[str, object]], ...] = (
    ("highs", _EXACT),
    ("highs-ds", {**_EXACT, "presolve": False}),
    ("highs-ipm", _EXACT),
    ("highs", {}),
)
"""How a linear program is solved, and again where HiGHS ends in a status that it does not know itself."""


@final
@dataclass(frozen=True, eq=False)
class Nearest:
    """The reference's nearest feasible action, and its weighted distance from the nominal action."""

    action: FloatArray
    distance: float


@final
class LinearJudge:
    """The problem's rows in their scales, and what actions could attain."""

    def __init__(self, problem: LinearProblem) -> None:
        self.problem = problem
        self.width = problem.high - problem.low
        self.now = problem.heights(problem.state)
        slope = (problem.P @ problem.g) * self.width
        size = np.maximum(np.abs(problem.state), np.abs(problem.f) + np.abs(problem.g) @ np.abs(self.width))
        rounding = _ROUNDED * (np.abs(problem.P) @ size + np.abs(problem.q))
        own = np.maximum(np.maximum(np.abs(self.now), problem.epsilon), np.abs(slope).sum(axis=1))
        # a row in which nothing is larger than rounding has its terms for a scale
        self.scale = np.where(own > 1e3 * rounding, own, rounding / _ROUNDED)
        self.scale[self.scale == 0.0] = 1.0
        self.rounding = rounding / self.scale
        offset = problem.heights(problem.after(problem.low))
        required = (1.0 - problem.eta) * self.now + problem.epsilon
        self.required = required
        self._slope = slope / self.scale[:, None]
        self._offset = offset / self.scale
        self._moved = np.abs(self._slope).sum(axis=1) > _UNMOVED
        self._limit = (required - offset) / self.scale

    def heights(self, action: FloatArray) -> FloatArray:
        """(rows,) predicted h in scales."""
        return np.asarray(self.problem.heights(self.problem.after(action)) / self.scale)

    def movable(self, action: FloatArray) -> FloatArray:
        """(movable rows,) predicted h in scales; all rows where the actions move none."""
        heights = self.heights(action)
        return heights[self._moved] if self._moved.any() else heights

    def keeps_movable(self, action: FloatArray, tolerance: float) -> bool:
        """Whether all conditions that actions can do something about are kept."""
        return bool(((self.residuals(action) + self.rounding)[self._moved] >= -tolerance).all())

    def lowest(self, action: FloatArray) -> float:
        """Least predicted h in scales, with what rounding may have taken from it given back."""
        return float((self.heights(action) + self.rounding).min())

    def broken(self, action: FloatArray) -> float:
        """By how much the worst condition is broken, in its scale, beyond rounding; 0 where all are kept."""
        return max(0.0, -float((self.residuals(action) + self.rounding).min()))

    def residuals(self, action: FloatArray) -> FloatArray:
        """(rows,) by how much each condition is satisfied, in scales; negative: broken."""
        return np.asarray((self.problem.heights(self.problem.after(action)) - self.required) / self.scale)

    def distance(self, action: FloatArray) -> float:
        """sqrt(sum weight_j ((a_j - nominal_j) / range_j)^2), the largest weight being 1."""
        weights = self.problem.weights / self.problem.weights.max()
        return float(np.sqrt(np.sum(weights * ((action - self.problem.nominal) / self.width) ** 2)))

    def best_least_height(self) -> tuple[float, FloatArray]:
        """The largest attainable least scaled h of the rows that actions move, and an action that attains it."""
        return self._most(self._slope, self._offset, self.movable)

    def best_least_residual(self) -> tuple[float, FloatArray]:
        """The largest attainable least scaled residual, and an action that attains it: below 0 nothing keeps all."""
        return self._most(self._slope, -self._limit, self.residuals)

    def nearest(self) -> Nearest | None:
        """The action nearest to the nominal action that satisfies all conditions; None where the reference finds none.

        Least-distance programming: min |y| subject to G y >= b is the residual of a non-negative least-squares problem.
        Source: Lawson and Hanson, Solving Least Squares Problems (1974), chapter 23.
        """
        problem = self.problem
        stretch = self.width / np.sqrt(problem.weights)
        middle = (problem.nominal - problem.low) / self.width
        eye = np.eye(len(middle))
        moved = self._moved
        if (self._limit[~moved] > _KEPT).any():
            return None
        G = np.vstack([self._slope[moved], eye, -eye]) / np.sqrt(problem.weights)
        b = np.concatenate([(self._limit - self._slope @ middle)[moved], -middle, middle - 1.0])
        size = np.abs(G).max(axis=1)
        found = _least_distance(G / size[:, None], b / size)
        if found is None:
            return None
        action = np.clip(problem.nominal + stretch * found, problem.low, problem.high)
        if self.broken(action) > _KEPT:
            return None
        return Nearest(action, self.distance(action))

    def _most(self, slope: FloatArray, offset: FloatArray, judged: object) -> tuple[float, FloatArray]:
        """Max over u, t of t subject to slope u + offset >= t, 0 <= u <= 1; evaluated again at the action found."""
        from scipy.optimize import linprog

        assert callable(judged)
        if judged == self.movable and self._moved.any():
            slope, offset = slope[self._moved], offset[self._moved]
        rows, actions = slope.shape
        cost, above = np.concatenate([np.zeros(actions), [-1.0]]), np.hstack([-slope, np.ones((rows, 1))])
        bounds = [(0.0, 1.0)] * actions + [(None, None)]
        for method, options in _WAYS:  # where one way gives up, another one answers
            found = linprog(cost, A_ub=above, b_ub=offset, bounds=bounds, method=method, options=options)
            if found.x is not None:
                break
        else:
            raise ArithmeticError(f"the reference's linear program was not solved: {found.message}")
        u = np.clip(found.x[:-1], 0.0, 1.0)
        action = np.clip(self.problem.low + self.width * u, self.problem.low, self.problem.high)
        return float(judged(action).min()), action


def _least_distance(G: FloatArray, b: FloatArray) -> FloatArray | None:
    from scipy.optimize import nnls

    if (b <= 0.0).all():
        return np.zeros(G.shape[1])
    E = np.vstack([G.T, b])
    goal = np.zeros(len(E))
    goal[-1] = 1.0
    try:
        y, norm = nnls(E, goal)
    except RuntimeError:  # too many iterations
        return None
    residual = E @ y - goal
    if norm < 1e-9 or residual[-1] >= 0.0:
        return None
    active = y > 0.0  # on these rows with equality, again: the residual of least squares has lost digits
    return np.asarray(np.linalg.lstsq(G[active], b[active], rcond=None)[0])


FAR = 1e-6
"""Weighted ranges by which a correction is further from the nominal action than it had to be."""
_SIGN = 1e-12
"""Share of its scale within which h has no sign: the filter and the judge add in different orders."""


def judged(problem: LinearProblem, verdict: Verdict) -> Judged:
    """What the reference says of a verdict."""
    judge, action, status = LinearJudge(problem), verdict.action, verdict.status.value
    kept = status in ("passed", "corrected")
    unsafe_now = bool((judge.now / judge.scale < -judge.rounding - _SIGN).any())
    safe_now = bool((judge.now / judge.scale > judge.rounding).all())
    broken = judge.broken(action) if kept else None
    asks = status == "corrected" and broken is not None and broken <= BROKEN
    nearest = judge.nearest() if asks else None
    missed, shortfall, needless = (False, None, False) if kept else _least_violation(problem, judge, verdict)
    return Judged(
        status=status,
        out_of_bounds=bool((action < problem.low).any() or (action > problem.high).any()),
        altered=status == "passed" and not np.array_equal(action, problem.nominal),
        broken=broken,
        below=kept and (verdict.h_next < 0.0 or judge.lowest(action) < -_SIGN),
        untold=(unsafe_now and status != "violated") or (safe_now and status == "violated"),
        excess=None if nearest is None else max(0.0, judge.distance(action) - nearest.distance),
        missed=missed,
        shortfall=shortfall,
        needless=needless,
    )


def _least_violation(problem: LinearProblem, judge: LinearJudge, verdict: Verdict) -> tuple[bool, float, bool]:
    action, status = verdict.action, verdict.status.value
    room, keeper = judge.best_least_residual()
    if problem.witness is not None:
        room = max(room, float(judge.residuals(problem.witness).min()))
    best, lifted = judge.best_least_height()
    best = max(best, float(judge.movable(keeper).min()))
    own = float(judge.movable(action).min())
    safe = bool((judge.heights(lifted) >= 0.0).all() or (judge.heights(keeper) >= 0.0).all())
    needless = status != "violated" and float(judge.heights(action).min()) < -BROKEN and safe
    if judge.keeps_movable(action, BROKEN):
        best = own
    return status != "violated" and room > BROKEN, max(0.0, best - own), needless
