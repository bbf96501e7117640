"""Many robots' latents from what they lived through: what each would be told alone."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as some

from safedpa.adaptation import HistoryEstimator
from safedpa.adaptation.histories import Histories
from safedpa.dynamics import LearnedBase, load_model
from safedpa.errors import InputError

PERIOD = 0.05


@given(some.integers(0, 2**32 - 1))
@settings(max_examples=8)
def test_histories_are_those_of_each_alone(seed: int) -> None:
    """Also where one begins anew in the midst of it."""
    draw, model, cars = np.random.default_rng(seed), load_model("car_learned"), 3
    assert isinstance(model.base, LearnedBase)
    together, alone = Histories(model.base.weights, cars), [HistoryEstimator(model) for _ in range(cars)]
    state = draw.normal(size=(cars, 4)) * 0.2
    together.see(state)
    for tick in range(80):
        before, state = state, state + draw.normal(size=(cars, 4)) * 0.03
        applied = draw.uniform(-0.3, 0.3, (cars, 2))
        if tick == 60:
            together.reset([1])
            alone[1].forget_transient()
        together.acted(applied)
        latents = together.see(state)
        for car in range(cars):
            if tick == 60 and car == 1:  # its state before is not known any more
                continue
            alone[car].update(before[car], applied[car], state[car], PERIOD)
            np.testing.assert_allclose(latents[car], alone[car].latent, atol=2e-6)


def test_weights_without_a_history_encoder_are_refused() -> None:
    base = load_model("car_fix").base
    assert isinstance(base, LearnedBase)
    with pytest.raises(InputError, match="phi"):
        Histories(base.weights, 2)
