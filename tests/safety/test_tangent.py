"""The conditions linearised about one outcome, and the way back from it towards the nominal action."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from tests.safety.scripted import outcome

from safedpa.dynamics import load_model
from safedpa.equations.chain_rule import chain_rule
from safedpa.errors import InputError
from safedpa.robots.car.barriers.obstacles import car_barriers
from safedpa.safety import SafetyFilter, Status
from safedpa.safety.defaults import settings_named
from safedpa.safety.solver.constraints import ActionCandidate
from safedpa.safety.solver.linearization import MARK, Linearization
from safedpa.safety.solver.sqp import STEP, backtrack_towards
from safedpa_lab.experiments.adversary.car_grid import FIELD, FOOTPRINT, CarGrid, CarJudge, car_question

WIDTHS = [2.0, 0.5]
G = [[1.0, 0.0], [0.0, -4.0]]


class Gradients:
    """Of h: one row of (states,) each."""

    def __init__(self, *rows: list[float], grad_bound: list[float] | None = None) -> None:
        self.rows, self._grad_bound = rows, grad_bound
        self.asked: list[list[int]] = []

    def grad_bound(self, state: Sequence[float]) -> list[float] | None:
        return self._grad_bound

    def lie_derivative_floats(
        self, state: Sequence[float], g: list[list[float]], widths: list[float], rows: Sequence[int]
    ) -> list[list[float]]:
        self.asked.append(list(rows))
        assert widths == WIDTHS
        return chain_rule([self.rows[row] for row in rows], g)


def drawn(barriers: Gradients, known: float = 0.0) -> tuple[Linearization, list[float]]:
    scales = [known] * len(barriers.rows)
    return Linearization(barriers, G, [7.0, 8.0], WIDTHS, scales), scales


def test_a_row_keeps_its_condition_where_the_tangent_says_so_and_is_asked_for_once() -> None:
    """A a >= b just where residual + p'g (a - about) >= the mark."""
    tangent, _ = drawn(Gradients([3.0, 1.0], [0.0, 0.5]))
    A, b = tangent.at([0.3, -0.2], [0.5, 0.1], 0.0)
    assert A == [[3.0, -4.0], [0.0, -2.0]]
    reach = [3.0 * 2.0 + 4.0 * 0.5, 2.0 * 0.5]
    np.testing.assert_allclose(b, [1.5 - 0.4 - 0.3 + MARK * reach[0], -0.2 + 0.2 + MARK * reach[1]], atol=1e-15)
    barriers = Gradients([3.0, 1.0], [0.0, 0.5])
    tangent, _ = drawn(barriers)
    tangent.at([0.0, 0.0], [0.0, 0.0], 0.0)
    tangent.at([0.0, 1.0], [0.0, 0.0], 0.0)
    assert tangent.all(2) == [[3.0, -4.0], [0.0, -2.0]]
    assert barriers.asked == [[0, 1]]


@pytest.mark.parametrize("overshoot", [0.25, 0.5, 2.0])
def test_of_what_is_missing_a_share_is_asked_for_on_top(overshoot: float) -> None:
    """Of what is kept by some distance nothing is."""
    tangent, _ = drawn(Gradients([3.0, 1.0], [0.0, 0.5], [0.0, 0.5]))
    residual = [0.3, -0.2, 0.0]
    plain, more = (np.array(tangent.at(residual, [0.5, 0.1], share)[1]) for share in (0.0, overshoot))
    np.testing.assert_allclose(more - plain, [0.0, 0.2 * overshoot, 0.0], atol=1e-15)


def test_what_actions_change_is_learned_and_never_less_than_known() -> None:
    barriers = Gradients([3.0, 1.0], [0.0, 0.5])
    tangent, scales = drawn(barriers)
    tangent.at([0.0, 0.0], [0.0, 0.0], 0.0)
    assert scales == [8.0, 1.0]
    tangent, scales = drawn(barriers, known=4.0)
    tangent.at([0.0, 0.0], [0.0, 0.0], 0.0)
    assert scales == [8.0, 4.0]


def test_rows_that_no_action_breaks_are_not_even_asked_for() -> None:
    """No slope is steeper than (3, 1): 3 * 2 + 4 * 0.5 = 8, and a little for rounding."""
    barriers = Gradients([3.0, 1.0], [0.0, 0.5], [3.0, 0.0], grad_bound=[3.0, 1.0])
    tangent, _ = drawn(barriers)
    A, b = tangent.at([8.0, 8.0 + 1e-6, 7.0], [0.0, 0.0], 0.0)
    assert A == [[3.0, -4.0], [3.0, 0.0]]
    np.testing.assert_allclose(b, [-8.0, -7.0], atol=1e-8)
    assert barriers.asked == [[0, 2]]
    tangent.at([8.0, 0.0, 7.0], [0.0, 0.0], 0.0)
    assert barriers.asked == [[0, 2], [1]]
    assert len(tangent.all(3)) == 3
    assert barriers.asked == [[0, 2], [1]]


@pytest.mark.parametrize(
    ("residual", "near"), [(8.0, True), (8.0 * (1.0 + 0.9e-9), True), (8.0 * (1.0 + 1.1e-9), False)]
)
def test_rounding_leaves_no_row_out(residual: float, near: bool) -> None:
    tangent, _ = drawn(Gradients([3.0, 1.0], grad_bound=[3.0, 1.0]))
    assert bool(tangent.at([residual], [0.0, 0.0], 0.0)[0]) is near


def test_all_asks_for_what_is_missing_only() -> None:
    barriers = Gradients([3.0, 1.0], [0.0, 0.5], [1.0, 0.0], grad_bound=[3.0, 1.0])
    tangent, _ = drawn(barriers)
    tangent.at([9.0, 0.0, 9.0], [0.0, 0.0], 0.0)
    assert tangent.all(3) == [[3.0, -4.0], [0.0, -2.0], [1.0, 0.0]]
    assert barriers.asked == [[1], [0, 2]]
    assert tangent.all(2) == [[3.0, -4.0], [0.0, -2.0]]


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_slopes_that_are_no_numbers_are_refused(number: float) -> None:
    for rows in ([number, 0.0], [0.0, number]):
        with np.errstate(invalid="ignore"), pytest.raises(InputError, match="gradient of h: got NaN or infinity"):
            drawn(Gradients([1.0, 0.0], rows))[0].at([0.0, 0.0], [0.0, 0.0], 0.0)


def test_the_largest_float_is_a_slope() -> None:
    """The sum of two is infinite, they are not."""
    tangent, scales = drawn(Gradients([1.7e308, 0.0]))
    assert tangent.all(1) == [[1.7e308, 0.0]]
    assert scales == [np.inf]


def test_a_gradient_bound_of_other_states_is_refused() -> None:
    with pytest.raises(ValueError, match="the model has slopes of 2 states, the barriers of 3"):
        drawn(Gradients([1.0, 0.0], grad_bound=[1.0, 1.0, 1.0]))


SIDES = ((0.0, 10.0, 10.0), (-1.0, 1.0, 2.0))


class Plane:
    """Kept where ``room`` of the action is not below 0."""

    def __init__(self, room: Callable[[Any], float]) -> None:
        self.room = room
        self.tried: list[tuple[float, ...]] = []

    def evaluate(self, action: Any) -> ActionCandidate:
        self.tried.append(tuple(action))
        found = outcome(action[0], self.room(action))
        found.action = tuple(action)
        return found


def start(plane: Plane, *action: float) -> ActionCandidate:
    found = plane.evaluate(action)
    plane.tried.clear()
    return found


def test_an_entry_on_a_plateau_comes_back_to_its_edge() -> None:
    """Kept from 3 on, however far beyond: from 9 back towards 0, to a thirty-second of the way."""
    plane = Plane(lambda a: min(a[0] - 3.0, 1.0))
    found = backtrack_towards(plane, SIDES, (0.0, 0.0), start(plane, 9.0, 0.0))
    assert found.is_feasible
    assert 3.0 <= found.action[0] <= 3.0 + 8.0 / 32.0
    assert found.action[1] == 0.0
    assert len(plane.tried) == 6


def test_what_no_step_brings_nearer_costs_one_look_an_entry_and_stays_itself() -> None:
    plane = Plane(lambda a: a[0] + a[1] - 9.0)
    kept = start(plane, 8.5, 0.5)
    assert backtrack_towards(plane, SIDES, (0.0, -1.0), kept) is kept
    assert plane.tried == [pytest.approx((7.5, 0.5)), pytest.approx((8.5, 0.3))], "the furthest entry first"


def test_a_nominal_action_is_approached_no_further_than_the_bounds_allow_and_within_a_step_left_alone() -> None:
    plane = Plane(lambda a: 1.0)
    kept = start(plane, 10.0 * STEP, 2.0 * STEP - 1.0)
    assert backtrack_towards(plane, SIDES, (0.0, -1.0), kept) is kept
    below = start(plane, 10.0 - 10.0 * STEP, -1.0)
    assert backtrack_towards(plane, SIDES, (10.0, -1.0), below) is below
    assert plane.tried == []
    plane = Plane(lambda a: 1.0)
    found = backtrack_towards(plane, SIDES, (-50.0, 7.0), start(plane, 9.0, -1.0))
    assert all(low <= value <= high for value, (low, high, _) in zip(found.action, SIDES, strict=True))
    assert found.action == pytest.approx((0.0, 1.0), abs=0.3)
    assert min(action[0] for action in plane.tried) >= 0.0


def test_every_entry_has_its_turn_from_where_the_others_came_to() -> None:
    plane = Plane(lambda a: min(a[0] - 2.0, a[1] + 0.5, 1.0))
    found = backtrack_towards(plane, SIDES, (0.0, -1.0), start(plane, 9.0, 1.0))
    assert found.is_feasible
    assert found.action[0] == pytest.approx(2.0, abs=0.3)
    assert found.action[1] == pytest.approx(-0.5, abs=0.08)


@pytest.mark.parametrize("number", [9827, 7743, 5964, 4898, 2205, 4108])
def test_a_car_is_not_sent_along_the_plateau_of_its_drive(number: int) -> None:
    """Found by the grid: the speed asked for lay beyond what the drive can reach in a tick, far past what is needed."""
    model, settings, question = load_model("car"), settings_named("car"), car_question(2010, number)
    verdict = SafetyFilter.for_model(model, settings).decide(
        question.state,
        question.nominal,
        model.latent,
        barriers=car_barriers(settings, FOOTPRINT, question.obstacles, FIELD),
    )
    judge = CarJudge(model, settings, question)
    kept = ((judge.h - judge.required) / judge.scale >= 1e-9).all(axis=1)
    assert verdict.status is Status.corrected
    assert judge.distance(verdict.action[None])[0] <= judge.distance(judge.grid[kept]).min() + 0.06


@pytest.mark.parametrize("number", [1424, 3861, 8186, 10808])
def test_the_least_unsafe_action_is_looked_for_across_the_plateau(number: int) -> None:
    _, (found,) = CarGrid().work(("car", 2010, number, number + 1))
    assert found.status in ("relaxed", "violated")
    assert found.shortfall is not None
    assert found.shortfall < 0.008


def test_a_standing_car_finds_the_action_that_keeps_all_though_h_bends_there() -> None:
    """Found by the grid: eight actions of it keep all, in a narrow strip of reversing with the wheels turned."""
    _, (found,) = CarGrid().work(("odd scenes", 2050, 724, 725))
    assert found.status == "corrected"
    assert not found.missed


@pytest.mark.parametrize("number", [9514])
def test_the_least_violation_action_is_searched_on_both_sides_of_zero_speed(number: int) -> None:
    _, (found,) = CarGrid().work(("car", 2050, number, number + 1))
    assert found.status == "relaxed"
    assert found.shortfall is not None
    assert found.shortfall < 0.01
