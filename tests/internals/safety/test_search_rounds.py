"""The search's decisions one by one, with a scripted solver and scripted outcomes."""

from typing import Any

import numpy as np
import pytest
from tests.safety.scripted import GIVEN_UP, Slopes, about, outcome, solution

from safedpa.safety import QuadraticProgram, Solution
from safedpa.safety.conditions import Outcome
from safedpa.safety.search import (
    _better,
    _posed,
    _same,
    overshot,
)


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

    def tightest(self, found: Outcome) -> float:
        return min(found.residual)

    def distance(self, action: tuple[float, ...], wish: tuple[float, ...]) -> float:
        return abs(action[0] - wish[0])

    def run(self, start: Outcome, rounds: int = 4, wish: float = 9.0) -> Outcome:
        this: Any = self
        return _posed(this, this, (wish,), start, rounds)[0]


@pytest.mark.parametrize("residual", [(0.0,), (0.05,), (0.0, 1000.0), (0.05, 0.06)])
def test_ends_when_kept_and_not_needlessly_far(residual: tuple[float, ...]) -> None:
    scripted = Scripted(residual, (0.0,), (0.0,), (0.0,))
    assert scripted.run(outcome(0.0, -10.0)).action == (1.0,)
    assert scripted.solved == 1


@pytest.mark.parametrize("residual", [(0.0501,), (-1e-6,), (0.06, 1000.0), (0.06, -0.1)])
def test_goes_on_when_broken_or_needlessly_far(residual: tuple[float, ...]) -> None:
    scripted = Scripted(residual, (0.0,), (0.0,))
    assert scripted.run(outcome(0.0, -10.0)).action == (2.0,)
    assert scripted.solved == 2


def test_goes_on_when_the_prediction_is_unsafe_though_no_condition_is_broken() -> None:
    scripted: Any = Scripted((0.0,), (0.0,))
    scripted.outcome = lambda action: outcome(action[0], 0.0, unsafe=action[0] < 2.0)
    assert scripted.run(outcome(0.0, -10.0)).action == (2.0,)


def test_slopes_that_served_well_are_used_again_with_the_true_residual() -> None:
    scripted = Scripted((-0.9,), (0.0,))
    scripted.run(outcome(0.0, -10.0))
    assert scripted.tangents == 1
    assert scripted.limits[0] == 10.0


def test_more_is_asked_for_the_less_a_solution_brought() -> None:
    """Of the 8 missing 6 are left, then 3, then nothing is gained: shares 0.75, 0.5 and 1, which counts as 0.75."""
    scripted = Scripted((-6.0,), (-3.0,), (-3.0,), (-3.0,))
    scripted.run(outcome(0.0, -8.0))
    assert scripted.limits == [8.0, 1.0 + (1.0 + 3.75) * 6.0, 2.0 + (1.0 + 1.25) * 3.0, 3.0 + (1.0 + 3.75) * 3.0]


@pytest.mark.parametrize(
    ("solutions", "last", "missing", "share"),
    [
        (1, 8.0, 0.0, 0.25),
        (3, 8.0, 0.0, 0.75),
        (1, 8.0, 0.4, 0.25),
        (1, 8.0, 4.0, 1.25),
        (8, 8.0, 4.0, 2.0),
        (1, 8.0, 6.0, 3.75),
        (1, 8.0, 7.9, 3.75),
        (1, 8.0, 80.0, 3.75),
        (1, 0.0, 3.0, 0.25),
    ],
)
def test_what_is_asked_for_on_top(solutions: int, last: float, missing: float, share: float) -> None:
    assert overshot(solutions, last, missing) == pytest.approx(share)


@pytest.mark.parametrize("residual", [(-1.0,), (-1.1,), (0.3,)])
def test_slopes_that_served_badly_are_drawn_again(residual: tuple[float, ...]) -> None:
    scripted = Scripted(residual, (0.0,))
    scripted.run(outcome(0.0, -10.0))
    assert scripted.tangents == 2


def test_no_slopes_are_drawn_for_a_program_that_is_not_posed() -> None:
    scripted = Scripted((-5.0,), (-5.0,))
    scripted.run(outcome(0.0, -10.0), rounds=2)
    assert (scripted.solved, scripted.tangents) == (2, 2)


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
    program = QuadraticProgram(np.zeros(1), np.ones(1), np.ones(1))
    assert _same(program, about(1e-8), about(0.0))


def test_one_entry_that_moves_is_enough() -> None:
    program = QuadraticProgram(np.zeros(2), np.full(2, 9.0), np.ones(2))
    assert _same(program, about(1.0, 1.0), about(1.0, 1.0))
    assert not _same(program, about(1.0, 1.0), about(1.0, 2.0))
    assert not _same(program, about(2.0, 1.0), about(1.0, 1.0))


def test_rounds_are_limited_and_the_least_broken_is_returned() -> None:
    scripted = Scripted((-5.0,), (-3.0,), (-4.0,), (-6.0,))
    assert scripted.run(outcome(0.0, -10.0)).action == (2.0,)
    assert scripted.solved == 4


def test_the_first_solution_replaces_the_start_whatever_it_is() -> None:
    """The start is the caller's already: what is asked is what the program leads to."""
    scripted = Scripted((-12.0,))
    assert scripted.run(outcome(0.0, -10.0), rounds=1).action == (1.0,)


def test_kept_beats_broken_and_near_beats_far() -> None:
    scripted: Any = Scripted()
    wish = (0.0,)

    def better(one: Outcome, other: Outcome) -> Outcome:
        return _better(scripted, scripted, wish, one, other)

    near, far, broken, worse, unsafe = (
        outcome(1.0, 0.0),
        outcome(3.0, 0.0),
        outcome(0.0, -0.5),
        outcome(0.0, -0.6),
        outcome(0.5, 0.0, unsafe=True),
    )
    assert better(near, far) is near
    assert better(far, near) is near
    assert better(far, broken) is far
    assert better(broken, far) is far
    assert better(far, unsafe) is far
    assert better(unsafe, far) is far
    assert better(broken, worse) is broken
    assert better(worse, broken) is broken
    twin, copy = outcome(1.0, 0.0), outcome(0.0, -0.5)
    assert better(near, twin) is near
    assert better(broken, copy) is broken


def solver_says(*solutions: Solution) -> tuple[Outcome, str]:
    """What the search makes of these solutions of a program with as many actions, from a broken start."""
    count, left = len(solutions[0].action), list(solutions)
    program: Any = QuadraticProgram(np.zeros(count), np.ones(count), np.ones(count))

    class Given:
        sides = program.sides
        distance = program.distance

        def solve(self, *_: Any) -> Solution:
            return left.pop(0)

    conditions: Any = Scripted()
    conditions.outcome = lambda taken: about(*taken)
    given: Any = Given()
    found, _, word = _posed(conditions, given, [0.0] * count, outcome(0.0, -1.0), len(solutions))
    return found, word


@pytest.mark.parametrize("missed", [1e-6, 1e-3, 5.0])
def test_a_solution_beyond_the_bounds_is_taken_at_the_bounds(missed: float) -> None:
    """However far it missed them: what counts is what the model predicts for the action itself."""
    assert solver_says(solution(-missed, 0.5))[0].action == (0.0, 0.5)
    assert solver_says(solution(0.5, 1.0 + missed))[0].action == (0.5, 1.0)


@pytest.mark.parametrize("none", [np.nan, np.inf, -np.inf])
def test_one_entry_that_is_no_number_is_enough_to_believe_none(none: float) -> None:
    found, _ = solver_says(solution(0.5, float(none)))
    assert found.action == (0.0,)  # the start


def test_a_solver_that_gives_up_leaves_what_was_found_before() -> None:
    found, word = solver_says(GIVEN_UP)
    assert (found.action, found.kept, word) == ((0.0,), False, "max iter reached")
    scripted: Any = Scripted((-5.0,))
    first = scripted.solve
    scripted.solve = lambda A, b, wish: first(A, b, wish) if scripted.solved == 0 else GIVEN_UP
    assert scripted.run(outcome(0.0, -10.0)).action == (1.0,)
    assert (scripted.solved, scripted.tangents) == (1, 2)
