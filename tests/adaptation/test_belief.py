"""The estimator's arithmetic on plain numbers agrees with the matrices that it stands for."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as some

from safedpa.adaptation.estimator import Belief, EstimatorSettings, LatentEstimator
from safedpa.dynamics import PhysicsModel, Setting, load_model
from safedpa.effects.library import effect


def corrected(covariance, innovation, sensitivity, noise):
    """The measurement update in matrices, in Joseph's form: correction, surprise, covariance."""
    spread = sensitivity @ covariance @ sensitivity.T + np.diag(noise)
    gain = np.linalg.solve(spread, sensitivity @ covariance).T
    keep = np.eye(len(covariance)) - gain @ sensitivity
    after = keep @ covariance @ keep.T + gain @ np.diag(noise) @ gain.T
    return gain @ innovation, innovation @ np.linalg.solve(spread, innovation), after


@given(some.integers(1, 5), some.integers(1, 5), some.integers(0, 2**32 - 1))
@settings(max_examples=60)
def test_one_entry_after_the_other_is_all_at_once(latents, states, seed):
    draw = np.random.default_rng(seed)
    start, drift = draw.uniform(0.1, 3.0, latents), draw.uniform(0.01, 1.0, latents)
    belief, covariance = Belief(start.tolist(), drift.tolist()), np.diag(start)
    for _ in range(30):
        period = draw.uniform(0.01, 0.2)
        belief.spread(period)
        covariance = covariance + np.diag(drift * period)
        shrink = np.sqrt(np.minimum(1.0, start / covariance.diagonal()))
        covariance = covariance * np.outer(shrink, shrink)
        innovation, sensitivity = draw.normal(size=states), draw.normal(size=(states, latents))
        noise = draw.uniform(0.01, 1.0, states)
        correction, surprise = belief.correct(innovation.tolist(), sensitivity.tolist(), noise.tolist())
        expected, size, covariance = corrected(covariance, innovation, sensitivity, noise)
        np.testing.assert_allclose(correction, expected, rtol=1e-9, atol=1e-12)
        assert surprise == pytest.approx(size, rel=1e-9)
        np.testing.assert_allclose(belief.variances(), covariance.diagonal(), rtol=1e-9)


def reference(model, states, actions, settings):
    """Latents (n, latents) by the estimator's equations in matrices, and ``advance`` for every step."""
    chosen = [model.parameters[path] for path in model.latent_names]
    low, high = (np.array([getattr(item, end) for item in chosen]) for end in ("low", "high"))
    typical = np.array([item.typical or 0.1 * (item.high - item.low) for item in chosen])
    noise, limit = np.square(settings.measurement_deviation), np.square(settings.initial_deviation * typical)
    latent, covariance, found = model.latent.copy(), np.diag(limit), []
    memory = model.initial_memory(actions[0])
    for before, action, after in zip(states, actions, states[1:], strict=False):
        predicted, following = model.advance(before, action, memory, latent)
        covariance = covariance + np.diag(np.square(settings.drift_per_second * typical) * model.period)
        shrink = np.sqrt(np.minimum(1.0, limit / covariance.diagonal()))
        covariance = covariance * np.outer(shrink, shrink)
        columns = []
        for index, step in enumerate(1e-4 * typical):
            nudge = -step if latent[index] + step > high[index] else step
            moved = model.advance(before, action, memory, latent + nudge * np.eye(len(latent))[index])[0]
            columns.append((moved - predicted) / nudge)
        innovation = model.system.difference(after, predicted)
        correction, size, covariance = corrected(covariance, innovation, np.array(columns).T, noise)
        weight = min(1.0, settings.largest_innovation / max(np.sqrt(size / len(innovation)), 1e-12))
        latent = np.clip(latent + weight * correction, low, high)
        memory = following
        found.append(latent)
    return np.array(found)


@pytest.mark.parametrize("names", [("towed_load",), ("towed_load", "quadratic_drag"), ("towed_load", "steering_lag")])
def test_the_estimate_is_that_of_the_matrices(names):
    """With a straight line of arithmetic and, for actuators that remember, without; a jump is weighted down alike."""
    model: PhysicsModel = load_model("car")
    for name in names:
        if name not in {item.name for item in model.effects}:
            item = effect("car", name)
            model = model.with_effect(item, {item.parameters[0].name: Setting(item.parameters[0].start, free=True)})
    draw, count = np.random.default_rng(7), 330
    actions = np.stack([0.9 + 0.8 * np.sign(np.sin(0.35 * np.arange(count))), draw.normal(0.0, 0.2, count)], axis=1)
    truth = model.latent + 0.3 * np.array([model.parameters[path].typical or 0.1 for path in model.latent_names])
    states, memory = [np.zeros(4)], model.initial_memory(actions[0])
    for action in actions:
        after, memory = model.advance(states[-1], action, memory, truth)
        states.append(after)
    measured = np.array(states) + draw.normal(size=(count + 1, 4)) * 0.003
    measured[200, :2] += 0.4
    chosen = EstimatorSettings(smallest_motion=1e-9)
    estimator = LatentEstimator(model, chosen)
    expected = reference(model, measured, actions, chosen)
    for tick, action in enumerate(actions):
        estimator.update(measured[tick], action, measured[tick + 1], model.period)
        np.testing.assert_allclose(estimator.latent, expected[tick], rtol=1e-6, atol=1e-9)
