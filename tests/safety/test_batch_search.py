"""The search of many robots, part by part: what it calls kept, near and silent, next to the conditions of one robot."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from safedpa.safety import Barriers, FilterSettings, FunctionBarrier, Prediction, QuadraticProgram
from safedpa.safety.batch.constraints import BatchCandidates, BatchConstraints
from safedpa.safety.solver.constraints import Constraints

Values = NDArray[np.float64]

LOW, HIGH = (-1.0, 0.5), (3.0, 2.5)
SETTINGS = FilterSettings(
    action_low=LOW, action_high=HIGH, backup_action=(0.0, 1.0), weights=(1.0, 4.0), eta=0.3, epsilon=0.01
)
MOST = 1.5
"""Of the first action, from which on it changes nothing: the actuator saturates."""
SLOPES = np.array([[1.0, -2.0], [0.5, 0.25], [-1.0, 0.5]])


def moved(state: Values, action: Values) -> Values:
    """x+ (..., 2)."""
    return np.asarray(state + np.stack([np.minimum(action[..., 0], MOST), action[..., 1]], axis=-1))


class Moving:
    """What ``BatchConstraints`` needs of many predictions."""

    affine = False

    def __init__(self, state: Values) -> None:
        self.state = state

    def only(self, which: Any) -> Moving:
        return Moving(self.state[which])

    def next_state(self, action: Values) -> Values:
        return moved(self.state, action)

    def control_matrix(self, action: Values) -> Values:
        g = np.tile(np.eye(2), (len(action), 1, 1))
        g[action[:, 0] > MOST, 0, 0] = 0.0
        return g


class Rows:
    """h = SLOPES x + 5 of many."""

    def only(self, which: Any) -> Rows:
        return self

    def h(self, states: Values) -> Values:
        return np.asarray(states @ SLOPES.T + 5.0)

    def lie_derivative(self, states: Values, g: Values, width: Values) -> Values:
        return np.asarray(SLOPES @ g)


def of_one(state: Values) -> Constraints:
    def step(x: Values, action: Values) -> Values:
        return moved(x, action)

    def affine(x: Values, around: Values) -> tuple[Values, Values]:
        g = np.diag([float(around[0] <= MOST), 1.0])
        return step(x, around) - g @ around, g

    barrier = FunctionBarrier(lambda x: SLOPES @ x + 5.0, names=("a", "b", "c"))
    sides = QuadraticProgram(np.array(LOW), np.array(HIGH), np.ones(2)).sides
    prediction = Prediction(affine, step)
    return Constraints(Barriers([barrier]), prediction, tuple(state.tolist()), None, None, 0.3, [0.01] * 3, sides)


def many(states: Values, ones: list[Constraints]) -> BatchConstraints:
    return BatchConstraints(
        SETTINGS,
        Rows(),  # type: ignore[arg-type]
        Moving(states),  # type: ignore[arg-type]
        np.array([one.rhs for one in ones]),
        np.array([one.scales for one in ones]),
        np.zeros(len(ones), dtype=bool),
    )


@pytest.fixture
def drawn() -> tuple[Values, Values, list[Constraints]]:
    random = np.random.default_rng(11)
    states = random.uniform(-1.0, 1.0, (200, 2))
    return states, random.uniform(LOW, HIGH, (200, 2)), [of_one(state) for state in states]


def test_what_is_kept_and_how_nearly_is_what_the_conditions_of_one_say(drawn: Any) -> None:
    states, actions, ones = drawn
    conditions = many(states, ones)
    found = conditions.evaluate(actions)
    alone = [one.evaluate(action.tolist()) for one, action in zip(ones, actions, strict=True)]
    np.testing.assert_allclose(found.h_next, [one.h_next for one in alone], atol=1e-12)
    assert conditions.is_feasible(found).tolist() == [one.is_feasible for one in alone]
    assert 20 < sum(one.is_feasible for one in alone) < 180
    tightest = [one.min_scaled_residual(outcome) for one, outcome in zip(ones, alone, strict=True)]
    np.testing.assert_allclose(conditions.min_scaled_residual(found), tightest, rtol=1e-9)


def test_what_is_missed_by_rounding_is_kept_and_what_is_no_number_is_not(drawn: Any) -> None:
    """A ten-billionth of the scale, whatever the scale is; and h = 0 is as good as above it."""
    states, _, ones = drawn
    conditions = many(states[:1], ones[:1])
    conditions.scale[:] = [1e6, 1e-6, 1.0]
    h, following = np.array([[5.0, 0.0, 5.0]]), states[:1]
    for share, kept in ((0.0, True), (-0.5e-10, True), (-2e-10, False)):
        residual = share * conditions.scale
        assert conditions.is_feasible(BatchCandidates(states[:1], following, h, residual)).tolist() == [kept]
    good = np.zeros((1, 3))
    assert not conditions.is_feasible(BatchCandidates(states[:1], following, np.array([[5.0, -1e-3, 5.0]]), good)).any()
    for broken in (np.nan, np.inf):
        spoiled = BatchCandidates(states[:1], np.array([[0.0, broken]]), h, good)
        assert not conditions.is_feasible(spoiled).any()


def test_distances_are_those_of_the_program(drawn: Any) -> None:
    states, actions, ones = drawn
    program = QuadraticProgram(np.array(LOW), np.array(HIGH), np.array([1.0, 4.0]))
    nominal_actions = np.roll(actions, 1, axis=0)
    wanted = [program.distance(action, nominal) for action, nominal in zip(actions, nominal_actions, strict=True)]
    np.testing.assert_allclose(many(states, ones).distance(actions, nominal_actions), wanted, rtol=1e-12)


def test_slopes_are_those_of_one_where_an_actuator_saturates_too(drawn: Any) -> None:
    """There the chord leads to the bound that is further away, or the slope before it is taken again."""
    states, actions, ones = drawn
    conditions, last = many(states, ones), np.full((200, 2, 2), np.nan)
    about = conditions.evaluate(actions)
    slopes = conditions.linearize(about, last)
    beyond = actions[:, 0] > MOST
    assert 40 < beyond.sum() < 160
    assert conditions.saturated.tolist() == beyond.tolist()
    far = np.array(LOW)[0]  # 1.5 lies beyond the middle of -1 and 3
    chord = np.where(beyond, (far - MOST) / (far - actions[:, 0]), 1.0)
    g = np.array([np.diag([slope, 1.0]) for slope in chord])
    np.testing.assert_allclose(slopes, SLOPES @ g, rtol=1e-9)
    reach = np.abs(slopes) @ (np.array(HIGH) - np.array(LOW))
    np.testing.assert_allclose(conditions.scale, np.maximum([one.scales for one in ones], reach), rtol=1e-12)
    again = conditions.linearize(conditions.evaluate(np.tile([2.9, 1.0], (200, 1))), last)
    np.testing.assert_allclose(again, slopes, rtol=1e-9)


class Given:
    """Predictions whose slopes are these, whatever is done."""

    affine = False

    def __init__(self, state: Values, g: Values, far: Values) -> None:
        self.state, self.g, self.far = state, g, far

    def only(self, which: Any) -> Given:
        return Given(self.state[which], self.g[which], self.far[which])

    def next_state(self, action: Values) -> Values:
        return np.asarray(self.state + self.far + action**3)

    def control_matrix(self, action: Values) -> Values:
        return self.g.copy()


def of_given(given: Given, robot: int) -> Constraints:
    """The conditions of one of them."""
    g, far = given.g[robot], given.far[robot]

    def affine(x: Values, around: Values) -> tuple[Values, Values]:
        return x, g

    def step(x: Values, action: Values) -> Values:
        return np.asarray(x + far + action**3)

    barrier = FunctionBarrier(lambda x: SLOPES @ x + 5.0, lambda x: SLOPES, names=("a", "b", "c"))
    sides = QuadraticProgram(np.array(LOW), np.array(HIGH), np.ones(2)).sides
    state = tuple(given.state[robot].tolist())
    return Constraints(Barriers([barrier]), Prediction(affine, step), state, None, None, 0.3, [0.01] * 3, sides)


def test_a_slope_is_taken_for_rounding_where_that_of_one_robot_is() -> None:
    """Slopes of all sizes, states and motions of all sizes; a chord takes the place of what says nothing."""
    random, count = np.random.default_rng(3), 400
    state = random.normal(size=(count, 2)) * 10.0 ** random.uniform(-4.0, 4.0, (count, 1))
    far = np.where(random.random((count, 1)) < 0.5, -2.0 * state, 0.0)
    g = random.normal(size=(count, 2, 2)) * 10.0 ** random.uniform(-12.0, -4.0, (count, 1, 2))
    g[random.random((count, 2, 2)) < 0.2] = 0.0
    actions = random.uniform(LOW, HIGH, (count, 2))
    actions[0], g[0] = (1.0, 1.5), 0.0  # in the middle, as far from either bound
    given = Given(state, g, far)
    ones = [of_given(given, robot) for robot in range(count)]
    wanted = [one.linearize(one.evaluate(own.tolist())).all(3) for one, own in zip(ones, actions, strict=True)]
    silent = [one.saturated for one in ones]
    conditions = replace(many(state, ones), predictions=given)
    found = conditions.linearize(conditions.evaluate(actions), np.full((count, 2, 2), np.nan))
    assert conditions.saturated.tolist() == silent
    assert 40 < sum(silent) < 360
    np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-300)
