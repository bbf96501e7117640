"""The search of many robots alongside the search of one, which is watched: same answers, and certain of the same."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from safedpa.safety import Barriers, FilterSettings, FunctionBarrier, Prediction, QuadraticProgram
from safedpa.safety.batch.constraints import BatchConstraints, _would_backtrack, solve_sqp_batch
from safedpa.safety.solver.constraints import ActionCandidate, Constraints
from safedpa.safety.solver.qp_scaling import solve_hard, violable_rows
from safedpa.safety.solver.solution import Solution
from safedpa.safety.solver.sqp import backtrack_towards, solve_sqp

Values = NDArray[np.float64]

TWO = FilterSettings(
    action_low=(-1.0, 0.5), action_high=(3.0, 2.5), backup_action=(0.0, 1.0), weights=(1.0, 4.0), eta=0.3, epsilon=0.01
)
ONE = replace(TWO, action_low=(-1.0,), action_high=(3.0,), backup_action=(0.0,), weights=(1.0,))


class Problems:
    """So many problems: x+ = x + G(x) a, the first action cut off at ``most``; h_i = p_i x + level_i - bend_i |x|^2."""

    def __init__(self, seed: int, count: int, settings: FilterSettings, bend: float, most: float, rows: int) -> None:
        random, actions = np.random.default_rng(seed), len(settings.low)
        self.settings, self.most = settings, most
        self.state = random.uniform(-1.0, 1.0, (count, 2)) * random.choice([1.0, 30.0], (count, 1))
        self.G = random.normal(size=(count, 2, actions)) * 10.0 ** random.uniform(-2.0, 0.0, (count, 1, 1))
        self.G[random.random((count, 2, actions)) < 0.1] = 0.0
        self.p = random.normal(size=(count, rows, 2)) * 10.0 ** random.uniform(-3.0, 3.0, (count, rows, 1))
        size = np.abs(self.p @ np.abs(self.G)) @ (settings.high - settings.low)
        self.bend = bend * size * random.uniform(0.0, 1.0, (count, rows))
        now = random.uniform(0.0, 1.0, (count, rows)) * size
        self.level = now - np.einsum("nij,nj->ni", self.p, self.state)
        self.nominal = random.uniform(settings.low - 0.3, settings.high + 0.3, (count, actions))

    def moved(self, robots: Any, state: Values, action: Values) -> Values:
        """x+ (..., 2)."""
        cut = np.concatenate([np.minimum(action[..., :1], self.most), action[..., 1:]], axis=-1)
        return np.asarray(state + np.einsum("...ij,...j->...i", self.G[robots], cut))

    def g(self, robots: Any, action: Values) -> Values:
        """d(x+)/d(a) (..., 2, actions)."""
        g = self.G[robots].copy()
        g[..., 0] *= action[..., :1] <= self.most
        return g

    def heights(self, robots: Any, x: Values) -> Values:
        """h (..., rows)."""
        away = x - self.state[robots]
        straight = np.einsum("...ij,...j->...i", self.p[robots], x) + self.level[robots]
        return np.asarray(straight - self.bend[robots] * (away**2).sum(axis=-1)[..., np.newaxis])

    def gradient(self, robots: Any, x: Values) -> Values:
        """(..., rows, 2)."""
        away = x - self.state[robots]
        return np.asarray(self.p[robots] - 2.0 * self.bend[robots][..., np.newaxis] * away[..., np.newaxis, :])

    def one(self, robot: int) -> Constraints:
        """The conditions of one of them."""

        def step(x: Values, action: Values) -> Values:
            return self.moved(robot, x, action)

        def affine(x: Values, around: Values) -> tuple[Values, Values]:
            g = self.g(robot, around)
            return step(x, around) - g @ around, g

        names = tuple(f"h{row}" for row in range(self.p.shape[1]))
        barrier = FunctionBarrier(lambda x: self.heights(robot, x), lambda x: self.gradient(robot, x), names)
        state, sides = tuple(self.state[robot].tolist()), self.program().sides
        margins, prediction = [0.01] * len(names), Prediction(affine, step)
        return Constraints(Barriers([barrier]), prediction, state, None, None, self.settings.eta, margins, sides)

    def program(self) -> QuadraticProgram:
        """Of the settings."""
        return QuadraticProgram(self.settings.low, self.settings.high, self.settings.weight_vector)


class Moving:
    """Many predictions of these robots."""

    affine = False

    def __init__(self, problems: Problems, robots: Any) -> None:
        self._problems, self._robots, self.state = problems, robots, problems.state[robots]

    def only(self, which: Any) -> Moving:
        return Moving(self._problems, self._robots[which])

    def next_state(self, action: Values) -> Values:
        return self._problems.moved(self._robots, self.state, action)

    def control_matrix(self, action: Values) -> Values:
        return self._problems.g(self._robots, action)


class Rows:
    """Many barriers of these robots."""

    def __init__(self, problems: Problems, robots: Any) -> None:
        self._problems, self._robots = problems, robots

    def only(self, which: Any) -> Rows:
        return Rows(self._problems, self._robots[which])

    def h(self, states: Values) -> Values:
        return self._problems.heights(self._robots, states)

    def lie_derivative(self, states: Values, g: Values, widths: Values) -> Values:
        return np.asarray(self._problems.gradient(self._robots, states) @ g)


class Watched:
    """A program, and conditions, that remember what they were asked."""

    def __init__(self, conditions: Constraints, program: QuadraticProgram) -> None:
        self._conditions, self._program = conditions, program
        self.sides, self.distance = program.sides, program.distance
        self.linearize, self.min_scaled_residual = conditions.linearize, conditions.min_scaled_residual
        self.closed: list[bool] = []
        self.found: list[ActionCandidate] = []

    @property
    def saturated(self) -> bool:
        return self._conditions.saturated

    def evaluate(self, action: Any) -> ActionCandidate:
        self.found.append(self._conditions.evaluate(action))
        return self.found[-1]

    def solve(self, A: Sequence[Any], b: Any, nominal: Any) -> Solution:
        """Remembers whether there is a closed form without slack."""
        _, rows = violable_rows(A, b, self.sides)
        weights = tuple(self._program.weights.tolist())
        self.closed.append(not rows or solve_hard(rows, nominal, self.sides, weights) is not None)
        return self._program.solve(A, b, nominal)


def alone(conditions: Constraints, program: QuadraticProgram, nominal: Any, rounds: int):
    """What one robot's search finds, and whether it is the first solution that keeps all, with all programs in closed
    form, after which nothing else was tried, and which is not brought back."""
    asked = conditions.evaluate(np.clip(nominal, program.low, program.high).tolist())
    watched = Watched(conditions, program)
    found, _ = solve_sqp(watched, watched, nominal, asked, rounds)  # type: ignore[arg-type]
    plain = found.is_feasible and all(watched.closed) and len(watched.closed) == len(watched.found)
    plain = plain and found is watched.found[-1] and not any(one.is_feasible for one in watched.found[:-1])
    return found, bool(plain and backtrack_towards(conditions, program.sides, nominal, found) is found)


def agreed(problems: Problems) -> int:
    """Searches those that break something, and each of them alone; returns how many are certain."""
    own, robots, program = problems.settings, np.arange(len(problems.state)), problems.program()
    ones = [problems.one(robot) for robot in robots]
    required, scale = np.array([one.rhs for one in ones]), np.array([one.scales for one in ones])
    around, moving = Rows(problems, robots), Moving(problems, robots)
    conditions = BatchConstraints(own, around, moving, required, scale, np.zeros(len(robots), dtype=bool))  # type: ignore[arg-type]
    start = conditions.evaluate(np.clip(problems.nominal, own.low, own.high))
    broken = np.flatnonzero(~conditions.is_feasible(start))
    found, certain = solve_sqp_batch(conditions.only(broken), problems.nominal[broken], start.only(broken))
    for place, robot in enumerate(broken.tolist()):
        wanted, plain = alone(ones[robot], program, problems.nominal[robot].tolist(), own.relinearisations + 1)
        assert certain[place] == plain, robot
        if plain:
            np.testing.assert_allclose(found.action[place], wanted.action, rtol=0.0, atol=1e-7)
    return int(certain.sum())


@pytest.mark.long
@pytest.mark.parametrize("settings", [TWO, ONE], ids=["two", "one"])
@pytest.mark.parametrize("bend", [0.0, 0.1, 0.6])
@pytest.mark.parametrize("most", [9.0, 1.5], ids=["free", "saturates"])
def test_many_are_searched_as_one_is(settings: FilterSettings, bend: float, most: float) -> None:
    problems = [
        Problems(rows, 250, replace(settings, relinearisations=rounds), bend, most, rows)
        for rows, rounds in ((1, 0), (2, 1), (3, 3), (6, 3))
    ]
    assert sum(map(agreed, problems)) > 20


def test_a_condition_that_no_action_changes_leaves_the_others_as_certain_as_they_are() -> None:
    problems = Problems(3, 100, TWO, 0.0, 9.0, 3)
    problems.p[:, 0], problems.level[:, 0] = 0.0, 1.0
    assert agreed(problems) > 20


@pytest.mark.parametrize("settings", [TWO, ONE], ids=["two", "one"])
def test_an_entry_is_brought_back_where_that_of_one_robot_is(settings: FilterSettings) -> None:
    """Of any action that keeps all, wherever it was found, and a nominal action anywhere."""
    random, count = np.random.default_rng(7), 600
    problems, robots = Problems(7, count, settings, 0.3, 1.5, 2), np.arange(count)
    ones, sides = [problems.one(robot) for robot in robots], problems.program().sides
    required, scale = np.array([one.rhs for one in ones]), np.array([one.scales for one in ones])
    around, moving = Rows(problems, robots), Moving(problems, robots)
    conditions = BatchConstraints(settings, around, moving, required, scale, np.zeros(count, dtype=bool))  # type: ignore[arg-type]
    near = problems.nominal + random.normal(0.0, 0.1, problems.nominal.shape) * (settings.high - settings.low)
    found = conditions.evaluate(np.clip(near, settings.low, settings.high))
    kept = np.flatnonzero(conditions.is_feasible(found))
    back = _would_backtrack(conditions.only(kept), problems.nominal[kept], found.only(kept))
    wanted = []
    for robot in kept.tolist():
        one = ones[robot].evaluate(found.action[robot].tolist())
        wanted.append(backtrack_towards(ones[robot], sides, problems.nominal[robot].tolist(), one) is not one)
    assert back.tolist() == wanted
    assert 20 < sum(wanted) < len(wanted) - 20
