"""Functions of the user's own that answer something else on the way than where the filter was asked."""

from __future__ import annotations

from math import nan
from typing import Any

import numpy as np
import pytest

from safedpa.errors import InputError
from safedpa.safety import FilterSettings, FunctionBarrier, Prediction, SafetyFilter, Status

SETTINGS = FilterSettings(action_low=(-3.0,), action_high=(3.0,), eta=1.0, epsilon=0.0)


@pytest.mark.parametrize("lowest", [-1.0, -3.0])
def test_a_chord_to_a_bound_where_the_model_has_no_number_is_none(lowest: float) -> None:
    """The actuator saturates above 1, and below ``lowest`` nothing is known: 0.5 - x holds up to an action of 0.5."""

    def step(x: Any, a: Any) -> Any:
        del x
        return np.array([min(float(a[0]), 1.0) if a[0] >= lowest else nan])

    def affine(x: Any, around: Any) -> Any:
        g = np.array([[float(around[0] < 1.0)]])
        return step(x, around) - g @ around, g

    barrier = FunctionBarrier(lambda x: 0.5 - x[0], lambda x: np.array([-1.0]))
    verdict = SafetyFilter(Prediction(affine, step), [barrier], SETTINGS).decide([0.0], [2.0])
    assert (verdict.status, verdict.slack) == (Status.corrected, 0.0)
    assert verdict.action == pytest.approx([0.5], abs=1e-6)


@pytest.mark.parametrize("f", [np.zeros(2), np.zeros((1, 1)), np.zeros((1, 2))], ids=str)
def test_the_next_of_one_state_is_one_number_or_a_vector_of_one(f: Any) -> None:
    state, action = np.zeros(1), np.zeros(1)
    with pytest.raises(InputError, match=r"^f of the model: got shape .*, wanted \(1,\)"):
        Prediction(lambda x: (f, np.ones((1, 1)))).next_state(state, action, None, None)
    for good in (3.0, np.array(3.0), np.array([3.0])):
        found = Prediction(lambda x, good=good: (good, np.ones((1, 1)))).next_state(state, action, None, None)
        assert found.tolist() == [3.0]


@pytest.mark.parametrize("g", [np.ones(2), np.ones((2, 1)), np.ones((1, 3)), np.ones((1, 2, 1))], ids=str)
def test_slopes_beside_a_step_of_ones_own_are_a_row_for_each_state(g: Any) -> None:
    """Of one state and two actions: what the step answers says nothing about them."""

    def step(x: Any, a: Any) -> Any:
        return x + a.sum()

    with pytest.raises(InputError, match=r"^g of the model: got shape .*, wanted \(1, 2\)"):
        Prediction(lambda x: (x, g), step).slopes_of_one((0.0,), (0.0, 0.0), None, None)
    assert Prediction(lambda x: (x, np.ones((1, 2))), step).slopes_of_one((0.0,), (0.0, 0.0), None, None) == [
        [1.0, 1.0]
    ]
