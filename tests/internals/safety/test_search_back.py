"""The search's ways back towards the wish, on a line."""

from typing import Any

import numpy as np
import pytest
from tests.safety.scripted import Slopes, outcome, solution

from safedpa.safety import QuadraticProgram, Solution
from safedpa.safety.conditions import Outcome
from safedpa.safety.search import (
    AGAIN,
    DOUBTFUL,
    NEEDLESS,
    TRIES,
    _furthest_back,
    search,
    towards,
)


class Line:
    """h = a on 0 <= a <= 9, kept for a >= ``edge``; a program that proposes what it is told."""

    sides = ((0.0, 9.0, 9.0),)
    saturated = False

    def __init__(self, edge: float, *proposed: float) -> None:
        self.edge, self.proposed, self.asked = edge, list(proposed), 0
        self.tried: list[float] = []

    def outcome(self, action: Any) -> Outcome:
        self.tried.append(action[0])
        return outcome(action[0], action[0] - self.edge)

    def linearised(self, about: Outcome) -> Slopes:
        return Slopes()

    def tightest(self, found: Outcome) -> float:
        return min(found.residual)

    def distance(self, action: tuple[float, ...], wish: tuple[float, ...]) -> float:
        return abs(action[0] - wish[0])

    def solve(self, A: Any, b: Any, wish: Any) -> Solution:
        self.asked += 1
        return solution(self.proposed.pop(0) if len(self.proposed) > 1 else self.proposed[0])


def test_the_way_is_gone_as_far_as_a_straight_residual_allows_but_for_a_tenth() -> None:
    """On 8 to 0 there is room for 5: 4.5 are gone, then 0.45 of the 0.5 left, and so on."""
    line: Any = Line(3.0, 8.0)
    found = towards(line, line.outcome((0.0,)), outcome(8.0, 5.0))
    assert line.tried == pytest.approx([0.0, 3.5, 3.05])
    assert found.action[0] == pytest.approx(3.05)


def test_a_way_that_is_free_is_gone_to_its_end() -> None:
    line: Any = Line(0.0, 8.0)
    assert towards(line, line.outcome((0.0,)), outcome(8.0, 8.0)).action == (0.0,)
    assert line.tried == [0.0]


def test_a_way_that_no_action_allows_leads_nowhere() -> None:
    line: Any = Line(8.0, 8.0)
    kept = outcome(8.0, 0.0)
    assert towards(line, line.outcome((0.0,)), kept) is kept
    assert line.tried == [0.0]


def test_a_residual_that_bends_is_followed_between_the_last_kept_and_the_last_broken() -> None:
    """h = sqrt(a) - 1: straight from 9 to 0 it falls below 0 at 3, in truth at 1; a^2 - 9: at 1 and 3."""
    for bent, edge in ((lambda a: a**0.5 - 1.0, 1.0), (lambda a: a * a - 9.0, 3.0)):
        line: Any = Line(0.0, 8.0)
        line.outcome = lambda action, bent=bent, line=line: (
            line.tried.append(action[0]) or outcome(action[0], bent(action[0]))
        )
        found = towards(line, line.outcome((0.0,)), outcome(9.0, bent(9.0)))
        assert found.kept
        assert edge <= found.action[0] < edge + 0.3
        assert len(line.tried) <= TRIES + 1


def test_the_first_residual_that_is_used_up_ends_the_way_and_one_that_grows_does_not() -> None:
    """Of three: one far away, one that is tight and grows, one that ends at 4."""
    line: Any = Line(0.0, 8.0)
    line.outcome = lambda action: outcome(
        action[0], 90.0 + 10.1 * (action[0] - 9.0), 0.01 - (action[0] - 8.0), action[0] - 4.0
    )
    found = towards(line, line.outcome((0.0,)), outcome(8.0, 79.9, 0.01, 4.0))
    assert found.action[0] == pytest.approx(4.04, abs=0.001)


def test_a_residual_that_is_broken_by_rounding_ends_the_way() -> None:
    """What is kept may miss its condition by rounding errors: there is no room in it."""
    line: Any = Line(8.0, 8.0)
    kept = Outcome((8.0,), [0.0], [0.0], [-1e-13], [])
    assert towards(line, line.outcome((0.0,)), kept) is kept


def test_what_binds_is_not_looked_at_again() -> None:
    line: Any = Line(0.0, DOUBTFUL)
    found, word = search(line, line, (0.0,), outcome(0.0, -3.0), 4)
    assert (found.action, word) == ((DOUBTFUL,), "solved")
    assert line.asked == 1
    assert line.tried == [DOUBTFUL]


@pytest.mark.parametrize("saturated", [True, False])
def test_where_an_actuator_saturates_what_binds_and_is_far_is_looked_at_again(saturated: bool) -> None:
    """The slope there is a chord's: that the condition binds says nothing about the actions nearer to the wish."""
    line: Any = Line(3.0, 3.0)
    line.saturated = saturated
    line.outcome = lambda action: outcome(action[0], 0.0 if action[0] >= 1.0 else -1.0)
    line.distance = lambda action, wish: ((action[0] - wish[0]) / 9.0) ** 2
    search(line, line, (1.0,), outcome(0.0, -3.0), 4)
    assert line.asked == (1 + AGAIN if saturated else 1)


def test_what_is_kept_needlessly_far_is_brought_nearer_and_the_program_posed_again() -> None:
    """Four times led astray, then along the way, and from there the program says 2.91."""
    line: Any = Line(2.9, 8.0, 7.5, 8.0, 8.0, 2.91)
    found, word = search(line, line, (0.0,), outcome(0.0, -3.0), 4)
    assert (found.action, word) == ((2.91,), "solved")
    assert line.asked == 5


def test_of_what_was_nearer_and_what_the_program_says_then_the_nearer_counts() -> None:
    line: Any = Line(2.9, 8.0, 7.5, 8.0, 7.9)
    found, _ = search(line, line, (0.0,), outcome(0.0, -3.0), 4)
    assert found.action[0] == pytest.approx(2.946)
    assert line.asked == 4 + AGAIN


def test_the_way_to_a_wish_beyond_the_bounds_ends_at_the_bound() -> None:
    line: Any = Line(-5.0, 8.0)
    found, _ = search(line, line, (-100.0,), outcome(0.0, -3.0), 4)
    assert found.action == (0.0,)


@pytest.mark.parametrize(("proposed", "again"), [(1.0, True), (0.89, False)])
def test_what_is_doubtful_and_far_from_the_wish_is_brought_nearer(proposed: float, again: bool) -> None:
    """Kept by 0.03, between doubtful and needless: looked at again where it is more than a tenth of the range away."""
    line: Any = Line(0.0, proposed)
    line.distance = lambda action, wish: ((action[0] - wish[0]) / 9.0) ** 2
    line.outcome = lambda action: outcome(
        action[0], 0.03 if action[0] == proposed else -1.0 if action[0] < 0.5 else 0.025
    )
    found, _ = search(line, line, (0.0,), outcome(0.0, -3.0), 4)
    assert (line.asked == 1 + AGAIN) is again
    assert (found.action[0] < proposed) is again
    assert DOUBTFUL < 0.03 <= NEEDLESS


def test_the_entry_that_costs_most_is_gone_back_and_no_other() -> None:
    program: Any = QuadraticProgram(np.zeros(3), np.array([1.0, 10.0, 10.0]), np.array([1.0, 1.0, 0.5]))
    assert _furthest_back(program, (0.0, 0.0, 0.0), (0.2, 3.0, 4.0)) == [0.2, 0.0, 4.0]
    assert _furthest_back(program, (0.0, 0.0, 0.0), (0.2, 1.0, 4.0)) == [0.2, 1.0, 0.0]
    assert _furthest_back(program, (0.0, 0.0, 0.0), (0.5, 1.0, 4.0)) == [0.0, 1.0, 4.0]
    assert _furthest_back(program, (0.5, 0.0, 0.0), (0.5, 0.0, 0.0)) == [0.5, 0.0, 0.0]


def test_slopes_that_lead_from_a_kept_action_to_a_broken_one_end_the_rounds() -> None:
    line: Any = Line(2.9, 8.0, 1.0, 7.0)
    found, _ = search(line, line, (0.0,), outcome(0.0, -3.0), 4)
    assert line.asked == 2 + AGAIN
    assert found.kept


def test_what_is_broken_is_not_brought_nearer() -> None:
    line: Any = Line(9.5, 8.0, 7.0, 8.0, 7.0)
    found, _ = search(line, line, (0.0,), outcome(0.0, -3.0), 4)
    assert not found.kept
    assert found.action == (8.0,)
    assert line.asked == 4


def test_a_long_last_step_from_a_broken_action_is_gone_back() -> None:
    """From 3 to 8 at once, though all from 3.5 on is kept."""
    line: Any = Line(3.5, 3.0, 8.0)
    line.distance = lambda action, wish: ((action[0] - wish[0]) / 9.0) ** 2
    line.outcome = lambda action: line.tried.append(action[0]) or outcome(action[0], 0.01 if action[0] > 3.5 else -0.01)
    found, _ = search(line, line, (0.0,), outcome(0.0, -3.0), 4)
    assert line.tried[2] == pytest.approx(8.0 - 0.9 * 2.5)
    assert 3.5 < found.action[0] < 4.5
    assert found.kept


@pytest.mark.parametrize("last", [3.4, 4.4])
def test_a_short_last_step_is_left(last: float) -> None:
    """A tenth of the range, which is 9."""
    line: Any = Line(3.3, 3.0 if last == 3.4 else 4.0, last)
    line.distance = lambda action, wish: ((action[0] - wish[0]) / 9.0) ** 2
    line.outcome = lambda action: (
        line.tried.append(action[0]) or outcome(action[0], 0.01 if action[0] == last else -1.0)
    )
    found, _ = search(line, line, (0.0,), outcome(0.0, -3.0), 4)
    assert found.action == (last,)
    assert len(line.tried) == 2


def test_the_first_step_is_left_however_long_it_is() -> None:
    """The start is where the wish was: the program has the way from there."""
    line: Any = Line(3.5, 8.0)
    line.distance = lambda action, wish: ((action[0] - wish[0]) / 9.0) ** 2
    line.outcome = lambda action: line.tried.append(action[0]) or outcome(action[0], 0.01)
    found, _ = search(line, line, (0.0,), outcome(0.0, -3.0), 4)
    assert (found.action, line.tried) == ((8.0,), [8.0])


def test_from_an_action_without_a_finite_prediction_the_way_is_halved() -> None:
    line: Any = Line(3.0, 8.0)
    blind = Outcome((0.0,), [0.0], [-np.inf], [-np.inf], [0])
    assert 3.0 <= towards(line, blind, outcome(8.0, 5.0)).action[0] <= 3.1
    assert line.tried[0] == pytest.approx(8.0 - 8.0 * 0.45)
