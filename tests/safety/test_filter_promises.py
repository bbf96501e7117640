"""What each status promises, over random problems with every barrier and every action at a scale of its own.

The problems are affine, x[t+1] = f + G a, and their h linear or bent downwards, so that scipy's linear program and a
quadratic one tell what could be attained.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import quadprog
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import linprog

from safedpa.safety import FilterSettings, FunctionBarrier, SafetyFilter, Status, Verdict
from safedpa.safety.conditions import ROUNDING

Values = NDArray[np.float64]

DRAWN = hypothesis_settings(derandomize=True, deadline=None, database=None, max_examples=150)
ATTAINED = 0.01
"""Share of a barrier's scale by which the least unsafe action may fall short of the best."""


@dataclass
class Problem:
    """h_i now (m,), what h_i is after an action: base + slopes a, and what the settings ask for."""

    now: Values
    base: Values
    slopes: Values
    low: Values
    high: Values
    wish: Values
    weights: Values
    epsilon: Values
    eta: float

    @classmethod
    def drawn(cls, seed: int, spread: float, drift: float, below: float) -> Problem:
        """1 to 4 actions, 1 to 12 barriers; ``spread`` decades of scales, h around 0.3 - ``below`` of its reach."""
        random = np.random.default_rng(seed)
        actions, rows = int(random.integers(1, 5)), int(random.integers(1, 13))
        low = -random.uniform(0.2, 2.0, actions)
        high = low + random.uniform(0.5, 4.0, actions)
        slopes = random.normal(size=(rows, actions)) * (random.random((rows, actions)) < 0.8)
        now = np.abs(random.normal(0.3, 1.0, rows)) - below * random.random(rows)
        base = now - slopes @ random.uniform(low, high) + drift * random.normal(size=rows)
        units, scales = 10.0 ** random.uniform(-spread, spread, rows), 10.0 ** random.uniform(-spread, spread, actions)
        return cls(
            now * units,
            base * units,
            slopes * units[:, np.newaxis] / scales,
            low * scales,
            high * scales,
            random.uniform(low - 0.3, high + 0.3) * scales,
            random.uniform(0.2, 1.0, actions),
            0.02 * units * random.random(rows),
            float(random.uniform(0.05, 1.0)),
        )

    @property
    def required(self) -> Values:
        return np.asarray((1.0 - self.eta) * self.now + self.epsilon)

    @property
    def scale(self) -> Values:
        """Of a row that no action moves it is what h is then, if that is more."""
        reach = np.abs(self.slopes) @ (self.high - self.low)
        then = np.where(reach > 0.0, 0.0, np.abs(self.base))
        return np.asarray(np.maximum.reduce([np.abs(self.now), self.epsilon, reach, then, np.full(len(then), 1e-300)]))

    def after(self, action: Values) -> Values:
        """(m,) h_i(x+)."""
        return np.asarray(self.base + self.slopes @ action)

    def decide(self) -> Verdict:
        """The states are the heights: x_i = h_i."""
        rows = len(self.now)
        barriers = [
            FunctionBarrier(lambda x, i=i: x[i], lambda x, i=i: np.eye(rows)[i], (f"h{i}",), f"h{i}")
            for i in range(rows)
        ]
        settings = FilterSettings(
            action_low=tuple(self.low.tolist()),
            action_high=tuple(self.high.tolist()),
            weights=tuple(self.weights.tolist()),
            eta=self.eta,
            epsilon={f"h{i}": float(self.epsilon[i]) for i in range(rows)},
        )
        return SafetyFilter(lambda x: (self.base, self.slopes), barriers, settings).decide(self.now, self.wish)

    def distance(self, action: Values) -> float:
        shares = (action - self.wish) / (self.high - self.low)
        return float(self.weights / self.weights.max() @ (shares * shares))

    def scaled(self) -> tuple[Values, Values, Values]:
        """Slopes over the range and base at the lowest action, and what is required, all as shares of the scales."""
        slopes = self.slopes * (self.high - self.low) / self.scale[:, np.newaxis]
        return slopes, (self.base + self.slopes @ self.low) / self.scale, self.required / self.scale

    def best_least(self, offset: Any = 0.0) -> float:
        """Largest attainable least (h_i(x+) - offset_i) / scale_i."""
        slopes, base, _ = self.scaled()
        rows, actions = slopes.shape
        A = np.hstack([-slopes, np.ones((rows, 1))])
        bounds = [*[(0.0, 1.0)] * actions, (None, None)]
        found = linprog([*[0.0] * actions, -1.0], A_ub=A, b_ub=base - offset / self.scale, bounds=bounds)
        assert found.status == 0
        return float(found.x[-1])

    @property
    def room(self) -> float:
        """By how much of the scales all that is asked for can be kept; below 0 where it cannot."""
        return self.best_least(np.maximum(self.required, 0.0))

    def nearest(self) -> float:
        """Distance of the nearest action that keeps all, by quadprog, in shares of the ranges."""
        slopes, base, required = self.scaled()
        weights, wish = self.weights / self.weights.max(), (self.wish - self.low) / (self.high - self.low)
        eye = np.eye(len(wish))
        C, d = (
            np.vstack([slopes, eye, -eye]),
            np.concatenate([required - base, np.zeros(len(wish)), -np.ones(len(wish))]),
        )
        return float(
            quadprog.solve_qp(np.diag(2.0 * weights), 2.0 * weights * wish, C.T, d)[1] + weights @ (wish * wish)
        )


def check(problem: Problem) -> Status:
    """Every promise, by the problem's own numbers."""
    verdict = problem.decide()
    heights = problem.after(verdict.action)
    shares = heights / problem.scale
    residual = (heights - problem.required) / problem.scale
    assert verdict.known
    assert (verdict.action >= problem.low).all()
    assert (verdict.action <= problem.high).all()
    assert verdict.h_next == pytest.approx(heights.min(), rel=1e-9, abs=1e-12 * float(problem.scale.max()))
    assert (verdict.status is Status.violated) == bool((problem.now < 0.0).any())
    if verdict.status in (Status.passed, Status.corrected):
        assert verdict.h_next >= 0.0
        assert (shares >= -1e-15).all()
        assert (residual >= -ROUNDING * 1.001).all()
        assert verdict.slack == 0.0
        assert problem.room >= -1e-9
        if verdict.status is Status.passed:
            assert verdict.action.tobytes() == problem.wish.tobytes()
        elif problem.room > 1e-6:
            assert problem.distance(verdict.action) <= problem.nearest() + 2e-4
    else:
        best = problem.best_least()
        assert shares.min() >= best - ATTAINED
        if best > 1e-6:
            assert verdict.h_next >= 0.0
    if verdict.status is Status.relaxed:
        assert problem.room <= 1e-6
        assert verdict.slack > 0.0 or verdict.h_next < 0.0
    return verdict.status


@DRAWN
@given(st.integers(0, 10**9), st.sampled_from([0.0, 3.0, 9.0]), st.sampled_from([0.0, 0.5, 2.0]))
def test_promises_hold_where_all_is_well_now(seed: int, spread: float, drift: float) -> None:
    check(Problem.drawn(seed, spread, drift, 0.0))


@DRAWN
@given(st.integers(0, 10**9), st.sampled_from([0.0, 3.0, 9.0]), st.sampled_from([0.0, 0.5, 2.0]))
def test_promises_hold_where_some_h_may_be_below_zero(seed: int, spread: float, drift: float) -> None:
    check(Problem.drawn(seed, spread, drift, 1.0))


def test_every_kind_of_problem_is_among_them() -> None:
    kinds = Counter(check(Problem.drawn(seed, 6.0, 0.7, 0.5 * (seed % 2))) for seed in range(300))
    print({kind.value: count for kind, count in kinds.items()})
    assert min(kinds[kind] for kind in (Status.passed, Status.corrected, Status.relaxed, Status.violated)) >= 10


@pytest.mark.parametrize("seed", range(20))
def test_the_nearest_of_equally_unsafe_actions_is_taken(seed: int) -> None:
    """Only the first action moves h, and more of it than there is would be needed: the second one stays as wished."""
    random = np.random.default_rng(seed)
    now, wish = random.uniform(-3.0, -1.0), random.uniform(-1.0, 1.0, 2)
    settings = FilterSettings(action_low=(-1.0, -1.0), action_high=(1.0, 1.0), epsilon=0.0)
    safe = SafetyFilter(lambda x: (x, np.array([[0.5, 0.0]])), [FunctionBarrier(lambda x: x[0])], settings)
    verdict = safe.decide(np.array([now]), wish)
    assert verdict.status is Status.violated
    assert verdict.action[0] == pytest.approx(1.0, abs=0.01)
    assert verdict.action[1] == pytest.approx(wish[1], abs=1e-6)


def test_where_the_least_h_leaves_room_the_backup_decides() -> None:
    """h_0 cannot be helped within one step; the other keeps its condition, as near to the backup (0, 0) as it can."""
    problem = Problem(
        now=np.array([0.5, 1.0]),
        base=np.array([-0.2, 0.4]),
        slopes=np.array([[0.0, 0.0], [1.0, -1.0]]),
        low=np.array([-1.0, -1.0]),
        high=np.array([1.0, 1.0]),
        wish=np.array([-0.9, 0.3]),
        weights=np.ones(2),
        epsilon=np.zeros(2),
        eta=0.2,
    )
    verdict = problem.decide()
    assert verdict.status is Status.relaxed
    np.testing.assert_allclose(verdict.action, [0.2, -0.2], atol=0.02)
    assert verdict.reason.endswith("No action moves h0 within one step: the backup is taken for the wish.")
