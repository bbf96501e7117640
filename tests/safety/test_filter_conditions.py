"""Conditions at one state: saturated actuators, chords, shapes."""

from collections.abc import Callable

import numpy as np
import pytest

from safedpa.errors import InputError
from safedpa.safety import Barriers, FunctionBarrier, Prediction
from safedpa.safety.conditions import Conditions


def conditions(
    step: Callable[[np.ndarray, np.ndarray], object], g: object, low: float = 0.0, high: float = 2.0
) -> Conditions:
    """h = x_0; the model's step and its tangent g (2, 1) are given apart, so that they may disagree."""
    return Conditions(
        Barriers([FunctionBarrier(lambda x: x[0], lambda x: [1.0, 0.0])]),
        Prediction(lambda x: (x, np.array(g)), step),
        np.array([1.0, 0.5]),
        None,
        None,
        0.2,
        np.array([0.1]),
        np.array([low]),
        np.array([high]),
    )


def test_required_is_what_eta_and_epsilon_leave() -> None:
    posed = conditions(lambda x, a: x + a, [[1.0], [0.0]])
    np.testing.assert_allclose(posed.required, [0.8 * 1.0 + 0.1])
    outcome = posed.outcome(np.array([0.5]))
    np.testing.assert_allclose(outcome.residual, [1.5 - 0.9])
    assert outcome.violation == 0.0
    assert outcome.least == 1.5
    A, b = posed.linearised(outcome)
    np.testing.assert_allclose(A, [[1.0]])
    np.testing.assert_allclose(b, [0.5 - 0.6])


@pytest.mark.parametrize(("slope", "silent"), [(4e-9, True), (4.5e-9, False), (0.0, True), (-4.5e-9, False)])
def test_only_rounding_errors_count_as_saturation(slope: float, silent: bool) -> None:
    """Next state (3, 0.5): columns up to 1e-9 (1 + 3) are silent, and the chord takes their place."""
    posed = conditions(lambda x, a: np.array([2.5 + a[0], 0.5]), [[slope], [0.0]])
    A, _ = posed.linearised(posed.outcome(np.array([0.5])))
    assert A[0, 0] == pytest.approx(1.0 if silent else slope)


@pytest.mark.parametrize(
    ("value", "low", "high", "end"),
    [(1.5, 1.0, 3.0, 3.0), (2.5, 1.0, 3.0, 1.0), (2.0, 1.0, 3.0, 3.0), (-1.0, -2.0, 5.0, 5.0), (4.0, -2.0, 5.0, -2.0)],
)
def test_chord_leads_to_the_bound_further_away(value: float, low: float, high: float, end: float) -> None:
    posed = conditions(lambda x, a: np.array([a[0] ** 2, 0.5]), [[0.0], [0.0]], low, high)
    A, _ = posed.linearised(posed.outcome(np.array([value])))
    assert A[0, 0] == pytest.approx((end**2 - value**2) / (end - value))


def test_earlier_slopes_beat_the_chord() -> None:
    slopes = iter(([[7.0], [0.0]], [[0.0], [0.0]], [[2.0], [0.0]]))
    posed = conditions(lambda x, a: np.array([a[0] ** 2, 0.5]), [[0.0], [0.0]])
    posed._prediction = Prediction(lambda x: (x, np.array(next(slopes))), lambda x, a: np.array([a[0] ** 2, 0.5]))
    about = posed.outcome(np.array([1.0]))
    assert [posed.linearised(about)[0][0, 0] for _ in range(3)] == [7.0, 7.0, 2.0]


def test_one_number_that_is_none_is_enough() -> None:
    with pytest.raises(InputError, match="predicted state: got NaN"):
        conditions(lambda x, a: np.array([1.0, np.nan]), [[1.0], [0.0]]).outcome(np.zeros(1))
    posed = conditions(lambda x, a: x + a, [[1.0], [np.inf]])
    with pytest.raises(InputError, match="g of the model: got NaN or infinity"):
        posed.linearised(posed.outcome(np.zeros(1)))
