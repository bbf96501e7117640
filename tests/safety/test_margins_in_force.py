"""Margins kept from the last decision, and slopes kept within one: never beyond what they were made for."""

from __future__ import annotations

import math

import numpy as np
import pytest

from safedpa.dynamics import load_model
from safedpa.robots.car.barriers import car_barriers
from safedpa.safety import FilterSettings, Prediction
from safedpa.safety.margins_in_force import Margins
from safedpa.safety.search import DecisionError
from safedpa.safety.speed_barrier import SpeedBarrier
from safedpa.safety.stacks import stacked

SETTINGS = {"obstacle": 0.1, "default": 0.02}


def test_margins_follow_the_request_and_the_barriers() -> None:
    margins = Margins(SETTINGS)
    one, other = (stacked(car_barriers(FilterSettings(), (0.1, 0.4, 0.1), [(1.0, 1.0, 0.2)] * n)) for n in (1, 2))
    asked: dict[str, float] = {}
    for _ in range(2):
        assert margins.of(one, asked) == ([0.1, 0.02, 0.02], 0.1)
    asked["speed"] = 0.3
    for _ in range(2):
        assert margins.of(one, asked) == ([0.1, 0.3, 0.3], 0.3)
    assert margins.of(one, dict(asked)) is margins.of(one, asked)  # kept
    assert margins.of(other, asked) == ([0.1, 0.1, 0.3, 0.3], 0.3)
    assert margins.of(one, {}) == ([0.1, 0.02, 0.02], 0.1)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -0.1])
def test_a_bad_margin_is_refused_every_time_and_forgotten(bad: float) -> None:
    margins = Margins(SETTINGS)
    stack = stacked(car_barriers(FilterSettings(), (0.1, 0.4, 0.1), [(1.0, 1.0, 0.2)]))
    asked = {"speed": bad}
    for _ in range(2):
        with pytest.raises(DecisionError, match="not a finite number >= 0"):
            margins.of(stack, asked)
    assert margins.of(stack, {}) == ([0.1, 0.02, 0.02], 0.1)


@pytest.mark.parametrize(("name", "affine"), [("car_learned", True), ("car", False)])
def test_only_networks_have_the_same_slopes_about_every_action(name: str, affine: bool) -> None:
    model = load_model(name)
    prediction, latent = Prediction.of_model(model), tuple(model.latent.tolist())
    assert prediction.affine is affine
    state, random = (0.3, -0.2, 0.7, 0.9), np.random.default_rng(0)
    actions = random.uniform((-0.6, -0.34), (2.0, 0.34), (300, 2)).tolist()  # enough for the straight road
    for action in actions:
        prediction.following(state, action, latent, None)
    slopes = [prediction.slopes_of_one(state, action, latent, None) for action in actions]
    assert all(slope == slopes[0] for slope in slopes) is affine
    at = np.array(prediction.following(state, actions[0], latent, None))
    there = np.array(prediction.following(state, actions[1], latent, None))
    predicted = at + np.array(slopes[0]) @ (np.array(actions[1]) - np.array(actions[0]))
    assert np.allclose(there, predicted, rtol=0.0, atol=1e-12) is affine


def test_a_learned_model_with_effects_is_not_taken_for_affine() -> None:
    from safedpa.effects import effect

    model = load_model("car_learned").with_effect(effect("car", "quadratic_drag"), {})
    assert not Prediction.of_model(model).affine


def test_what_was_ever_in_sight_may_be_named_though_nothing_was_asked_when_it_came() -> None:
    margins, bare = Margins(SETTINGS), stacked([SpeedBarrier(-1.0, 1.0)])
    strange = SpeedBarrier(-1.0, 1.0)
    strange.kind = "wheel"
    with pytest.raises(DecisionError, match="'wheel', which no barrier is"):
        margins.of(bare, {"wheel": 0.3})
    assert margins.of(bare, {}) == ([0.02, 0.02], 0.02)
    assert margins.of(stacked([strange]), {}) == ([0.02, 0.02], 0.02)
    assert margins.of(bare, {"wheel": 0.3}) == ([0.02, 0.02], 0.02)
    assert margins.of(stacked([strange]), {"wheel": 0.3}) == ([0.3, 0.3], 0.3)
