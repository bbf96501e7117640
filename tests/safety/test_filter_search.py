"""The search's decisions one by one, with a scripted solver and scripted outcomes."""

from typing import Any

import numpy as np
import pytest

from safedpa.safety import QuadraticProgram, Solution
from safedpa.safety.conditions import Outcome
from safedpa.safety.search import DecisionError, _better, _same, search

TOLERANCE = 0.25


def outcome(action: float, *residual: float) -> Outcome:
    return Outcome((action,), [0.0], [0.0] * len(residual), list(residual))


def about(*action: float) -> Outcome:
    return Outcome(action, [0.0], [0.0], [0.0])


class Slopes:
    """Of one condition, 1 of the first action; its limit follows from the residual."""

    def at(self, about: Outcome) -> tuple[list[list[float]], list[float]]:
        return [[1.0]], [about.action[0] - about.residual[0]]


class Scripted:
    """Stands for conditions and solver: the n-th solution is n or as given, its residuals the n-th of the script."""

    def __init__(self, *script: tuple[float, ...], actions: tuple[float, ...] = (1.0, 2.0, 3.0, 4.0)) -> None:
        self.actions = actions
        self.script, self.solved, self.tangents = script, 0, 0
        self.limits: list[float] = []
        self.low, self.high, self.range = np.zeros(1), np.full(1, 9.0), np.full(1, 9.0)
        self.sides = ((0.0, 9.0, 9.0),)

    def linearised(self, about: Outcome) -> Slopes:
        self.tangents += 1
        return Slopes()

    def solve(self, A: list[list[float]], b: list[float], wish: tuple[float, ...]) -> Solution:
        self.solved += 1
        self.limits.append(b[0])
        return Solution([self.actions[self.solved - 1]], [0.0], True, "solved")

    def outcome(self, action: tuple[float, ...]) -> Outcome:
        return outcome(action[0], *self.script[self.solved - 1])

    def distance(self, action: tuple[float, ...], wish: tuple[float, ...]) -> float:
        return abs(action[0] - wish[0])

    def run(self, start: Outcome, rounds: int = 4, wish: float = 9.0) -> Outcome:
        this: Any = self
        return search(this, this, (wish,), start, rounds, TOLERANCE)[0]


@pytest.mark.parametrize("residual", [(0.0,), (-0.25,), (25.0,), (0.0, 1000.0), (-0.25, 3.0)])
def test_ends_when_kept_and_not_needlessly_far(residual: tuple[float, ...]) -> None:
    scripted = Scripted(residual, (0.0,), (0.0,), (0.0,))
    assert scripted.run(outcome(0.0, -10.0)).action == (1.0,)
    assert scripted.solved == 1


@pytest.mark.parametrize("residual", [(25.1,), (-0.26,), (26.0, 1000.0)])
def test_goes_on_when_broken_or_needlessly_far(residual: tuple[float, ...]) -> None:
    scripted = Scripted(residual, (0.0,), (5.0,))
    assert scripted.run(outcome(0.0, -10.0)).action == (2.0,)
    assert scripted.solved == 2


def test_slopes_that_served_well_are_used_again_with_the_true_residual() -> None:
    scripted = Scripted((-0.9,), (0.0,))
    scripted.run(outcome(0.0, -10.0))
    assert scripted.tangents == 1
    assert scripted.limits == [10.0, 1.0 * 1.0 + 0.9]


@pytest.mark.parametrize("residual", [(-1.0,), (-1.1,), (30.0,)])
def test_slopes_that_served_badly_are_drawn_anew(residual: tuple[float, ...]) -> None:
    scripted = Scripted(residual, (0.0,))
    scripted.run(outcome(0.0, -10.0))
    assert scripted.tangents == 2


def test_service_is_judged_against_the_last_solution() -> None:
    """0.6 is less than a tenth of the start's 10, but not of the last solution's 5."""
    scripted = Scripted((-5.0,), (-0.6,), (0.0,))
    scripted.run(outcome(0.0, -10.0))
    assert (scripted.solved, scripted.tangents) == (3, 3)


@pytest.mark.parametrize("again", [1.0, 1.0 + 8.9e-8, 1.0 - 8.9e-8])
def test_ends_when_fresh_slopes_lead_to_the_same_solution(again: float) -> None:
    """The range is 9: solutions within 9e-8 are the same."""
    scripted = Scripted((-5.0,), (-5.0,), (0.0,), actions=(1.0, again, 2.0))
    scripted.run(outcome(0.0, -10.0))
    assert (scripted.solved, scripted.tangents) == (2, 2)


@pytest.mark.parametrize("again", [1.0 + 9.1e-8, 1.0 - 9.1e-8])
def test_goes_on_while_the_solution_moves(again: float) -> None:
    scripted = Scripted((-5.0,), (-5.0,), (0.0,), actions=(1.0, again, 2.0))
    assert scripted.run(outcome(0.0, -10.0)).action == (2.0,)


def test_ends_when_the_start_is_the_solution() -> None:
    scripted = Scripted((-10.0,), (0.0,))
    scripted.run(outcome(1.0, -10.0))
    assert scripted.solved == 1


def test_goes_on_when_reused_slopes_lead_to_the_same_solution() -> None:
    """They were drawn elsewhere: those drawn here may lead on."""
    scripted = Scripted((-0.9,), (-0.9,), (0.0,), actions=(1.0, 1.0, 2.0))
    assert scripted.run(outcome(0.0, -10.0)).action == (2.0,)
    assert (scripted.solved, scripted.tangents) == (3, 2)


def test_just_the_last_share_of_the_range_is_the_same() -> None:
    program = QuadraticProgram(np.zeros(1), np.ones(1), np.ones(1), 1.0, 1.0)
    assert _same(program, about(1e-8), about(0.0))


def test_one_entry_that_moves_is_enough() -> None:
    program = QuadraticProgram(np.zeros(2), np.full(2, 9.0), np.ones(2), 1.0, 1.0)
    assert _same(program, about(1.0, 1.0), about(1.0, 1.0))
    assert not _same(program, about(1.0, 1.0), about(1.0, 2.0))


def test_rounds_are_limited_and_the_least_broken_is_returned() -> None:
    scripted = Scripted((-5.0,), (-3.0,), (-4.0,), (-6.0,))
    assert scripted.run(outcome(0.0, -10.0)).action == (2.0,)
    assert scripted.solved == 4


def test_kept_beats_broken_and_near_beats_far() -> None:
    scripted: Any = Scripted()
    wish = (0.0,)

    def better(one: Outcome, other: Outcome) -> Outcome:
        return _better(scripted, wish, one, other, TOLERANCE)

    near, far, edge, broken, worse = (
        outcome(1.0, 0.0),
        outcome(3.0, 0.0),
        outcome(2.0, -0.25),
        outcome(0.0, -0.5),
        outcome(0.0, -0.6),
    )
    assert better(near, far) is near
    assert better(far, near) is near
    assert better(edge, far) is edge
    assert better(far, edge) is edge
    assert better(far, broken) is far
    assert better(broken, far) is far
    assert better(broken, worse) is broken
    assert better(worse, broken) is broken
    twin, copy = outcome(1.0, 0.0), outcome(0.0, -0.5)
    assert better(near, twin) is near
    assert better(broken, copy) is broken


def solver_says(monkeypatch: pytest.MonkeyPatch, *action: float) -> Outcome:
    count = len(action)
    program = QuadraticProgram(np.zeros(count), np.ones(count), np.ones(count), 1.0, 1.0)
    monkeypatch.setattr(QuadraticProgram, "solve", lambda *_: Solution(action, [0.0], True, "solved"))
    conditions: Any = Scripted()
    conditions.outcome = lambda taken: about(*taken)
    return search(conditions, program, [0.0] * count, outcome(0.0, -1.0), 1, TOLERANCE)[0]


def test_one_bad_entry_is_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(DecisionError, match="holds NaN or infinity"):
        solver_says(monkeypatch, 0.5, np.nan)
    with pytest.raises(DecisionError, match="misses the actuator bounds"):
        solver_says(monkeypatch, 0.5, 1.5)


def test_bounds_may_be_missed_by_a_millionth(monkeypatch: pytest.MonkeyPatch) -> None:
    assert solver_says(monkeypatch, -1e-6, 0.5).action == (0.0, 0.5)
    with pytest.raises(DecisionError, match="misses the actuator bounds"):
        solver_says(monkeypatch, -1.1e-6, 0.5)
