"""Conditions at one state: saturated actuators, chords, shapes."""

from collections.abc import Callable

import numpy as np
import pytest

from safedpa.errors import InputError
from safedpa.safety import Barriers, FilterSettings, FunctionBarrier, Prediction, car_barriers
from safedpa.safety.car_stack import stacked
from safedpa.safety.conditions import Conditions, Tangent


def conditions(
    step: Callable[[np.ndarray, np.ndarray], object], g: object, low: float = 0.0, high: float = 2.0
) -> Conditions:
    """h = x_0; the model's step and its tangent g (2, 1) are given apart, so that they may disagree."""
    return Conditions(
        Barriers([FunctionBarrier(lambda x: x[0], lambda x: [1.0, 0.0])]),
        Prediction(lambda x: (x, np.array(g)), step),
        (1.0, 0.5),
        None,
        None,
        0.2,
        [0.1],
        [(low, high, high - low)],
    )


def slope_at(posed: Conditions, action: float) -> float:
    about = posed.outcome((action,))
    return posed.linearised(about).at(about)[0][0][0]


def test_required_is_what_eta_and_epsilon_leave() -> None:
    posed = conditions(lambda x, a: x + a, [[1.0], [0.0]])
    np.testing.assert_allclose(posed.required, [0.8 * 1.0 + 0.1])
    outcome = posed.outcome((0.5,))
    np.testing.assert_allclose(outcome.residual, [1.5 - 0.9])
    assert outcome.violation == 0.0
    assert outcome.least == 1.5
    A, b = posed.linearised(outcome).at(outcome)
    np.testing.assert_allclose(A, [[1.0]])
    np.testing.assert_allclose(b, [0.5 - 0.6])


@pytest.mark.parametrize(("slope", "silent"), [(4e-9, True), (4.5e-9, False), (0.0, True), (-4.5e-9, False)])
def test_only_rounding_errors_count_as_saturation(slope: float, silent: bool) -> None:
    """Next state (3, 0.5): columns up to 1e-9 (1 + 3) are silent, and the chord takes their place."""
    posed = conditions(lambda x, a: np.array([2.5 + a[0], 0.5]), [[slope], [0.0]])
    assert slope_at(posed, 0.5) == pytest.approx(1.0 if silent else slope)


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
    with pytest.raises(InputError, match="predicted state: got NaN"):
        conditions(lambda x, a: np.array([1.0, np.nan]), [[1.0], [0.0]]).outcome((0.0,))
    posed = conditions(lambda x, a: x + a, [[1.0], [np.inf]])
    with pytest.raises(InputError, match="g of the model: got NaN or infinity"):
        posed.linearised(posed.outcome((0.0,)))


@pytest.mark.parametrize("seed", range(4))
def test_rows_that_are_left_out_no_action_can_break(seed: int) -> None:
    """Beside the same barriers one by one, which leave no row out."""
    random, settings = np.random.default_rng(seed), FilterSettings()
    sides = list(
        zip(settings.low.tolist(), settings.high.tolist(), (settings.high - settings.low).tolist(), strict=True)
    )
    left_out = 0
    for _ in range(50):
        obstacles = np.column_stack([random.uniform(-4.0, 4.0, (8, 2)), random.uniform(0.2, 0.4, 8)])
        parts = car_barriers(settings, (0.08, 0.4, 0.12), obstacles, (-5.0, 5.0, -5.0, 5.0))
        state, g = tuple(random.uniform(-2.0, 2.0, 4).tolist()), random.normal(0.0, 0.1, (4, 2)).tolist()
        posed = [
            Conditions(stack, Prediction(lambda x: (x, np.zeros((4, 2)))), state, None, None, 0.2, [0.0] * 18, sides)
            for stack in (stacked(parts), Barriers(parts))
        ]
        widths, about = [width for _, _, width in sides], posed[0].outcome(settings.resting_action.tolist())
        found, every = (Tangent(one.barriers, g, about, widths).at(about) for one in posed)
        assert len(every[0]) == 18
        for slopes, limit in zip(*every, strict=True):
            least = sum(min(slope * low, slope * high) for slope, (low, high, _) in zip(slopes, sides, strict=True))
            near = [np.allclose([*slopes, limit], [*own, b], atol=1e-12) for own, b in zip(*found, strict=True)]
            assert any(near) or least >= limit
        left_out += 18 - len(found[0])
    assert left_out > 100
