"""The estimator finds what was planted, follows a change, believes nothing absurd, and agrees with matrices."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as some
from numpy.typing import NDArray

from safedpa.adaptation import EstimatorSettings, LatentEstimator
from safedpa.adaptation.estimator import LatentCovariance
from safedpa.dynamics import PhysicsModel, Setting, load_model, parse_model
from safedpa.effects.library import effect
from safedpa.errors import InputError

PERIOD = 0.05
NOISE = np.array([0.002, 0.002, 0.002, 0.01])
SETTINGS = EstimatorSettings(measurement_deviation=(0.003, 0.003, 0.003, 0.015))

HEAD = """
format = 1
robot = "car"
[base]
kind = "kinematic_bicycle"
drive = "speed_servo"
wheelbase = 0.32
speed_gain = 4.0
acceleration_limit = 5.0
"""
TOWED = HEAD + '[[effects]]\nname = "towed_load"\nmass_ratio = { value = 0.0, free = true }\ndeceleration = 2.5\n'
DRAG = HEAD + '[[effects]]\nname = "quadratic_drag"\ncoefficient = { value = 0.0, free = true }\n'
BOTH = TOWED + '[[effects]]\nname = "quadratic_drag"\ncoefficient = { value = 0.0, free = true }\n'
LAGGED = TOWED + '[[effects]]\nname = "steering_lag"\ntime_constant = { value = 0.05, free = true }\n'
FIXED = HEAD + '[[effects]]\nname = "quadratic_drag"\ncoefficient = 0.1\n'

Values = NDArray[np.float64]
Actions = Callable[[int], Values]


def lively(step: int) -> Values:
    """Steps of target speed and steer, as in driving from goal to goal."""
    return np.array([1.0 + 0.8 * np.sign(np.sin(0.35 * step)), 0.3 * np.sign(np.sin(0.23 * step + 1.0))])


def still(step: int) -> Values:
    del step
    return np.zeros(2)


class Drive:
    """A simulated car and the estimator that watches it, side by side."""

    def __init__(self, model, settings=SETTINGS, seed=0, noise=NOISE):
        self.model: PhysicsModel = parse_model(model)
        self.estimator = LatentEstimator(self.model, settings)
        self.random, self.noise = np.random.default_rng(seed), noise
        self.state, self.measured = np.zeros(4), np.zeros(4)
        self.memory = self.model.initial_memory(np.zeros(2))
        self.steps = 0

    def run(self, seconds: float, latent: tuple[float, ...], actions: Actions = lively) -> Drive:
        for _ in range(round(seconds / PERIOD)):
            action = actions(self.steps)
            self.state, self.memory = self.model.advance(self.state, action, self.memory, np.array(latent))
            measured = self.state + self.noise * self.random.standard_normal(4)
            self.estimator.update(self.measured, action, measured, PERIOD)
            self.measured = measured
            self.steps += 1
        return self


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("model", "planted"),
    [
        (TOWED, (0.0,)), (TOWED, (0.4,)), (TOWED, (1.2,)), (DRAG, (0.0,)), (DRAG, (0.25,)), (BOTH, (0.5, 0.2)),
        (LAGGED, (0.5, 0.15)),
    ],
)  # fmt: skip
def test_it_recovers_what_was_planted(model: str, planted: tuple[float, ...], seed: int) -> None:
    drive = Drive(model, seed=seed).run(20.0, planted)
    estimator = drive.estimator
    typical = np.array([drive.model.parameters[path].typical for path in drive.model.latent_names])
    assert np.all(np.abs(estimator.latent - planted) <= 3.0 * estimator.deviations)
    if model is not BOTH:  # mass and drag look alike at these speeds, and it must not claim to tell them apart
        assert np.all(estimator.deviations < 0.35 * typical), "and it says so with some confidence"


def test_it_follows_a_change() -> None:
    drive = Drive(TOWED).run(8.0, (0.0,))
    assert drive.estimator.latent[0] < 0.1
    drive.run(6.0, (0.8,))
    assert drive.estimator.latent[0] == pytest.approx(0.8, abs=3.0 * drive.estimator.deviations[0])
    drive.run(6.0, (0.1,))
    assert drive.estimator.latent[0] == pytest.approx(0.1, abs=3.0 * drive.estimator.deviations[0])


@pytest.mark.parametrize("jump", [(3.0, -2.0, 0.0, 0.0), (0.0, 0.0, 2.0, 0.0), (0.0, 0.0, 0.0, -4.0), (50.0, 0, 1, 2)])
def test_a_teleport_does_not_throw_it(jump: tuple[float, ...]) -> None:
    drive = Drive(TOWED).run(10.0, (0.5,))
    before, deviation = drive.estimator.latent.copy(), drive.estimator.deviations[0]
    drive.estimator.update(drive.measured, lively(drive.steps), drive.measured + np.array(jump), PERIOD)
    assert float(abs(drive.estimator.latent - before)[0]) <= SETTINGS.largest_innovation * deviation
    drive.run(4.0, (0.5,))
    assert drive.estimator.latent[0] == pytest.approx(0.5, abs=3.0 * drive.estimator.deviations[0])


@pytest.mark.parametrize("planted", [0.0, 0.7])
def test_a_stationary_car_teaches_nothing(planted: float) -> None:
    drive = Drive(TOWED, EstimatorSettings(), noise=0.3 * NOISE)
    start = drive.estimator.deviations.copy()
    drive.run(60.0, (planted,), still)
    assert drive.estimator.deviations == pytest.approx(start, rel=0.15)
    assert abs(drive.estimator.latent[0]) <= 0.2 * start[0]


def test_a_car_that_a_wall_holds_is_not_taken_for_one_with_a_heavy_load() -> None:
    drive = Drive(TOWED, EstimatorSettings()).run(10.0, (0.5,))
    before, where = drive.estimator.latent.copy(), drive.measured
    for _ in range(100):
        measured = where + NOISE * 0.3 * drive.random.standard_normal(4)
        drive.estimator.update(drive.measured, np.array([1.6, 0.0]), measured, PERIOD)
        drive.measured = measured
    assert drive.estimator.latent == pytest.approx(before, abs=0.05)


def test_what_is_forgotten_at_rest_is_no_more_than_was_unknown_at_first() -> None:
    drive = Drive(LAGGED)
    start = drive.estimator.deviations.copy()
    drive.run(10.0, (0.5, 0.1))
    assert np.all(drive.estimator.deviations < start)
    drive.run(120.0, (0.5, 0.1), still)
    assert np.all(drive.estimator.deviations <= start * (1.0 + 1e-9))


@given(
    some.lists(
        some.tuples(*([some.floats(-30.0, 30.0)] * 6), *([some.floats(-40.0, 40.0)] * 4)), min_size=1, max_size=15
    )
)
@settings(max_examples=60)
def test_whatever_is_measured_the_estimate_stays_physical(rows: list[tuple[float, ...]]) -> None:
    model = parse_model(BOTH)
    estimator = LatentEstimator(model)
    first = estimator.deviations.copy()
    for row in rows:
        values = np.array(row)
        estimator.update(values[:4], values[4:6] * np.array([0.25, 0.02]), values[6:], PERIOD)
    for path, value in zip(model.latent_names, estimator.latent, strict=True):
        assert model.parameters[path].low <= value <= model.parameters[path].high
    assert np.all(np.isfinite(estimator.deviations))
    assert np.all(estimator.deviations > 0.0)
    assert np.all(estimator.deviations <= first * (1.0 + 1e-9))


@pytest.mark.parametrize(
    ("place", "bad"),
    [("period", 0.0), *product(("state", "action", "next_state", "period"), (np.nan, np.inf, -np.inf))],
)
def test_what_is_no_number_or_no_period_cannot_enter(place: str, bad: float) -> None:
    drive = Drive(TOWED).run(1.0, (0.5,))
    latent, deviations = drive.estimator.latent.copy(), drive.estimator.deviations.copy()
    arguments: dict[str, Values | float] = {"state": np.zeros(4), "action": np.zeros(2), "next_state": np.zeros(4)}
    if place == "period":
        arguments["period"] = bad
    else:
        array = np.array(arguments[place])
        array[-1] = bad
        arguments |= {place: array, "period": PERIOD}
    with pytest.raises(InputError, match=r"transition|period"):
        drive.estimator.update(**arguments)  # type: ignore[arg-type]
    np.testing.assert_array_equal(drive.estimator.latent, latent)
    np.testing.assert_array_equal(drive.estimator.deviations, deviations)


def test_a_model_without_free_parameters_has_nothing_to_estimate() -> None:
    estimator = Drive(FIXED).run(1.0, ()).estimator
    assert estimator.latent.shape == estimator.deviations.shape == (0,)


def test_the_lag_of_the_actuators_is_remembered_between_updates() -> None:
    """With the memory a lagged car is predicted to the noise; with the memory thrown away each time it is not."""
    planted = (0.0, 0.2)
    retained = Drive(LAGGED).run(15.0, planted).estimator.latent[1]
    drive = Drive(LAGGED)
    for _ in range(round(15.0 / PERIOD)):
        drive.estimator.forget_transient()
        drive.run(PERIOD, planted)
    assert abs(retained - 0.2) < 0.05
    assert abs(drive.estimator.latent[1] - 0.2) > 0.1


def test_settings_are_checked_where_they_are_made() -> None:
    for wrong in ({"initial_deviation": 0.0}, {"drift_per_second": -1.0}, {"largest_innovation": float("nan")}):
        with pytest.raises(InputError, match="wanted positive numbers"):
            EstimatorSettings(**wrong)
    with pytest.raises(InputError, match=r"wanted 4 \(x, y, yaw, speed\)"):
        LatentEstimator(load_model("car"), EstimatorSettings(measurement_deviation=(0.1,)))


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
    belief, covariance = LatentCovariance(start.tolist(), drift.tolist()), np.diag(start)
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


@pytest.mark.parametrize(("timing", "exact"), [(0.0, False), (0.15, True)])
def test_commands_that_act_late_are_not_taken_for_a_motor_of_another_force(timing: float, exact: bool) -> None:
    """The throttle acts 0.15 s late; the true gain is that of the model."""
    model = load_model("dart_car")
    shipped = LatentEstimator(model)
    estimator = LatentEstimator(model, EstimatorSettings(command_timing=timing))
    state, sent, furthest = np.zeros(4), [np.zeros(2)] * 3, 0.0
    for step in range(80):
        sent.append(np.array([0.5 if step // 10 % 2 else -0.5, 0.0]))
        after = model.step(state, sent[-4])
        for one in (shipped, estimator):
            one.update(state, sent[-1], after, PERIOD)
        state, furthest = after, max(furthest, abs(float(estimator.latent[0]) - 4.48))
    assert (furthest < 0.5) is exact
    assert (shipped.latent.tolist() == estimator.latent.tolist()) is exact, "so ships the car with a throttle"


def test_the_timing_of_commands_is_no_negative_time() -> None:
    with pytest.raises(InputError, match="command_timing"):
        EstimatorSettings(command_timing=-0.1)
