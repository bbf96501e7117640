"""How quick a model is: bounds that random states, actions and latents keep, for models that are quicker than a car."""

from __future__ import annotations

import numpy as np
import pytest

from safedpa.dynamics import load_model
from safedpa.robots.car.quickness import ORDINARY, Quickness, quickness_of
from safedpa.safety.shipped import settings_named

MODELS = ("car", "car_fix", "car_learned", "car_measured", "car_mix", "car_rma_p", "car_simulated", "dart_car")


def bounds_of(name: str) -> Quickness:
    return quickness_of(load_model(name), settings_named("car_throttle" if name == "dart_car" else "car"))


@pytest.mark.parametrize("name", MODELS)
def test_no_period_does_more(name: str) -> None:
    model, draw = load_model(name), np.random.default_rng(7)
    settings = settings_named("car_throttle" if name == "dart_car" else "car")
    bounds, count, period = quickness_of(model, settings), 2000, model.period
    states = np.zeros((count, 4))
    states[:, 2] = draw.uniform(-np.pi, np.pi, count)
    states[:, 3] = draw.uniform(settings.barrier("speed_low"), settings.barrier("speed_high"), count)
    actions, before = draw.uniform(settings.action_low, settings.action_high, (2, count, 2))
    ends = np.array([(model.parameters[one].low, model.parameters[one].high) for one in model.latent_names])
    latent = draw.uniform(*ends.T, (count, len(ends))) if len(ends) else None
    after = model.advance(states, actions, model.initial_memory(before, latent), latent)[0]
    changes = np.abs(after - states)
    swiftness = np.abs(states[:, 3]) + bounds.acceleration * period
    assert (changes[:, 3] <= bounds.acceleration * period).all()
    assert (changes[:, 2] <= bounds.curvature * swiftness * period).all()
    assert (changes[:, :2] <= bounds.reach * swiftness[:, None] * period).all()


def test_a_model_that_is_quicker_than_a_car_is_taken_as_quick_as_it_is() -> None:
    """With the bounds of an ordinary car, what it can reach would be left out as far away."""
    assert bounds_of("car") == bounds_of("car_mix") == ORDINARY
    assert bounds_of("car_learned").acceleration > 1.5 * ORDINARY.acceleration, "at the ends of its latents"
    assert bounds_of("dart_car").acceleration == pytest.approx(125.0), "of a gain of up to 100 m/s2"


def test_a_model_that_gives_no_number_leaves_nothing_out(monkeypatch: pytest.MonkeyPatch) -> None:
    model = load_model("car")
    monkeypatch.setattr(type(model), "advance", lambda *_, **__: (np.full((9, 5, 5, 5, 4), np.nan), None))
    found = quickness_of(model, settings_named("car"))
    assert found.acceleration == found.curvature == found.reach == np.inf
