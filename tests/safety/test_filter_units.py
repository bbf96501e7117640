"""No verdict depends on the unit in which h, a state or an action is expressed."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from safedpa.safety import AbstractBarrier, FilterSettings, FunctionBarrier, SafetyFilter, Status, Verdict

Values = NDArray[np.float64]

DRAWN = hypothesis_settings(derandomize=True, deadline=None, database=None, max_examples=60)
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
        action_low=(float(-action[0]),),
        action_high=(float(action[0]),),
        backup_action=(float(-action[0]),),
        eta=0.1,
        epsilon=0.002 * units.h,
    )
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


def agrees(units: Units, gradient: bool) -> None:
    statuses, actions, furthest = driven(units, gradient=gradient)
    wanted, own, _ = ORIGINAL[gradient]
    assert furthest <= 1.0
    assert statuses == wanted
    np.testing.assert_allclose(actions, own, rtol=0.0, atol=2e-6)


def test_the_mass_stops_before_the_wall() -> None:
    for statuses, _, furthest in ORIGINAL.values():
        assert 0.9 < furthest <= 1.0
        assert set(statuses) == {Status.passed, Status.corrected}


@pytest.mark.parametrize("gradient", [False, True])
@pytest.mark.parametrize("exponent", [-12, -6, -3, 3, 6, 12])
def test_h_in_any_unit(exponent: int, gradient: bool) -> None:
    agrees(Units(h=10.0**exponent), gradient)


@pytest.mark.parametrize("gradient", [False, True])
@pytest.mark.parametrize("exponents_of_both", [(-6, -6), (6, 6), (-6, 6), (6, -6), (0, 3)])
def test_states_in_any_unit(exponents_of_both: tuple[int, int], gradient: bool) -> None:
    agrees(Units(state=10.0 ** np.array(exponents_of_both, dtype=float)), gradient)


@pytest.mark.parametrize("gradient", [False, True])
@pytest.mark.parametrize("exponent", [-6, 6])
def test_actions_in_any_unit(exponent: int, gradient: bool) -> None:
    agrees(Units(action=10.0**exponent), gradient)


@DRAWN
@given(exponents, st.tuples(scales, scales), scales, st.booleans(), st.floats(0.0, 0.97), st.floats(-1.0, 1.5))
def test_one_decision_in_any_units(
    h: float, state: tuple[float, float], action: float, gradient: bool, place: float, speed: float
) -> None:
    """Also where h is below 0, or no action keeps the condition."""
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
        start, wish = random.normal(0.0, 1.0, 3), random.uniform(-1.2, 1.2, self.actions)
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
        return safe.decide(start * state, wish * action)


@DRAWN
@given(
    st.integers(0, 10**6),
    st.sampled_from([2, 3]),
    st.tuples(*[exponents] * 4),
    st.tuples(*[scales] * 3),
    st.tuples(*[scales] * 3),
)
def test_each_barrier_and_each_entry_in_a_unit_of_its_own(
    seed: int, actions: int, units: Any, state: Any, action: Any
) -> None:
    scaled = Planar(actions, seed, *(10.0 ** np.array(some) for some in (units, state, action)))
    one, other = Planar(actions, seed).decide(), scaled.decide()
    assert other.status is one.status
    assert other.reason == one.reason
    np.testing.assert_allclose(other.action / scaled.action[:actions], one.action, rtol=0.0, atol=1e-5)


def test_the_planar_scenes_hold_every_kind_of_verdict() -> None:
    found = {Planar(2 + seed % 2, seed).decide().status for seed in range(100)}
    assert found == {Status.passed, Status.corrected, Status.relaxed, Status.violated}
