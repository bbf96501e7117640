"""Dry friction at rest: rollouts keep a stationary robot at rest; models for slopes stay smooth."""

from __future__ import annotations

import numpy as np
import pytest

from safedpa.dynamics import PhysicsModel, Setting
from safedpa.effects import effect
from safedpa.robots.car.kinematic_bicycle import KinematicBicycle

SERVO = {"base.wheelbase": 0.32, "base.speed_gain": 5.0, "base.acceleration_limit": 5.0}
HELD = {"rolling_resistance": {"deceleration": 1.5}, "towed_load": {"mass_ratio": 0.8, "deceleration": 1.9}}


def _car(name, holds):
    settings = {path: Setting(value) for path, value in SERVO.items()}
    model = PhysicsModel(KinematicBicycle(), (), settings, 0.05, holds=holds)
    return model.with_effect(effect("car", name), {key: Setting(value) for key, value in HELD[name].items()})


def _speeds(model, target, start, rows):
    state, found = np.array([0.0, 0.0, 0.0, start]), []
    for _ in range(rows):
        state, _ = model.advance(state, np.array([target, 0.0]), ())
        found.append(state[3])
    return np.array(found)


@pytest.mark.parametrize("name", HELD)
def test_a_car_that_is_driven_by_less_than_its_friction_stands(name):
    """5 (0.25 - 0) = 1.25 m/s2 against 1.5 m/s2 and more."""
    assert np.abs(_speeds(_car(name, holds=True), 0.25, 0.0, 40)).max() == 0.0
    assert _speeds(_car(name, holds=False), 0.25, 0.0, 40)[-1] > 0.05  # rounded off it creeps


@pytest.mark.parametrize("name", HELD)
def test_what_slides_comes_to_rest_and_stays_there(name):
    speeds = _speeds(_car(name, holds=True), 0.0, 1.0, 60)
    assert (np.diff(speeds) <= 0.0).all()
    assert (speeds >= 0.0).all()  # neither overshoots nor oscillates
    assert speeds[-1] < 1e-9


@pytest.mark.parametrize("name", HELD)
def test_away_from_rest_both_are_the_same(name):
    held, rounded = (_speeds(_car(name, holds), 2.0, 0.5, 60) for holds in (True, False))
    np.testing.assert_allclose(held, rounded, atol=1e-9)


def test_copies_of_a_model_that_holds_hold():
    model = _car("rolling_resistance", holds=True)
    again = model.with_period(0.02).with_settings({"rolling_resistance.deceleration": Setting(1.4)})
    assert again.holds
    assert again.with_effect(effect("car", "quadratic_drag"), {}).holds
    assert not _car("rolling_resistance", holds=False).holds


def test_a_pendulum_under_less_torque_than_its_friction_stands():
    from safedpa.robots.pendulum.rigid_pendulum import RigidPendulum

    base = {"base.length": 0.5, "base.mass": 1.0, "base.gravity": 9.81}
    made = PhysicsModel(RigidPendulum(), (), {path: Setting(value) for path, value in base.items()}, 0.02, holds=True)
    model = made.with_effect(effect("pendulum", "coulomb_friction"), {"torque": Setting(0.3)})
    state = np.array([np.pi + 0.05, 0.0])  # 0.25 N m of weight
    for _ in range(50):
        state, _ = model.advance(state, np.array([0.0]), ())
    np.testing.assert_allclose(state, [np.pi + 0.05, 0.0], atol=1e-12)


def test_what_turns_a_motion_back_does_not_turn_the_friction_before_it():
    """A pendulum that climbs: friction works against it until it turns, however hard gravity pulls."""
    from safedpa.effects.effect import Context
    from safedpa.effects.friction import REST_RATE, resistance
    from safedpa.operations import FLOATS

    context = Context({}, {}, {}, 0.0, 0.02, FLOATS, True)
    assert resistance(-15.0, 0.2, 1.0, REST_RATE, context) == 1.0
    assert resistance(-15.0, -0.2, 1.0, REST_RATE, context) == -1.0
    assert resistance(-15.0, 0.0, 1.0, REST_RATE, context) == -1.0
    assert resistance(0.5, 0.0, 1.0, REST_RATE, context) == 0.5
