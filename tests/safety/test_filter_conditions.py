"""Conditions at one state: saturated actuators, chords, shapes, numbers by whichever road."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from safedpa.errors import InputError
from safedpa.robots.car.barriers.obstacles import car_barriers
from safedpa.safety import Barriers, FilterSettings, FunctionBarrier, Prediction
from safedpa.safety.barriers.stack import make_barrier_set
from safedpa.safety.solver.constraints import ROUNDING, ActionCandidate, Constraints
from safedpa.safety.solver.linearization import Linearization
from safedpa.safety.validation import InvalidInput, Plausible, checked_input


def conditions(step: Callable[[np.ndarray, np.ndarray], object], g: object, low: float = 0.0, high: float = 2.0):
    """h = x_0; the model's step and its tangent g (2, 1) are given apart, so that they may disagree."""
    return Constraints(
        Barriers([FunctionBarrier(lambda x: x[0], lambda x: [1.0, 0.0])]),
        Prediction(lambda x: (x, np.array(g)), step),
        (1.0, 0.5),
        None,
        None,
        0.2,
        [0.1],
        [(low, high, high - low)],
    )


def slope_at(posed: Constraints, action: float) -> float:
    about = posed.evaluate((action,))
    return posed.linearize(about).at(about.residual, about.action, 0.0)[0][0][0]


def test_required_is_what_eta_and_epsilon_leave() -> None:
    posed = conditions(lambda x, a: x + a, [[1.0], [0.0]])
    np.testing.assert_allclose(posed.rhs, [0.8 * 1.0 + 0.1])
    outcome = posed.evaluate((0.5,))
    np.testing.assert_allclose(outcome.residual, [1.5 - 0.9])
    assert outcome.violation == 0.0
    assert outcome.min_h_next == 1.5
    assert posed.min_h_now == 1.0
    A, b = posed.linearize(outcome).at(outcome.residual, outcome.action, 0.0)
    np.testing.assert_allclose(A, [[1.0]])
    np.testing.assert_allclose(b, [0.5 - 0.6], atol=1e-8)


@pytest.mark.parametrize(("slope", "silent"), [(1.49e-9, True), (1.51e-9, False), (0.0, True), (-1.51e-9, False)])
def test_only_rounding_errors_count_as_saturation(slope: float, silent: bool) -> None:
    """Next state (3, 0.5): over a range of 2 a slope of 1.5e-9 moves 1e-9 of the 3; the chord takes its place."""
    posed = conditions(lambda x, a: np.array([2.5 + a[0], 0.5]), [[slope], [0.0]])
    assert slope_at(posed, 0.5) == pytest.approx(1.0 if silent else slope)


@pytest.mark.parametrize(("slope", "silent"), [(0.99e-9, True), (1.01e-9, False)])
def test_the_motion_counts_where_it_is_larger_than_the_entry(slope: float, silent: bool) -> None:
    """From 1.0 to -1.0: rounding errors are those of a motion by 2."""
    posed = conditions(lambda x, a: np.array([-1.5 + a[0], 0.5]), [[slope], [0.0]])
    assert slope_at(posed, 0.5) == pytest.approx(1.0 if silent else slope)


def test_one_entry_that_an_action_moves_is_enough() -> None:
    """It stays a slope of 0 for h = x_0: nothing is saturated, the action moves the second entry only."""
    posed = conditions(lambda x, a: np.array([2.5 + a[0], 0.5]), [[0.0], [1.0]])
    assert slope_at(posed, 0.5) == 0.0


@pytest.mark.parametrize(
    ("value", "low", "high", "end"),
    [(1.5, 1.0, 3.0, 3.0), (2.5, 1.0, 3.0, 1.0), (2.0, 1.0, 3.0, 3.0), (-1.0, -2.0, 5.0, 5.0), (4.0, -2.0, 5.0, -2.0)],
)
def test_chord_leads_to_the_bound_further_away(value: float, low: float, high: float, end: float) -> None:
    posed = conditions(lambda x, a: np.array([a[0] ** 2, 0.5]), [[0.0], [0.0]], low, high)
    assert slope_at(posed, value) == pytest.approx((end**2 - value**2) / (end - value))


def test_earlier_slopes_beat_the_chord() -> None:
    slopes = iter(([[7.0], [0.0]], [[0.0], [0.0]], [[2.0], [0.0]]))
    posed = conditions(lambda x, a: np.array([a[0] ** 2, 0.5]), [[0.0], [0.0]])
    posed._prediction = Prediction(lambda x: (x, np.array(next(slopes))), lambda x, a: np.array([a[0] ** 2, 0.5]))
    assert [slope_at(posed, 1.0) for _ in range(3)] == [7.0, 7.0, 2.0]


def test_one_number_that_is_none_is_enough() -> None:
    for step in (lambda x, a: np.array([1.0, np.nan]), lambda x, a: np.array([np.inf, 0.0])):
        outcome = conditions(step, [[1.0], [0.0]]).evaluate((0.0,))
        assert (outcome.is_finite, outcome.is_feasible, outcome.violated_rows, outcome.min_h_next) == (
            False,
            False,
            [0],
            -np.inf,
        )
    assert conditions(lambda x, a: x + a, [[1.0], [0.0]]).evaluate((0.0,)).is_finite
    posed = conditions(lambda x, a: x + a, [[1.0], [np.inf]])
    with pytest.raises(InputError, match="g of the model: got NaN or infinity"):
        posed.linearize(posed.evaluate((0.0,)))


@pytest.mark.parametrize("seed", range(4))
def test_rows_that_are_left_out_no_action_can_break(seed: int) -> None:
    """Next to the same barriers one by one, which leave no row out."""
    random, settings = np.random.default_rng(seed), FilterSettings.for_robot("car")
    sides = list(
        zip(settings.low.tolist(), settings.high.tolist(), (settings.high - settings.low).tolist(), strict=True)
    )
    left_out = 0
    for _ in range(50):
        obstacles = np.column_stack([random.uniform(-4.0, 4.0, (8, 2)), random.uniform(0.2, 0.4, 8)])
        parts = car_barriers(settings, (0.08, 0.4, 0.12), obstacles, (-5.0, 5.0, -5.0, 5.0))
        state, g = tuple(random.uniform(-2.0, 2.0, 4).tolist()), random.normal(0.0, 0.1, (4, 2)).tolist()
        posed = [
            Constraints(stack, Prediction(lambda x: (x, np.zeros((4, 2)))), state, None, None, 0.2, [0.0] * 18, sides)
            for stack in (make_barrier_set(parts), Barriers(parts))
        ]
        widths, about = [width for _, _, width in sides], posed[0].evaluate(settings.resting_action.tolist())
        found, every = (
            Linearization(one.barriers, g, about.next_state, widths, [0.0] * 18).at(about.residual, about.action, 0.0)
            for one in posed
        )
        assert len(every[0]) == 18
        for slopes, limit in zip(*every, strict=True):
            least = sum(min(slope * low, slope * high) for slope, (low, high, _) in zip(slopes, sides, strict=True))
            near = [np.allclose([*slopes, limit], [*own, b], atol=1e-12) for own, b in zip(*found, strict=True)]
            assert any(near) or least >= limit
        left_out += 18 - len(found[0])
    assert left_out > 100


def several(h: Callable[[np.ndarray], list[float]], epsilon: list[float], eta: float = 0.5) -> Constraints:
    """x[t+1] = x + a from x = 0, -4 <= a <= 4; as many barriers as margins."""
    names = tuple(f"h{index}" for index in range(len(epsilon)))
    return Constraints(
        Barriers([FunctionBarrier(h, names=names)]),
        Prediction(lambda x: (x, np.eye(1)), lambda x, a: x + a),
        (0.0,),
        None,
        None,
        eta,
        epsilon,
        [(-4.0, 4.0, 8.0)],
    )


def test_a_barriers_scale_is_what_it_is_its_margin_or_what_actions_change_in_it() -> None:
    posed = several(lambda x: [10.0 - x[0], -3.0 + 0.1 * x[0], 0.0, 1e-6], [0.1, 0.0, 0.25, 0.0])
    assert posed.base_scales == [10.0, 3.0, 0.25, 1e-6]
    assert posed.scales == [10.0, 3.0, 0.25, 1e-6]
    steep = several(lambda x: [1.0 - x[0], 2.0 + 3.0 * x[0]], [0.0, 0.0])
    steep.linearize(steep.evaluate((0.0,))).all(2)
    np.testing.assert_allclose(steep.scales, [8.0, 24.0])
    assert steep.base_scales == [1.0, 2.0]


def test_a_reach_once_known_is_not_forgotten_and_rounding_is_far_below_what_matters() -> None:
    """h = 1 - x^2 / 2: steep where x is large, flat where it is 0."""
    posed = several(lambda x: [1.0 - x[0] ** 2 / 2.0], [0.0])
    posed.linearize(posed.evaluate((3.0,))).all(1)
    assert posed.scales[0] == pytest.approx(24.0)
    posed.linearize(posed.evaluate((0.5,))).all(1)
    assert posed.scales[0] == pytest.approx(24.0)
    assert 1e-12 <= ROUNDING <= 1e-10


@pytest.mark.parametrize("unit", [1e-12, 1.0, 1e12])
@pytest.mark.parametrize(
    ("missed", "kept"), [(0.9 * ROUNDING, True), (1.1 * ROUNDING, False), (0.0, True), (-1.0, True)]
)
def test_a_condition_may_be_missed_by_rounding_errors_of_its_own_scale(missed: float, kept: bool, unit: float) -> None:
    """h now is 8, half of it may be used up: 4, but for the rounding of 8."""
    posed = several(lambda x: [unit * (8.0 - x[0])], [0.0])
    outcome = posed.evaluate((4.0 + 8.0 * missed,))
    assert outcome.is_feasible is kept
    assert outcome.violated_rows == ([] if kept else [0])


def test_no_kept_action_leads_below_zero_and_a_violation_is_the_largest_slack_of_what_is_broken() -> None:
    """With h = 0 now the condition h >= 0 may not be missed at all, though h's scale would allow for rounding."""
    posed = several(lambda x: [-1e-14 * x[0], 1.0], [0.0, 0.0])
    posed.scales[:] = [1.0, 1.0]
    below, on = posed.evaluate((1.0,)), posed.evaluate((0.0,))
    assert (below.violated_rows, below.is_feasible) == ([], False)
    assert (on.violated_rows, on.is_feasible) == ([], True)
    assert below.violation == 0.0
    posed = several(lambda x: [5.0 - x[0], 2.0 - x[0], 100.0], [0.0, 0.0, 0.0])
    outcome = posed.evaluate((3.0,))
    assert outcome.violated_rows == [0, 1]
    assert outcome.violation == 2.0
    assert outcome.min_h_next == -1.0
    assert several(lambda x: [5.0 - x[0]], [0.0]).evaluate((3.0,)).violation == 0.5


def test_tightest_is_a_share_of_each_barriers_scale() -> None:
    posed = several(lambda x: [100.0 - x[0], 2.0 - x[0]], [0.0, 0.0])
    outcome = posed.evaluate((2.0,))
    assert posed.min_scaled_residual(outcome) == -1.0 / 2.0
    assert posed.min_scaled_residual(posed.evaluate((-2.0,))) == pytest.approx(0.52)
    posed.scales[1] = 20.0
    assert posed.min_scaled_residual(outcome) == -1.0 / 20.0


@pytest.mark.parametrize("turned", [False, True])
def test_tightest_does_not_depend_on_the_order(turned: bool) -> None:
    def h(x: np.ndarray) -> list[float]:
        three = [1000.0 - x[0], 2.0 - x[0], 4.0 - x[0]]
        return three[::-1] if turned else three

    posed = several(h, [0.0] * 3)
    assert posed.min_scaled_residual(posed.evaluate((1.5,))) == pytest.approx(-0.25)
    assert posed.min_scaled_residual(posed.evaluate((0.0,))) == pytest.approx(0.5)


def test_of_a_barrier_without_a_scale_what_is_missing_is_infinitely_much() -> None:
    posed = several(lambda x: [-abs(x[0])], [0.0])
    assert posed.min_scaled_residual(posed.evaluate((0.0,))) == 0.0
    assert posed.min_scaled_residual(posed.evaluate((1.0,))) < -1e200
    assert posed.evaluate((0.0,)).is_feasible


def test_binding_names_come_tightest_first_as_shares_of_their_scales() -> None:
    """After a = 0 half of each h is left over: all residuals are half of their scale."""
    posed = several(lambda x: [8.0 - x[0], 4.0 - x[0], 2.0 - x[0], 1.0], [0.0] * 4)
    outcome = posed.evaluate((2.0,))  # residuals 2, 0, -1, 0.5: shares 0.25, 0, -0.5, 0.5
    assert posed.active_names(outcome, 1.0) == ("h2", "h1", "h0", "h3")
    assert posed.active_names(outcome, 0.25) == ("h2", "h1", "h0")
    assert posed.active_names(outcome, 0.249) == ("h2", "h1")
    assert posed.active_names(outcome, 0.0) == ("h2", "h1")
    assert posed.active_names(posed.evaluate((0.0,)), 0.0) == ()


def test_as_many_margins_and_values_as_barriers() -> None:
    with pytest.raises(ValueError, match="1 margins for 2 barriers"):
        Constraints(
            Barriers([FunctionBarrier(lambda x: [1.0, 2.0], names=("a", "b"))]),
            Prediction(lambda x: (x, np.eye(1))),
            (0.0,),
            None,
            None,
            0.5,
            [0.0],
            [(-1.0, 1.0, 2.0)],
        )


def test_an_outcome_with_nothing_broken_may_still_be_unsafe() -> None:
    assert ActionCandidate((0.0,), [0.0], [1.0], [1.0], []).is_feasible
    assert ActionCandidate((0.0,), [0.0], [0.0], [0.0], []).is_feasible
    assert not ActionCandidate((0.0,), [0.0], [2.0, -1e-300], [1.0, 1.0], []).is_feasible
    assert not ActionCandidate((0.0,), [0.0], [1.0], [-1.0], [0]).is_feasible


def test_the_second_of_two_actions_has_its_chord_too() -> None:
    """Saturated above 1: to the lower bound, three away, two of it are felt."""

    def step(x: np.ndarray, a: np.ndarray) -> np.ndarray:
        assert a.shape == (2,)
        return np.array([a[0], min(a[1], 1.0)])

    posed = Constraints(
        Barriers([FunctionBarrier(lambda x: x[0] + x[1], lambda x: [1.0, 1.0])]),
        Prediction(lambda x: (x, np.array([[1.0, 0.0], [0.0, 0.0]])), step),
        (1.0, 0.5), None, None, 0.2, [0.1], [(-1.0, 3.0, 4.0)] * 2,
    )  # fmt: skip
    assert posed.linearize(posed.evaluate((0.7, 2.0))).all(1)[0] == pytest.approx([1.0, 2.0 / 3.0])


def test_numbers_whose_sum_is_too_large_are_numbers() -> None:
    """As large as a float can be, but finite: of the state, and of h."""
    large = 1.5e308
    posed = Constraints(
        Barriers([FunctionBarrier(lambda x: np.where(x > 1.0, x, 0.0), names=("a", "b"))]),
        Prediction(lambda x: (x, np.eye(2)), lambda x, a: np.array([large, large])),
        (0.5, 0.5), None, None, 0.2, [0.0, 0.0], [(0.0, 1.0, 1.0)] * 2,
    )  # fmt: skip
    outcome = posed.evaluate((0.0, 0.0))
    assert (outcome.is_finite, outcome.is_feasible, outcome.h_next) == (True, True, [large, large])


NAMES = ("a", "b", "c", "d", "e")
BELIEVED = Plausible(np.array([-1.0, -2.0, -3.0, -4.0, -5.0]), np.array([1.0, 2.0, 3.0, 4.0, 5.0]), NAMES)
ROADS = {
    "array": np.array,
    "list": list,
    "tuple": tuple,
    "single precision": lambda values: np.array(values, dtype=np.float32),
    "mixed": lambda values: [np.float64(values[0]), *values[1:]],
}


@pytest.mark.parametrize("road", ROADS)
def test_the_entry_that_is_out_of_its_range_is_named_and_what_is_no_number_is_not(road: str) -> None:
    made: Any = ROADS[road]
    assert checked_input("state", made([1.0, -2.0, 3.0, -4.0, 5.0]), BELIEVED) == (1.0, -2.0, 3.0, -4.0, 5.0)
    assert checked_input("state", made([0.5] * 3), None) == (0.5,) * 3
    for entry, name in enumerate(NAMES):
        for side in (-1.0, 1.0):
            values = [0.0] * 5
            values[entry] = side * (entry + 1.5)
            reported = checked_input("state", made(values), BELIEVED)
            assert isinstance(reported, InvalidInput)
            assert f" {name} = {values[entry]:g}, wanted {-entry - 1:g} to {entry + 1:g}" in reported.reason
        for number in (np.nan, np.inf, -np.inf):
            values = [9.0] * 5
            values[entry] = number
            assert checked_input("state", made(values), BELIEVED) == InvalidInput("state holds NaN or infinity")


@pytest.mark.parametrize("value", [np.array(1.0), np.zeros((5, 5)), np.zeros((1, 5)), np.zeros(4), [0.0] * 6, []])
def test_another_shape_is_refused_and_reported(value: Any) -> None:
    reported = checked_input("state", value, BELIEVED)
    assert reported == InvalidInput(f"state has shape {np.shape(value)}, wanted (5,)")
