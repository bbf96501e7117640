"""What is on its way at an old state, and predictions past a dead time, against a robot that is the model itself."""

from __future__ import annotations

import numpy as np
import pytest

from safedpa.dynamics import PhysicsModel, Setting, load_model
from safedpa.effects import effect
from safedpa.safety.on_its_way import LONGEST, Actuators
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


def test_the_earlier_commands_come_in_order_and_none_after_a_gap() -> None:
    assert Trail(CAR).commands(3, (9.0, 0.0)) == [(9.0, 0.0)]
    trail = Trail(CAR)
    for tick in range(5):
        trail.add(tick, (0.0, 0.0, 0.0, 0.0), (float(tick), 0.0), ())
    first = [(float(tick), 0.0) for tick in range(5)]
    assert trail.commands(5, (9.0, 0.0)) == [*first, (9.0, 0.0)]
    assert trail.commands(4, (9.0, 0.0)) == [*first[:4], (9.0, 0.0)], "the newest tick's own is given"
    for tick in (6, 3):
        assert trail.commands(tick, (9.0, 0.0)) == [(9.0, 0.0)]


def test_as_much_is_remembered_as_the_longest_dead_time_and_the_oldest_state_need() -> None:
    trail = Trail(CAR)
    for tick in range(300):
        trail.add(tick, (0.0, 0.0, 0.0, 0.0), (float(tick), 0.0), ())
    assert len(trail.commands(300, (0.0, 0.0))) == LONGEST + 20 + 2 + 1, "a second at 20 Hz, both ends, and the new one"


def test_what_is_expected_goes_on_under_the_newest_action() -> None:
    """It is in force from 0.12 s after its state on: from the third row on, and for as long as is asked."""
    trail, _ = followed(DELAYED, 0.12, 10)
    later = followed(DELAYED, 0.12, 14)[1]
    rows = trail.expected(commands(10)[-1], LATENT, trail.pending(0.12), 3)
    np.testing.assert_allclose(rows, later[10:13], atol=2e-3)
    assert trail.expected(commands(10)[-1], None, trail.pending(0.12), 3) == rows, "the model's own latent"


@pytest.mark.parametrize(("until_action", "ticks"), [(0.0, 5), (0.05, 7), (0.12, 11)])
def test_a_prediction_is_compared_with_the_measurement_as_soon_as_possible(until_action: float, ticks: int) -> None:
    """The dead time of 3 periods, the two newest states, and twice the age: of the state, and of what was in force."""
    assert followed(DELAYED, until_action, ticks)[0].foretold(until_action) is not None
    assert followed(DELAYED, until_action, ticks - 1)[0].foretold(until_action) is None


def elsewhere(far: range, undecided: int = -1, latent: tuple[float, ...] = LATENT) -> Trail:
    """Nine ticks of a robot that drives straight on; in those of ``far`` it is measured 100 m away."""
    trail = Trail(DELAYED)
    memory = DELAYED.initial_memory(np.array((1.0, 0.0)), np.array(LATENT))
    for tick in range(9):
        trail.add(tick, (0.05 * tick + 100.0 * (tick in far), 0.0, 0.0, 1.0), (1.0, 0.0), memory)
        if tick != undecided:
            trail.decided(latent)
    return trail


def test_a_prediction_begins_where_the_dead_time_began_and_not_before() -> None:
    for far, away in ((range(4), False), (range(4, 5), True), (range(5, 8), False)):
        foretold = elsewhere(far).foretold(0.0)
        assert foretold is not None
        assert (foretold.hoped[0] > 50.0) == away


@pytest.mark.parametrize(("undecided", "known"), [(7, False), (4, False), (6, True), (8, True), (3, True)])
def test_both_ends_of_a_prediction_were_decided_at(undecided: int, known: bool) -> None:
    assert (elsewhere(range(0), undecided).foretold(0.0) is not None) == known


def test_a_prediction_takes_the_latent_of_its_own_decision() -> None:
    heavy = tuple(value + 0.5 for value in LATENT)
    light, loaded = elsewhere(range(0)).foretold(0.0), elsewhere(range(0), latent=heavy).foretold(0.0)
    assert light is not None
    assert loaded is not None
    start = np.array((0.2, 0.0, 0.0, 1.0))
    for foretold, latent in ((light, LATENT), (loaded, heavy)):
        memory = DELAYED.initial_memory(np.array((1.0, 0.0)), np.array(LATENT))
        state = start
        for _ in range(4):
            state, memory = DELAYED.advance(state, np.array((1.0, 0.0)), memory, np.array(latent), period=PERIOD)
        np.testing.assert_allclose(foretold.hoped, state, atol=1e-12)
    assert abs(light.hoped[0] - loaded.hoped[0]) > 1e-5


@pytest.mark.parametrize("count", [2, 3, 5, 9])
def test_a_period_comes_with_the_earlier_commands_and_the_memory_of_then(count: int) -> None:
    """Command by command, the newest first; before the first tick that of the first was always in force."""
    trail = Trail(CAR)
    for tick in range(count):
        trail.add(tick, (float(tick),) * 4, (0.1 * tick, 0.0), f"after {tick}")
        assert (trail.passed(3) is None) == (tick == 0)
    found = trail.passed(3)
    assert found is not None
    assert (found.before, found.now) == ((count - 2.0,) * 4, (count - 1.0,) * 4)
    wanted = [((0.1 * tick, 0.0), f"after {tick - 1}") for tick in range(count - 1, 0, -1)]
    wanted += [((0.0, 0.0), "after 0")] * 4
    assert list(found.commands) == wanted[:4]
