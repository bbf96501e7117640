"""What each status promises, at a scale of its own for every barrier and action, and in any unit."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
import quadprog
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import linprog

from safedpa.safety import AbstractBarrier, FilterSettings, FunctionBarrier, SafetyFilter, Status, Verdict
from safedpa.safety.solver.constraints import ROUNDING

Values = NDArray[np.float64]
DRAWN = hypothesis_settings(derandomize=True, deadline=None, database=None, max_examples=150)


ATTAINED = 0.01
"""Share of a barrier's scale by which the least-violation action may fall short of the best."""


@dataclass
class Problem:
    """h_i now (m,), what h_i is after an action: base + slopes a, and what the settings ask for."""

    now: Values
    base: Values
    slopes: Values
    low: Values
    high: Values
    nominal: Values
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
            now * units, base * units, slopes * units[:, np.newaxis] / scales, low * scales, high * scales,
            random.uniform(low - 0.3, high + 0.3) * scales, random.uniform(0.2, 1.0, actions),
            0.02 * units * random.random(rows), float(random.uniform(0.05, 1.0)),
        )  # fmt: skip

    @property
    def rhs(self) -> Values:
        return np.asarray((1.0 - self.eta) * self.now + self.epsilon)

    @property
    def scale(self) -> Values:
        """For a row without influence of the action it is the next h, if that is larger."""
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
            action_low=tuple(self.low.tolist()), action_high=tuple(self.high.tolist()),
            weights=tuple(self.weights.tolist()), eta=self.eta,
            epsilon={f"h{i}": float(self.epsilon[i]) for i in range(rows)},
        )  # fmt: skip
        return SafetyFilter(lambda x: (self.base, self.slopes), barriers, settings).decide(self.now, self.nominal)

    def distance(self, action: Values) -> float:
        shares = (action - self.nominal) / (self.high - self.low)
        return float(self.weights / self.weights.max() @ (shares * shares))

    def scaled(self) -> tuple[Values, Values, Values]:
        """Slopes over the range and base at the lowest action, and what is required, all as shares of the scales."""
        slopes = self.slopes * (self.high - self.low) / self.scale[:, np.newaxis]
        return slopes, (self.base + self.slopes @ self.low) / self.scale, self.rhs / self.scale

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
        return self.best_least(np.maximum(self.rhs, 0.0))

    def nearest(self) -> float:
        """Distance of the nearest action that keeps all, by quadprog, in shares of the ranges."""
        slopes, base, required = self.scaled()
        weights, nominal = self.weights / self.weights.max(), (self.nominal - self.low) / (self.high - self.low)
        eye = np.eye(len(nominal))
        C, d = (
            np.vstack([slopes, eye, -eye]),
            np.concatenate([required - base, np.zeros(len(nominal)), -np.ones(len(nominal))]),
        )
        return float(
            quadprog.solve_qp(np.diag(2.0 * weights), 2.0 * weights * nominal, C.T, d)[1]
            + weights @ (nominal * nominal)
        )


def check(problem: Problem) -> Status:
    verdict = problem.decide()
    heights = problem.after(verdict.action)
    shares = heights / problem.scale
    residual = (heights - problem.rhs) / problem.scale
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
            assert verdict.action.tobytes() == problem.nominal.tobytes()
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


@pytest.mark.long
def test_every_kind_of_problem_is_among_them() -> None:
    kinds = Counter(check(Problem.drawn(seed, 6.0, 0.7, 0.5 * (seed % 2))) for seed in range(300))
    print({kind.value: count for kind, count in kinds.items()})
    assert min(kinds[kind] for kind in (Status.passed, Status.corrected, Status.relaxed, Status.violated)) >= 10


@pytest.mark.parametrize("seed", range(20))
def test_the_nearest_of_equally_unsafe_actions_is_taken(seed: int) -> None:
    """Only the first action moves h, and more of it than there is would be needed: the second one stays as
    requested."""
    random = np.random.default_rng(seed)
    now, nominal = random.uniform(-3.0, -1.0), random.uniform(-1.0, 1.0, 2)
    settings = FilterSettings(action_low=(-1.0, -1.0), action_high=(1.0, 1.0), epsilon=0.0)
    safe = SafetyFilter(lambda x: (x, np.array([[0.5, 0.0]])), [FunctionBarrier(lambda x: x[0])], settings)
    verdict = safe.decide(np.array([now]), nominal)
    assert verdict.status is Status.violated
    assert verdict.action[0] == pytest.approx(1.0, abs=0.01)
    assert verdict.action[1] == pytest.approx(nominal[1], abs=1e-6)


def test_where_the_least_h_leaves_room_the_backup_decides() -> None:
    """h_0 cannot be helped within one step; the other satisfies its condition, as near to the backup (0, 0) as it
    can."""
    problem = Problem(
        now=np.array([0.5, 1.0]), base=np.array([-0.2, 0.4]), slopes=np.array([[0.0, 0.0], [1.0, -1.0]]),
        low=np.array([-1.0, -1.0]), high=np.array([1.0, 1.0]), nominal=np.array([-0.9, 0.3]), weights=np.ones(2),
        epsilon=np.zeros(2), eta=0.2,
    )  # fmt: skip
    verdict = problem.decide()
    assert verdict.status is Status.relaxed
    np.testing.assert_allclose(verdict.action, [0.2, -0.2], atol=0.02)
    assert verdict.reason.endswith("No action changes h0 within one step: the backup is used as the nominal action.")


FEWER = hypothesis_settings(derandomize=True, deadline=None, database=None, max_examples=60)
exponents = st.floats(-12.0, 12.0)
scales = st.floats(-6.0, 6.0)


@dataclass
class Units:
    """1 of the original is this much here."""

    h: float = 1.0
    state: Any = 1.0
    action: Any = 1.0


SAME = Units()


def readme(units: Units, gradient: bool = False) -> SafetyFilter:
    """The mass before a wall of the README: position and speed, acceleration."""
    f, g = np.array([[1.0, 0.05], [0.0, 1.0]]), np.array([[0.00125], [0.05]])
    state, action = np.broadcast_to(units.state, 2), np.broadcast_to(units.action, 1)

    def h(x: Values) -> float:
        place, speed = x / state
        forward = max(speed, 0.0)
        return float(units.h * (1.0 - place - forward**2 / 1.6 - 0.1 * forward))

    def slopes(x: Values) -> Values:
        speed = x[1] / state[1]
        return np.asarray(units.h * np.array([-1.0, -(speed / 0.8 + 0.1) if speed > 0.0 else 0.0]) / state)

    settings = FilterSettings(
        action_low=(float(-action[0]),), action_high=(float(action[0]),), backup_action=(float(-action[0]),), eta=0.1,
        epsilon=0.002 * units.h,
    )  # fmt: skip
    matrix = state[:, np.newaxis] * g / action

    def affine(x: Values) -> tuple[Values, Values]:
        return state * (f @ (x / state)), matrix

    return SafetyFilter(affine, [FunctionBarrier(h, slopes if gradient else None)], settings)


def driven(units: Units, ticks: int = 150, gradient: bool = False) -> tuple[list[Status], Values, float]:
    """Statuses, actions as shares of the range, and the furthest place: full throttle towards the wall at 1.0."""
    safe = readme(units, gradient)
    state, action = np.broadcast_to(units.state, 2), float(np.broadcast_to(units.action, 1)[0])
    f, g = np.array([[1.0, 0.05], [0.0, 1.0]]), np.array([0.00125, 0.05])
    place, statuses, actions, furthest = np.array([0.0, 0.0]), [], [], 0.0
    for _ in range(ticks):
        verdict = safe.decide(place * state, [action])
        statuses.append(verdict.status)
        actions.append(verdict.action[0] / action)
        place = f @ place + g * actions[-1]
        furthest = max(furthest, float(place[0]))
    return statuses, np.array(actions), furthest


ORIGINAL = {gradient: driven(SAME, gradient=gradient) for gradient in (False, True)}


def test_the_mass_stops_before_the_wall() -> None:
    for statuses, _, furthest in ORIGINAL.values():
        assert 0.9 < furthest <= 1.0
        assert set(statuses) == {Status.passed, Status.corrected}


@pytest.mark.parametrize("gradient", [False, True])
@pytest.mark.parametrize(
    "units",
    [*(Units(h=10.0**exponent) for exponent in (-12, -6, -3, 3, 6, 12)),
     *(Units(state=np.array(both)) for both in ((1e-6, 1e-6), (1e6, 1e6), (1e-6, 1e6), (1e6, 1e-6), (1.0, 1e3))),
     *(Units(action=10.0**exponent) for exponent in (-6, 6))],
    ids=str,
)  # fmt: skip
def test_h_states_and_actions_in_any_unit(units: Units, gradient: bool) -> None:
    statuses, actions, furthest = driven(units, gradient=gradient)
    wanted, own, _ = ORIGINAL[gradient]
    assert furthest <= 1.0
    assert statuses == wanted
    np.testing.assert_allclose(actions, own, rtol=0.0, atol=2e-6)


@FEWER
@given(exponents, st.tuples(scales, scales), scales, st.booleans(), st.floats(0.0, 0.97), st.floats(-1.0, 1.5))
def test_one_decision_in_any_units(h, state, action, gradient, place, speed):
    """Also where h is below 0, or no action satisfies the condition."""
    units = Units(10.0**h, 10.0 ** np.array(state), 10.0**action)
    start = np.array([place, speed])
    one = readme(SAME, gradient).decide(start, [1.0])
    other = readme(units, gradient).decide(start * units.state, [units.action])
    compare(one, other, units, 2e-6)


def compare(one: Verdict, other: Verdict, units: Units, within: float) -> None:
    assert other.status is one.status
    assert other.active == one.active
    np.testing.assert_allclose(other.action / units.action, one.action, rtol=0.0, atol=within)
    size = max(abs(one.h_now), abs(one.h_next), 1e-3)
    assert other.h_now / units.h == pytest.approx(one.h_now, abs=1e-9 * size)
    assert other.h_next / units.h == pytest.approx(one.h_next, abs=1e-4 * size)
    assert other.slack / units.h == pytest.approx(one.slack, abs=1e-4 * size)


@dataclass
class Planar:
    """x[t+1] = x + d + B a with two or three actions, and discs and half planes, each in a unit of its own."""

    actions: int
    seed: int
    units: Values = field(default_factory=lambda: np.ones(4))
    state: Values = field(default_factory=lambda: np.ones(3))
    action: Values = field(default_factory=lambda: np.ones(3))

    def decide(self) -> Verdict:
        random = np.random.default_rng(self.seed)
        matrix, drift = random.normal(0.0, 0.2, (3, self.actions)), random.normal(0.0, 0.2, 3)
        centres, radii = random.normal(0.0, 1.0, (3, 3)), random.uniform(0.2, 0.8, 3)
        normal, offset = random.normal(size=3), random.uniform(0.0, 1.5)
        start, nominal = random.normal(0.0, 1.0, 3), random.uniform(-1.2, 1.2, self.actions)
        state, action = self.state, self.action[: self.actions]

        def disc(index: int) -> AbstractBarrier:
            def h(x: Values) -> float:
                return float(self.units[index] * (np.linalg.norm(x / state - centres[index]) - radii[index]))

            return FunctionBarrier(h, names=(f"disc {index}",), kind=f"disc {index}")

        plane = FunctionBarrier(
            lambda x: self.units[3] * (normal @ (x / state) + offset), names=("plane",), kind="plane"
        )
        barriers = [*map(disc, range(3)), plane]
        settings = FilterSettings(
            action_low=tuple(-action),
            action_high=tuple(action),
            eta=0.3,
            epsilon={barrier.kind: 0.01 * unit for barrier, unit in zip(barriers, self.units, strict=True)},
        )
        safe = SafetyFilter(lambda x: (x + state * drift, state[:, np.newaxis] * matrix / action), barriers, settings)
        return safe.decide(start * state, nominal * action)


@FEWER
@given(
    st.integers(0, 10**6), st.sampled_from([2, 3]), st.tuples(*[exponents] * 4), st.tuples(*[scales] * 3),
    st.tuples(*[scales] * 3),
)  # fmt: skip
def test_each_barrier_and_each_entry_in_a_unit_of_its_own(seed: int, actions: int, units: Any, state: Any, action: Any):
    scaled = Planar(actions, seed, *(10.0 ** np.array(some) for some in (units, state, action)))
    one, other = Planar(actions, seed).decide(), scaled.decide()
    assert other.status is one.status
    assert other.reason == one.reason
    np.testing.assert_allclose(other.action / scaled.action[:actions], one.action, rtol=0.0, atol=1e-5)


def test_the_planar_scenes_hold_every_kind_of_verdict() -> None:
    found = {Planar(2 + seed % 2, seed).decide().status for seed in range(100)}
    assert found == {Status.passed, Status.corrected, Status.relaxed, Status.violated}
