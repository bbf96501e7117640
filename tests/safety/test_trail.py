"""What is on its way at an old state, and predictions past a dead time, against a robot that is the model itself."""

from __future__ import annotations

import numpy as np
import pytest

from safedpa.dynamics import PhysicsModel, Setting, load_model
from safedpa.effects import effect
from safedpa.safety.on_its_way import Actuators
from safedpa.safety.trail import Trail

CAR = load_model("car")
LATENT = tuple(CAR.latent.tolist())
PERIOD = CAR.period
DELAYED = CAR.with_effect(effect("car", "actuator_delay"), {"seconds": Setting(0.15)})
LAGGING = CAR.with_effect(effect("car", "steering_lag"), {"time_constant": Setting(0.12)})


def commands(count: int) -> list[tuple[float, float]]:
    random = np.random.default_rng(5)
    return [(float(drive), float(steer)) for drive, steer in random.uniform((0.0, -0.3), (2.0, 0.3), (count, 2))]


def followed(model: PhysicsModel, until_action: float, ticks: int) -> tuple[Trail, list[tuple[float, ...]]]:
    """A trail of a robot whose action of tick i is in force from ``until_action`` after the state i, and its states."""
    trail, states = Trail(model), []
    sent = commands(ticks)
    latent = np.array(LATENT)
    begin = np.array((0.0, 0.0, 0.2, 0.5))
    real = model.initial_memory(np.zeros(2), latent)
    memory = model.initial_memory(np.zeros(2), latent)
    for tick in range(ticks):
        applied = sent[tick - 1] if tick else (0.0, 0.0)
        if tick:
            memory = model.felt(applied, memory, LATENT, period=PERIOD)[1]
        states.append(tuple(begin.tolist()))
        trail.add(tick, states[-1], applied, memory)
        trail.decided(LATENT)
        for start in np.arange(0.0, PERIOD, 0.01):  # in pieces of 10 ms, whatever is in force there
            number = int(np.floor((tick * PERIOD + start - until_action) / PERIOD + 1e-9))
            command = sent[number] if number >= 0 else (0.0, 0.0)
            begin, real = model.advance(begin, np.array(command), real, latent, period=0.01)
    return trail, states


@pytest.mark.parametrize("model", [CAR, DELAYED, LAGGING], ids=["plain", "delayed", "lagging"])
@pytest.mark.parametrize("until_action", [0.0, 0.03, 0.05, 0.12])
def test_a_prediction_past_the_dead_time_comes_true(model: PhysicsModel, until_action: float) -> None:
    trail, states = followed(model, until_action, 14)
    foretold = trail.foretold(until_action)
    if model is CAR and until_action == 0.0:
        assert foretold is None
        return
    assert foretold is not None
    assert foretold.before == states[-2]
    np.testing.assert_allclose(foretold.hoped_before, states[-2], atol=2e-3)
    np.testing.assert_allclose(foretold.hoped, states[-1], atol=2e-3)
    assert np.abs(np.array(states[-1]) - states[-2]).max() > 0.02


@pytest.mark.parametrize("until_action", [0.03, 0.05, 0.12])
def test_the_state_is_taken_to_where_the_action_is_put_in_force(until_action: float) -> None:
    trail, states = followed(CAR, until_action, 10)
    pending = trail.pending(until_action)
    assert sum(seconds for _, seconds in pending.sent) == pytest.approx(until_action)
    assert pending.held == commands(10)[-2]
    begin = Actuators(CAR).begin(states[-1], LATENT, pending)
    assert begin is not None
    whole = int(until_action / PERIOD + 1e-9)
    longer = followed(CAR, until_action, 11 + whole)[1]
    state, rest = np.array(longer[9 + whole]), until_action - whole * PERIOD
    if rest > 1e-9:
        state = CAR.advance(state, np.array(commands(10)[-2]), (), np.array(LATENT), period=rest)[0]
    np.testing.assert_allclose(begin.state, state, atol=2e-3)


@pytest.mark.parametrize("until_action", [0.03, 0.05, 0.12])
def test_the_next_states_are_expected_under_what_is_in_force_then(until_action: float) -> None:
    trail, states = followed(DELAYED, until_action, 10)
    later = followed(DELAYED, until_action, 12)[1]
    assert later[:10] == states
    rows = trail.expected(commands(10)[-1], LATENT, trail.pending(until_action), 1)
    np.testing.assert_allclose(rows, [later[10]], atol=2e-3)


def test_after_a_gap_nothing_is_known_of_before() -> None:
    trail, _ = followed(DELAYED, 0.0, 8)
    assert trail.foretold(0.0) is not None
    memory = DELAYED.initial_memory(np.zeros(2), np.array(LATENT))
    trail.add(20, (0.0, 0.0, 0.0, 0.0), (0.0, 0.0), memory)
    trail.decided(LATENT)
    assert trail.foretold(0.0) is None
    assert trail.pending(0.12).sent == (((0.0, 0.0), pytest.approx(0.02)), ((0.0, 0.0), PERIOD), ((0.0, 0.0), PERIOD))


def test_a_state_that_nothing_was_decided_at_says_nothing() -> None:
    trail = Trail(DELAYED)
    memory = DELAYED.initial_memory(np.zeros(2), np.array(LATENT))
    for tick in range(9):
        trail.add(tick, (0.0, 0.0, 0.0, 0.0), (0.0, 0.0), memory)
    assert trail.foretold(0.0) is None
