"""What an actuator makes of a command without a memory is part of the step, as fast and as exact as all of it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from safedpa.diagnosis.diagnose import library_for
from safedpa.dynamics import PhysicsModel, Setting, load_model
from safedpa.effects import CommandEffect, effect
from safedpa.effects.effect import Named, Stage
from safedpa.effects.parameter import Parameter
from safedpa.operations import Operations
from safedpa.safety.prediction import Prediction

ROBOTS = ("car", "dart_car", "differential_drive", "pendulum", "point")
AT_ONCE = [
    (robot, item)
    for robot in ROBOTS
    for item in library_for(load_model(robot))
    if isinstance(item, CommandEffect)
    and item.initial_memory(dict.fromkeys(load_model(robot).system.action_names, 0.0)) is None
]


def drawn(model: PhysicsModel, generator: np.random.Generator) -> tuple[list[float], list[float], list[float]]:
    """A state, an action within the bounds and a latent."""
    low, high = model.system.action_low, model.system.action_high
    state = generator.normal(size=len(model.system.state_names))
    latent = model.latent * (1.0 + 0.1 * generator.normal(size=len(model.latent)))
    return state.tolist(), (low + (high - low) * generator.random(len(low))).tolist(), latent.tolist()


def reference(model: PhysicsModel, state: list[float], action: list[float], latent: list[float]) -> list[Any]:
    """The same step by dictionaries, as a new model takes it, of actuators that settled at the action."""
    new = PhysicsModel(model.base, model.effects, model.settings, model.period)
    assert new.straight(new.period) is None
    memory = new.initial_memory(np.array(action), np.array(latent))
    return new.advance(np.array(state), np.array(action), memory, np.array(latent))[0].tolist()


def test_every_robot_has_some() -> None:
    assert {robot for robot, _ in AT_ONCE} == set(ROBOTS)


@pytest.mark.parametrize(("robot", "item"), AT_ONCE, ids=[f"{robot}-{item.name}" for robot, item in AT_ONCE])
def test_the_step_is_recorded_with_it_and_the_same_to_the_last_bit(robot: str, item: CommandEffect) -> None:
    """A bent steering made each decision three times as slow: the step was no straight line any more."""
    own = {p.name: Setting(0.4 * p.low + 0.6 * p.high, free=True) for p in item.parameters}  # far from doing nothing
    model = load_model(robot).with_effect(item, own)
    model.write_straight()
    step, tangent = model.straight(model.period), model.straight_tangent()
    assert step is not None
    assert tangent is not None
    generator = np.random.default_rng(7)
    for _ in range(50):
        state, action, latent = drawn(model, generator)
        wanted = reference(model, state, action, latent)
        assert step(state, action, latent, 0.0) == wanted
        arrays = np.array(state), np.array(action)
        after, memory = model.advance(*arrays, (), np.array(latent))
        assert after.tolist() == wanted
        assert memory == ()
        value, slopes = tangent(state, action, latent, 0.0)
        assert value == wanted
        moved = PhysicsModel(model.base, model.effects, model.settings, model.period)  # nothing recorded yet
        f, g = moved.affine(arrays[0], np.array(latent), around=arrays[1])
        np.testing.assert_allclose(slopes, g, rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(f + g @ arrays[1], wanted, rtol=1e-12, atol=1e-12)


def test_nothing_is_pending_and_an_action_acts_at_once() -> None:
    model = load_model("car").with_effect(effect("car", "steering_offset"), {"angle": Setting(0.1)})
    assert model.initial_memory(np.array([1.0, 0.2])) == ()
    prediction = Prediction.of_model(model)
    assert not prediction.remembers
    assert prediction.begin((0.0,) * 4, None, ()) is None
    assert model.felt([1.0, 0.2], (), period=0.05) == ([1.0, 0.2 + 0.1], ())


def test_with_an_effect_that_remembers_both_are_applied_in_their_order() -> None:
    """The lag comes before the offset: what is felt is the mean of the way to the command, and the offset on top."""
    late = load_model("car").with_effect(effect("car", "steering_lag"), {"time_constant": Setting(0.1)})
    both = late.with_effect(effect("car", "steering_offset"), {"angle": Setting(0.1)})
    rest = np.array([1.0, 0.0])
    assert both.straight(both.period) is None
    (alone,) = late.initial_memory(rest)
    assert both.initial_memory(rest) in ((alone, None), (None, alone + 0.1))
    felt, remembered = both.felt([1.0, 0.2], both.initial_memory(rest), period=0.05)
    expected, _ = late.felt([1.0, 0.2], late.initial_memory(rest), period=0.05)
    assert felt[1] == pytest.approx(expected[1] + 0.1)
    assert len(remembered) == 2


class Twice(CommandEffect):
    """A user's own, which no recording sees: felt steer = 2 steer."""

    name = "twice"
    robot = "car"
    stage = Stage.COMMAND_SCALE
    equation = "steer_felt = 2 steer"
    parameters = (Parameter("factor", "1", 0.0, 3.0, 2.0),)
    signature = "none"
    source = "this test"

    def transform(
        self, action: Named, memory: Any, parameters: Named, period: float, operations: Operations
    ) -> tuple[Named, Any]:
        del period, operations
        assert memory is None
        return {**action, "steer": action["steer"] * parameters["factor"]}, memory


def test_of_a_users_own_the_same_holds_without_a_recording() -> None:
    plain = load_model("car")
    model = plain.with_effect(Twice(), {"factor": Setting(2.0)})
    model.write_straight()
    assert model.straight(model.period) is None
    assert model.initial_memory(np.array([1.0, 0.1])) == ()
    state = np.array([0.1, -0.2, 0.3, 0.8])
    after, memory = model.advance(state, np.array([1.0, 0.1]), ())
    assert after.tolist() == plain.advance(state, np.array([1.0, 0.2]), ())[0].tolist()
    assert memory == ()
