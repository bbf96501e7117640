"""The simulator's fast road on numpy's arrays agrees with the model's own equations on tensors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as some

from safedpa.dynamics import load_model

torch = pytest.importorskip("torch")

from safedpa_sim.training.configuration import load_configuration  # noqa: E402
from safedpa_sim.training.simulator import BatchedCars  # noqa: E402


@given(some.sampled_from(("car", "pendulum")), some.integers(0, 2**31 - 1), some.sampled_from((1, 7, 500, 8193)))
@settings(max_examples=20)
def test_arrays_and_tensors_agree(name, seed, count):
    """In single precision: to 1e-6 of each entry's size, and over the border between two blocks."""
    robots = BatchedCars(load_configuration(name))
    assert robots.model.straight_arrays(robots.model.period) is not None, "the fast way is what is tested"
    draw = robots.generator(seed)
    environment, state = robots.draw_environments(count, draw), robots.draw_states(count, draw)
    action = robots.draw_actions(count, draw)
    ours = robots.advance(state, action, environment, robots.settled(action, environment))[0]
    memory = robots.model.initial_memory(action, environment)
    reference = robots.model.advance(state.double(), action.double(), memory, environment.double())[0].numpy()
    assert ours.dtype == torch.float32
    assert (np.abs(ours.numpy() - reference) / np.maximum(np.abs(reference), 1.0)).max() < 2e-6


def test_gradients_are_computed_on_tensors():
    robots = BatchedCars(load_configuration("car"))
    draw = robots.generator(1)
    environment, state = robots.draw_environments(5, draw), robots.draw_states(5, draw)
    action = robots.draw_actions(5, draw).requires_grad_()
    robots.advance(state, action, environment)[0].sum().backward()
    assert action.grad is not None
    assert torch.isfinite(action.grad).all()


def test_actuators_that_remember_have_no_straight_line():
    from safedpa.effects.library import effect

    lagged = load_model("car").with_effect(effect("car", "steering_lag"), {})
    assert lagged.straight_arrays(lagged.period) is None
    assert load_model("car_learned").straight_arrays(0.05) is None
