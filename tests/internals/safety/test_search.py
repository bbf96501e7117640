"""The search's decisions one by one, and its ways back towards the nominal action, with scripted outcomes."""

from typing import Any

import numpy as np
import pytest
from tests.safety.scripted import GIVEN_UP, Gradients, about, outcome, solution

from safedpa.safety import QuadraticProgram, Solution
from safedpa.safety.solver.constraints import ActionCandidate
from safedpa.safety.solver.sqp import (
    AGAIN,
    DOUBTFUL,
    NEEDLESS,
    TRIES,
    _is_repeated,
    _iterate,
    _pick_better,
    _undo_largest_change,
    line_search,
    solve_sqp,
    tighten,
)


class Scripted:
    """Stands for conditions and solver: the n-th solution is n or as given, its residuals the n-th of the script."""

    def __init__(self, *script: tuple[float, ...], actions: tuple[float, ...] = (1.0, 2.0, 3.0, 4.0)) -> None:
        self.actions = actions
        self.script, self.solved, self.tangents = script, 0, 0
        self.limits: list[float] = []
        self.low, self.high, self.range = np.zeros(1), np.full(1, 9.0), np.full(1, 9.0)
        self.sides = ((0.0, 9.0, 9.0),)

    def linearize(self, about: ActionCandidate) -> Gradients:
        self.tangents += 1
        return Gradients()

    def solve(self, A: list[list[float]], b: list[float], nominal: tuple[float, ...]) -> Solution:
        self.solved += 1
        self.limits.append(b[0])
        return Solution([self.actions[self.solved - 1]], [0.0], True, "solved")

    def evaluate(self, action: tuple[float, ...]) -> ActionCandidate:
        return outcome(action[0], *self.script[self.solved - 1])

    def min_scaled_residual(self, found: ActionCandidate) -> float:
        return min(found.residual)

    def distance(self, action: tuple[float, ...], nominal: tuple[float, ...]) -> float:
        return abs(action[0] - nominal[0])

    def run(self, start: ActionCandidate, rounds: int = 4, nominal: float = 9.0) -> ActionCandidate:
        this: Any = self
        return _iterate(this, this, (nominal,), start, rounds)[0]


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
    scripted.evaluate = lambda action: outcome(action[0], 0.0, unsafe=action[0] < 2.0)
    assert scripted.run(outcome(0.0, -10.0)).action == (2.0,)


def test_slopes_that_served_well_are_used_again_and_more_is_asked_for_the_less_a_solution_brought() -> None:
    scripted = Scripted((-0.9,), (0.0,))
    scripted.run(outcome(0.0, -10.0))
    assert scripted.tangents == 1
    assert scripted.limits[0] == 10.0
    # Of the 8 missing 6 are left, then 3, then nothing is gained: shares 0.75, 0.5 and 1, which counts as 0.75.
    scripted = Scripted((-6.0,), (-3.0,), (-3.0,), (-3.0,))
    scripted.run(outcome(0.0, -8.0))
    assert scripted.limits == [8.0, 1.0 + (1.0 + 3.75) * 6.0, 2.0 + (1.0 + 1.25) * 3.0, 3.0 + (1.0 + 3.75) * 3.0]


@pytest.mark.parametrize(
    ("solutions", "last", "missing", "share"),
    [
        (1, 8.0, 0.0, 0.25), (3, 8.0, 0.0, 0.75), (1, 8.0, 0.4, 0.25), (1, 8.0, 4.0, 1.25), (8, 8.0, 4.0, 2.0),
        (1, 8.0, 6.0, 3.75), (1, 8.0, 7.9, 3.75), (1, 8.0, 80.0, 3.75), (1, 0.0, 3.0, 0.25),
    ],
)  # fmt: skip
def test_what_is_asked_for_on_top(solutions: int, last: float, missing: float, share: float) -> None:
    assert tighten(solutions, last, missing) == pytest.approx(share)


@pytest.mark.parametrize("residual", [(-1.0,), (-1.1,), (0.3,)])
def test_slopes_that_served_badly_are_drawn_again(residual: tuple[float, ...]) -> None:
    scripted = Scripted(residual, (0.0,))
    scripted.run(outcome(0.0, -10.0))
    assert scripted.tangents == 2


def test_no_slopes_are_drawn_for_no_program_and_service_is_judged_against_the_last_solution() -> None:
    scripted = Scripted((-5.0,), (-5.0,))
    scripted.run(outcome(0.0, -10.0), rounds=2)
    assert (scripted.solved, scripted.tangents) == (2, 2)
    # 0.6 is less than a tenth of the start's 10, but not of the last solution's 5.
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


def test_it_ends_when_the_start_is_the_solution_but_not_for_reused_slopes() -> None:
    scripted = Scripted((-10.0,), (0.0,))
    scripted.run(outcome(1.0, -10.0))
    assert scripted.solved == 1
    # They were drawn elsewhere: those drawn here may lead on.
    scripted = Scripted((-0.9,), (-0.9,), (0.0,), actions=(1.0, 1.0, 2.0))
    assert scripted.run(outcome(0.0, -10.0)).action == (2.0,)
    assert (scripted.solved, scripted.tangents) == (3, 2)


def test_one_entry_that_moves_is_enough_and_just_the_last_share_of_the_range_is_the_same() -> None:
    program = QuadraticProgram(np.zeros(1), np.ones(1), np.ones(1))
    assert _is_repeated(program, about(1e-8), about(0.0))
    program = QuadraticProgram(np.zeros(2), np.full(2, 9.0), np.ones(2))
    assert _is_repeated(program, about(1.0, 1.0), about(1.0, 1.0))
    assert not _is_repeated(program, about(1.0, 1.0), about(1.0, 2.0))
    assert not _is_repeated(program, about(2.0, 1.0), about(1.0, 1.0))


def test_rounds_are_limited_and_any_first_solution_replaces_the_start_but_the_least_broken_is_returned() -> None:
    scripted = Scripted((-5.0,), (-3.0,), (-4.0,), (-6.0,))
    assert scripted.run(outcome(0.0, -10.0)).action == (2.0,)
    assert scripted.solved == 4
    # The start is the caller's already: what is asked is what the program leads to.
    scripted = Scripted((-12.0,))
    assert scripted.run(outcome(0.0, -10.0), rounds=1).action == (1.0,)


def test_kept_beats_broken_and_near_beats_far() -> None:
    scripted: Any = Scripted()
    nominal = (0.0,)

    def better(one: ActionCandidate, other: ActionCandidate) -> ActionCandidate:
        return _pick_better(scripted, scripted, nominal, one, other)

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


def solver_reports(*solutions: Solution) -> tuple[ActionCandidate, str]:
    """What the search makes of these solutions of a program with as many actions, from a broken start."""
    count, left = len(solutions[0].action), list(solutions)
    program: Any = QuadraticProgram(np.zeros(count), np.ones(count), np.ones(count))

    class Given:
        sides = program.sides
        distance = program.distance

        def solve(self, *_: Any) -> Solution:
            return left.pop(0)

    conditions: Any = Scripted()
    conditions.evaluate = lambda taken: about(*taken)
    given: Any = Given()
    found, _, word = _iterate(conditions, given, [0.0] * count, outcome(0.0, -1.0), len(solutions))
    return found, word


@pytest.mark.parametrize("missed", [1e-6, 1e-3, 5.0])
def test_a_solution_beyond_the_bounds_is_taken_at_the_bounds(missed: float) -> None:
    """However far it missed them: what counts is what the model predicts for the action itself."""
    assert solver_reports(solution(-missed, 0.5))[0].action == (0.0, 0.5)
    assert solver_reports(solution(0.5, 1.0 + missed))[0].action == (0.5, 1.0)


@pytest.mark.parametrize("none", [np.nan, np.inf, -np.inf])
def test_one_entry_that_is_no_number_is_enough_to_believe_none(none: float) -> None:
    found, _ = solver_reports(solution(0.5, float(none)))
    assert found.action == (0.0,)  # the start


def test_a_solver_that_gives_up_leaves_what_was_found_before() -> None:
    found, word = solver_reports(GIVEN_UP)
    assert (found.action, found.is_feasible, word) == ((0.0,), False, "max iter reached")
    scripted: Any = Scripted((-5.0,))
    first = scripted.solve
    scripted.solve = lambda A, b, nominal: first(A, b, nominal) if scripted.solved == 0 else GIVEN_UP
    assert scripted.run(outcome(0.0, -10.0)).action == (1.0,)
    assert (scripted.solved, scripted.tangents) == (1, 2)


class Line:
    """h = a on 0 <= a <= 9, kept for a >= ``edge``; a program that proposes what it is given."""

    sides = ((0.0, 9.0, 9.0),)
    saturated = False

    def __init__(self, edge: float, *proposed: float) -> None:
        self.edge, self.proposed, self.asked = edge, list(proposed), 0
        self.tried: list[float] = []

    def evaluate(self, action: Any) -> ActionCandidate:
        self.tried.append(action[0])
        return outcome(action[0], action[0] - self.edge)

    def linearize(self, about: ActionCandidate) -> Gradients:
        return Gradients()

    def min_scaled_residual(self, found: ActionCandidate) -> float:
        return min(found.residual)

    def distance(self, action: tuple[float, ...], nominal: tuple[float, ...]) -> float:
        return abs(action[0] - nominal[0])

    def solve(self, A: Any, b: Any, nominal: Any) -> Solution:
        self.asked += 1
        return solution(self.proposed.pop(0) if len(self.proposed) > 1 else self.proposed[0])


def test_a_way_is_gone_as_far_as_a_straight_residual_allows_to_its_end_where_free_or_nowhere() -> None:
    """On 8 to 0 there is room for 5: 4.5 are gone, then 0.45 of the 0.5 left, and so on."""
    line: Any = Line(3.0, 8.0)
    found = line_search(line, line.evaluate((0.0,)), outcome(8.0, 5.0))
    assert line.tried == pytest.approx([0.0, 3.5, 3.05])
    assert found.action[0] == pytest.approx(3.05)
    line: Any = Line(0.0, 8.0)
    assert line_search(line, line.evaluate((0.0,)), outcome(8.0, 8.0)).action == (0.0,)
    assert line.tried == [0.0]
    line: Any = Line(8.0, 8.0)
    kept = outcome(8.0, 0.0)
    assert line_search(line, line.evaluate((0.0,)), kept) is kept
    assert line.tried == [0.0]


def test_a_residual_that_bends_is_followed_between_the_last_kept_and_the_last_broken() -> None:
    """h = sqrt(a) - 1: straight from 9 to 0 it falls below 0 at 3, in truth at 1; a^2 - 9: at 1 and 3."""
    for bent, edge in ((lambda a: a**0.5 - 1.0, 1.0), (lambda a: a * a - 9.0, 3.0)):
        line: Any = Line(0.0, 8.0)
        line.evaluate = lambda action, bent=bent, line=line: (
            line.tried.append(action[0]) or outcome(action[0], bent(action[0]))
        )
        found = line_search(line, line.evaluate((0.0,)), outcome(9.0, bent(9.0)))
        assert found.is_feasible
        assert edge <= found.action[0] < edge + 0.3
        assert len(line.tried) <= TRIES + 1


def test_the_first_residual_that_is_used_up_ends_the_way_and_one_that_grows_does_not() -> None:
    """Of three: one far away, one that is tight and grows, one that ends at 4."""
    line: Any = Line(0.0, 8.0)
    line.evaluate = lambda action: outcome(
        action[0], 90.0 + 10.1 * (action[0] - 9.0), 0.01 - (action[0] - 8.0), action[0] - 4.0
    )
    found = line_search(line, line.evaluate((0.0,)), outcome(8.0, 79.9, 0.01, 4.0))
    assert found.action[0] == pytest.approx(4.04, abs=0.001)


def test_what_binds_is_not_looked_at_again_and_a_residual_broken_by_rounding_ends_the_way() -> None:
    """What is kept may miss its condition by rounding errors: there is no room in it."""
    line: Any = Line(8.0, 8.0)
    kept = ActionCandidate((8.0,), [0.0], [0.0], [-1e-13], [])
    assert line_search(line, line.evaluate((0.0,)), kept) is kept
    line: Any = Line(0.0, DOUBTFUL)
    found, word = solve_sqp(line, line, (0.0,), outcome(0.0, -3.0), 4)
    assert (found.action, word) == ((DOUBTFUL,), "solved")
    assert line.asked == 1
    assert line.tried == [DOUBTFUL]


@pytest.mark.parametrize("saturated", [True, False])
def test_where_an_actuator_saturates_what_binds_and_is_far_is_looked_at_again(saturated: bool) -> None:
    """The slope there is a chord's: that the condition binds says nothing about the actions nearer to the nominal
    action."""
    line: Any = Line(3.0, 3.0)
    line.saturated = saturated
    line.evaluate = lambda action: outcome(action[0], 0.0 if action[0] >= 1.0 else -1.0)
    line.distance = lambda action, nominal: ((action[0] - nominal[0]) / 9.0) ** 2
    solve_sqp(line, line, (1.0,), outcome(0.0, -3.0), 4)
    assert line.asked == (1 + AGAIN if saturated else 1)


def test_what_is_needlessly_far_is_brought_nearer_and_of_both_programs_the_nearer_counts() -> None:
    """Four times led astray, then along the way, and from there the program says 2.91."""
    line: Any = Line(2.9, 8.0, 7.5, 8.0, 8.0, 2.91)
    found, word = solve_sqp(line, line, (0.0,), outcome(0.0, -3.0), 4)
    assert (found.action, word) == ((2.91,), "solved")
    assert line.asked == 5
    line: Any = Line(2.9, 8.0, 7.5, 8.0, 7.9)
    found, _ = solve_sqp(line, line, (0.0,), outcome(0.0, -3.0), 4)
    assert found.action[0] == pytest.approx(2.946)
    assert line.asked == 4 + AGAIN


def test_the_way_to_a_nominal_action_beyond_the_bounds_ends_at_the_bound() -> None:
    line: Any = Line(-5.0, 8.0)
    found, _ = solve_sqp(line, line, (-100.0,), outcome(0.0, -3.0), 4)
    assert found.action == (0.0,)


@pytest.mark.parametrize(("proposed", "again"), [(1.0, True), (0.89, False)])
def test_what_is_doubtful_and_far_from_the_nominal_action_is_brought_nearer(proposed: float, again: bool) -> None:
    """Kept by 0.03, between doubtful and needless: looked at again where it is more than a tenth of the range away."""
    line: Any = Line(0.0, proposed)
    line.distance = lambda action, nominal: ((action[0] - nominal[0]) / 9.0) ** 2
    line.evaluate = lambda action: outcome(
        action[0], 0.03 if action[0] == proposed else -1.0 if action[0] < 0.5 else 0.025
    )
    found, _ = solve_sqp(line, line, (0.0,), outcome(0.0, -3.0), 4)
    assert (line.asked == 1 + AGAIN) is again
    assert (found.action[0] < proposed) is again
    assert DOUBTFUL < 0.03 <= NEEDLESS


def test_the_entry_that_costs_most_is_gone_back_and_no_other() -> None:
    program: Any = QuadraticProgram(np.zeros(3), np.array([1.0, 10.0, 10.0]), np.array([1.0, 1.0, 0.5]))
    assert _undo_largest_change(program, (0.0, 0.0, 0.0), (0.2, 3.0, 4.0)) == [0.2, 0.0, 4.0]
    assert _undo_largest_change(program, (0.0, 0.0, 0.0), (0.2, 1.0, 4.0)) == [0.2, 1.0, 0.0]
    assert _undo_largest_change(program, (0.0, 0.0, 0.0), (0.5, 1.0, 4.0)) == [0.0, 1.0, 4.0]
    assert _undo_largest_change(program, (0.5, 0.0, 0.0), (0.5, 0.0, 0.0)) == [0.5, 0.0, 0.0]


def test_what_leads_from_a_kept_action_to_a_broken_one_ends_the_rounds_and_is_not_brought_nearer() -> None:
    line: Any = Line(2.9, 8.0, 1.0, 7.0)
    found, _ = solve_sqp(line, line, (0.0,), outcome(0.0, -3.0), 4)
    assert line.asked == 2 + AGAIN
    assert found.is_feasible
    line: Any = Line(9.5, 8.0, 7.0, 8.0, 7.0)
    found, _ = solve_sqp(line, line, (0.0,), outcome(0.0, -3.0), 4)
    assert not found.is_feasible
    assert found.action == (8.0,)
    assert line.asked == 4


def test_a_long_last_step_from_a_broken_action_is_gone_back() -> None:
    """From 3 to 8 at once, though all from 3.5 on is kept."""
    line: Any = Line(3.5, 3.0, 8.0)
    line.distance = lambda action, nominal: ((action[0] - nominal[0]) / 9.0) ** 2
    line.evaluate = lambda action: (
        line.tried.append(action[0]) or outcome(action[0], 0.01 if action[0] > 3.5 else -0.01)
    )
    found, _ = solve_sqp(line, line, (0.0,), outcome(0.0, -3.0), 4)
    assert line.tried[2] == pytest.approx(8.0 - 0.9 * 2.5)
    assert 3.5 < found.action[0] < 4.5
    assert found.is_feasible


@pytest.mark.parametrize("last", [3.4, 4.4])
def test_a_short_last_step_is_left(last: float) -> None:
    """A tenth of the range, which is 9."""
    line: Any = Line(3.3, 3.0 if last == 3.4 else 4.0, last)
    line.distance = lambda action, nominal: ((action[0] - nominal[0]) / 9.0) ** 2
    line.evaluate = lambda action: (
        line.tried.append(action[0]) or outcome(action[0], 0.01 if action[0] == last else -1.0)
    )
    found, _ = solve_sqp(line, line, (0.0,), outcome(0.0, -3.0), 4)
    assert found.action == (last,)
    assert len(line.tried) == 2


def test_the_first_step_is_left_however_long_and_without_finite_predictions_the_way_is_halved() -> None:
    """The start is where the nominal action was: the program has the way from there."""
    line: Any = Line(3.5, 8.0)
    line.distance = lambda action, nominal: ((action[0] - nominal[0]) / 9.0) ** 2
    line.evaluate = lambda action: line.tried.append(action[0]) or outcome(action[0], 0.01)
    found, _ = solve_sqp(line, line, (0.0,), outcome(0.0, -3.0), 4)
    assert (found.action, line.tried) == ((8.0,), [8.0])
    line: Any = Line(3.0, 8.0)
    blind = ActionCandidate((0.0,), [0.0], [-np.inf], [-np.inf], [0])
    assert 3.0 <= line_search(line, blind, outcome(8.0, 5.0)).action[0] <= 3.1
    assert line.tried[0] == pytest.approx(8.0 - 8.0 * 0.45)
