"""Lags and delays along whole stretches agree with the effects' own row by row."""

from __future__ import annotations

import numpy as np
import pytest

from safedpa.diagnosis.actuators import felt_at_once
from safedpa.diagnosis.rollout import _followed
from safedpa.diagnosis.windows import windows_of
from safedpa.dynamics import load_model
from safedpa.effects import effect
from safedpa.records.run import Run, Stretch


@pytest.mark.parametrize("jitter", [0.0, 0.6])
@pytest.mark.parametrize("value", [0.0, 0.013, 0.05, 0.17, 0.43])
@pytest.mark.parametrize("name", ["steering_delay", "drive_delay", "actuator_delay", "steering_lag", "drive_lag"])
def test_fast_is_exact(plain, drive, name, value, jitter):
    run = drive(plain, 12.0, jitter=jitter, stretches=[(0, 100), (100, 101), (130, 240)])
    windows = windows_of([run], 0.5)
    columns = {key: windows.actions[:, index] for index, key in enumerate(windows.system.action_names)}
    command = effect("car", name)
    own = {command.parameters[0].name: value}
    fast, slow = felt_at_once(command, columns, own, windows), _followed(command, columns, own, windows)
    assert set(fast) == set(slow)
    for key, column in slow.items():
        np.testing.assert_allclose(fast[key], column, atol=1e-9)


@pytest.mark.parametrize("width", [0.0, 0.02, 0.4, 10.0])
def test_play_at_once_is_play_row_by_row(width):
    model = load_model("dfki_pendulum")
    random = np.random.default_rng(3)
    torque = np.cumsum(random.normal(0.0, 0.1, 400))
    states = np.column_stack([np.zeros(400), random.normal(0.0, 1.0, 400)])
    stretches = (Stretch(0, 150), Stretch(150, 160), Stretch(200, 400))
    run = Run("play", model.system, 0.01 * np.arange(400), states, torque[:, None], stretches)
    windows = windows_of([run], 0.05)
    columns = {"torque": windows.actions[:, 0]}
    command, own = effect("pendulum", "backlash"), {"width": width}
    fast, slow = felt_at_once(command, columns, own, windows), _followed(command, columns, own, windows)
    np.testing.assert_array_equal(fast["torque"], slow["torque"])


def test_other_effects_follow_their_own_equations(plain, drive):
    windows = windows_of([drive(plain, 5.0)], 0.5)
    columns = {"throttle": windows.actions[:, 0], "steer": windows.actions[:, 1]}
    assert felt_at_once(effect("car", "drive_dead_zone"), columns, {"width": 0.1}, windows) is None
