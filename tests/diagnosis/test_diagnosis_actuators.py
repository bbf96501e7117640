"""Lags and delays along whole stretches agree with the effects' own row by row."""

from __future__ import annotations

import numpy as np
import pytest

from safedpa.compare.actuators import felt_at_once
from safedpa.compare.rollout import felt_actions
from safedpa.compare.windows import windows_of
from safedpa.dynamics import Setting, load_model
from safedpa.effects import CommandEffect, effect, effects_of, robots
from safedpa.effects.general import general_effects
from safedpa.operations import FLOATS
from safedpa.records.run import Run, Stretch
from safedpa.robot import robot_named


def row_by_row(command, columns, own, windows):
    """The felt columns by the effect's own equations, one row after the other in each stretch."""
    felt = {name: np.zeros(len(column)) for name, column in columns.items()}
    for begin, stop in windows.bounds.tolist():
        memory = None
        for row in range(begin, stop):
            action = {name: float(column[row]) for name, column in columns.items()}
            memory = command.initial_memory(action) if row == begin else memory
            out, memory = command.transform(action, memory, own, float(windows.period[row]), FLOATS)
            for name, column in felt.items():
                column[row] = out[name]
    return felt


@pytest.mark.parametrize("jitter", [0.0, 0.6])
@pytest.mark.parametrize("value", [0.0, 0.013, 0.05, 0.17, 0.43])
@pytest.mark.parametrize("name", ["steering_delay", "drive_delay", "actuator_delay", "steering_lag", "drive_lag"])
def test_lags_and_delays_of_whole_stretches_are_exact(plain, drive, name, value, jitter):
    run = drive(plain, 12.0, jitter=jitter, stretches=[(0, 100), (100, 101), (130, 240)])
    windows = windows_of([run], 0.5)
    columns = {key: windows.actions[:, index] for index, key in enumerate(windows.system.action_names)}
    command = effect("car", name)
    own = {command.parameters[0].name: value}
    fast, slow = felt_at_once(command, columns, own, windows), row_by_row(command, columns, own, windows)
    assert set(fast) == set(slow)
    for key, column in slow.items():
        np.testing.assert_allclose(fast[key], column, atol=1e-9)


def _remembering(robot):
    """The robot's own effects that remember commands, and those that every system has, by name."""
    system = robot_named(robot).system
    zero = dict.fromkeys(system.action_names, 0.0)
    every = {item.name: item for item in (*general_effects(system), *effects_of(robot).values())}
    commands = [item for item in every.values() if isinstance(item, CommandEffect)]
    return [item for item in commands if item.initial_memory(zero) is not None]


@pytest.mark.parametrize("robot", robots())
def test_the_actuators_of_every_robot_are_exact(robot):
    system = robot_named(robot).system
    random = np.random.default_rng(8)
    actions = np.cumsum(random.normal(0.0, 0.1, (200, len(system.action))), axis=0)
    run = Run("own", system, 0.05 * np.arange(200), np.zeros((200, len(system.state))), actions, (Stretch(0, 200),))
    windows = windows_of([run], 0.5)
    columns = {key: windows.actions[:, index] for index, key in enumerate(system.action_names)}
    assert _remembering(robot), "there is an effect to look at"
    for command in _remembering(robot):
        own = {parameter.name: 1.3 * parameter.typical for parameter in command.parameters}
        fast, slow = felt_at_once(command, columns, own, windows), row_by_row(command, columns, own, windows)
        assert fast is not None, f"{command.name} is followed row by row"
        for key, column in slow.items():
            np.testing.assert_allclose(fast[key], column, atol=1e-9, err_msg=f"{robot} {command.name}: {key}")


@pytest.mark.parametrize("width", [0.0, 0.02, 0.4, 10.0])
def test_play_of_whole_stretches_is_exact(width):
    model = load_model("dfki_pendulum")
    random = np.random.default_rng(3)
    torque = np.cumsum(random.normal(0.0, 0.1, 400))
    states = np.column_stack([np.zeros(400), random.normal(0.0, 1.0, 400)])
    stretches = (Stretch(0, 150), Stretch(150, 160), Stretch(200, 400))
    run = Run("play", model.system, 0.01 * np.arange(400), states, torque[:, None], stretches)
    windows = windows_of([run], 0.05)
    columns = {"torque": windows.actions[:, 0]}
    command, own = effect("pendulum", "backlash"), {"width": width}
    fast, slow = felt_at_once(command, columns, own, windows), row_by_row(command, columns, own, windows)
    np.testing.assert_array_equal(fast["torque"], slow["torque"])


def test_other_effects_are_left_to_their_own_equations(plain, drive):
    windows = windows_of([drive(plain, 5.0)], 0.5)
    columns = {"throttle": windows.actions[:, 0], "steer": windows.actions[:, 1]}
    assert felt_at_once(effect("car", "drive_dead_zone"), columns, {"width": 0.1}, windows) is None


@pytest.mark.parametrize("name", ["steering_delay", "drive_lag"])
def test_an_effect_of_the_user_that_remembers_commands_acts_like_one_of_the_library(plain, drive, name):
    command = effect("car", name)
    own = object.__new__(type("Own", (type(command),), {"__module__": "users"}))
    own.__dict__.update(command.__dict__)
    windows = windows_of([drive(plain, 5.0, stretches=[(0, 40), (45, 100)])], 0.5)
    value = {command.parameters[0].name: Setting(0.17)}
    library, users = (felt_actions(plain.with_effect(item, value), windows) for item in (command, own))
    assert np.abs(library - windows.actions).max() > 0.1
    np.testing.assert_allclose(users, library, atol=1e-9)
