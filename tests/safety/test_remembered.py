"""Caches of h, the history of commands in flight, and the rehearsal before a drive."""

import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from tests.safety.node_steps import CAR, SETTINGS, latent_at, scripted_node, stamp, state_at

from safedpa.bus import LATENT, NOMINAL, VERDICT, NominalMessage, VerdictMessage
from safedpa.dynamics import PhysicsModel, Setting, load_model
from safedpa.effects import effect
from safedpa.robots.car.barriers.obstacles import car_barriers
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety import FilterSettings, SafetyFilter, Status, Verdict
from safedpa.safety.barriers.base import Barriers, CachingBarrierSet
from safedpa.safety.barriers.cache import BarrierValueCache
from safedpa.safety.barriers.stack import make_barrier_set
from safedpa.safety.prediction.command_history import CommandHistory
from safedpa.safety.prediction.dead_time import MAX_PERIODS, ActuatorModel

FOOTPRINT = (0.08, 0.40, 0.12)
PARTS = car_barriers(FilterSettings.for_robot("car"), FOOTPRINT, [(1.0, 1.0, 0.2)], (-4.0, 4.0, -4.0, 4.0))


class Counting:
    """Barriers whose h is the state itself."""

    def __init__(self) -> None:
        self.asked: list[tuple[float, ...]] = []

    def h_floats(self, state: Sequence[float]) -> list[float]:
        self.asked.append(tuple(state))
        return list(state)


def test_eight_states_are_remembered_and_the_oldest_is_forgotten() -> None:
    counting = Counting()
    known = BarrierValueCache(counting)
    states = [(float(index), 0.0) for index in range(8)]
    for state in (*states, *states):
        assert known.h_floats(state) == list(state)
        assert known.h_floats(list(state)) is known.h_floats(state)
    assert counting.asked == states
    known.h_floats((8.0, 0.0))
    known.h_floats(states[1])
    assert len(counting.asked) == 9
    known.h_floats(states[0])
    assert len(counting.asked) == 10


def test_states_that_begin_alike_are_distinguished() -> None:
    counting = Counting()
    known = BarrierValueCache(counting)
    for state in ((1.0, 0.0), (1.0, 2.0), (0.0, 2.0), (3.0,), (1.0, 2.0)):
        assert known.h_floats(state) == list(state)
    assert len(counting.asked) == 4


def test_threads_that_share_barriers_never_get_the_h_of_another_state() -> None:
    """One state in the place of another has that other's h nowhere in between, however threads take turns."""
    known, wrong = BarrierValueCache(Counting()), list[tuple[float, ...]]()

    def asks(seed: int) -> None:
        random = np.random.default_rng(seed)
        for value in random.integers(0, 12, 20_000).tolist():
            state = (float(value), float(seed % 2))
            if known.h_floats(state) != list(state):
                wrong.append(state)

    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(4) as threads:
            list(threads.map(asks, range(4)))
    finally:
        sys.setswitchinterval(before)
    assert wrong == []


def test_the_shortest_way_gives_what_the_stack_gives() -> None:
    stack = make_barrier_set(PARTS)
    assert stack.scalar_rows(4) is stack.scalar_rows(4)
    reference = Barriers(PARTS)
    assert reference.scalar_rows(4) is reference
    for state in ((0.1, 0.2, 0.3, 0.4), (0.1, 0.2, 0.3, 0.4, 9.0)):
        for one in (stack, CachingBarrierSet(stack)):
            plain = one.scalar_rows(len(state))
            assert plain.h_floats(state) == stack.h_floats(state) == one.h_floats(state)
            rows = range(len(stack.names))
            assert list(map(tuple, plain.grad_h_floats(state, rows))) == list(
                map(tuple, stack.grad_h_floats(state, rows))
            )
            assert plain.grad_bound(state) == stack.grad_bound(state)
        np.testing.assert_allclose(stack.h_floats(state), reference.h_floats(state), rtol=0.0, atol=1e-12)


def test_distances_as_large_and_as_small_as_floats_can_be() -> None:
    """There their squares are infinite or nothing."""
    stack = make_barrier_set(car_barriers(FilterSettings.for_robot("car"), FOOTPRINT, [(0.0, 0.0, 0.0)]))
    for state in ((1e200, 0.0, 0.0, 0.0), (-1e200, 1e180, 0.3, 0.0), (0.0, 1e-200, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)):
        reference = stack.sequential.h_floats(state)
        np.testing.assert_allclose(stack.h_floats(state), reference, rtol=1e-12)
        np.testing.assert_allclose(
            stack.grad_h_floats(state, [0]), stack.sequential.grad_h_floats(state, [0]), atol=1e-12
        )


def test_a_verdict_has_all_its_fields() -> None:
    safe = SafetyFilter.for_model(load_model("car"), FilterSettings.for_robot("car"), PARTS)
    for verdict in (safe.decide([0.0, 0.0, 0.0, 0.5], [0.5, 0.0], [0.5, 0.5]), safe.decide(None, None, None)):
        assert list(vars(verdict)) == [field.name for field in fields(Verdict)]
        assert Verdict(**vars(verdict)).as_dict() == verdict.as_dict()


@pytest.fixture
def verdicts(monkeypatch: pytest.MonkeyPatch) -> list[Verdict]:
    """What every filter decides from now on."""
    notice: list[Verdict] = []
    decide = SafetyFilter.decide

    def noted(self: SafetyFilter, *given: Any, **known: Any) -> Verdict:
        notice.append(decide(self, *given, **known))
        return notice[-1]

    monkeypatch.setattr(SafetyFilter, "decide", noted)
    return notice


def step(node: SafetyFilterNode, tick: int, robot: str = "r", **changed: Any) -> VerdictMessage:
    state = state_at(tick, **{"obstacles": ((1.0, 0.2, 0.2),), "period": 0.005, **changed})
    nominal = NominalMessage(**stamp(state), values=(1.0, 0.0), controller="test")
    node.step(robot, state, {LATENT: latent_at(state), NOMINAL: nominal})
    verdict = node.afterwards(robot)[VERDICT]
    assert isinstance(verdict, VerdictMessage)
    return verdict


@pytest.mark.parametrize(
    ("period", "relaxed"),
    [(0.05, [False, True, False, *[False] * 4]), (0.005, [False, True, False, True, *[False] * 4])],
)
def test_robots_of_one_model_rehearse_the_search_for_the_least_violation_once(verdicts, period, relaxed):
    """Two hundred that come at once would otherwise wait for one another; over another period each rehearses once."""
    node = scripted_node(CAR, SETTINGS)
    for tick in range(3):
        for robot in ("r", "s"):
            assert step(node, tick, robot, period=period).status != "relaxed"
    assert [verdict.status is Status.relaxed for verdict in verdicts] == relaxed


def test_a_rehearsal_that_fails_costs_no_verdict_and_is_not_repeated(monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[object] = []

    def fails(model: object) -> None:
        tried.append(model)
        raise RuntimeError("cannot be written down")

    monkeypatch.setattr(PhysicsModel, "record_scalar_step", fails)
    node = scripted_node(CAR, SETTINGS)
    assert step(node, 0).status == "passed"
    before = len(tried)
    assert [step(node, tick).status for tick in range(1, 4)] == ["passed"] * 3
    assert len(tried) == before >= 1


def test_nothing_is_rehearsed_where_nothing_is_decided_and_a_rehearsal_changes_no_later_decision(verdicts):
    node = scripted_node(CAR, SETTINGS)
    assert step(node, 0, values=(0.0, 0.0, 0.0)).status == "fallback", "a state of another size"
    assert len(verdicts) == 1
    step(node, 1)
    assert [verdict.status is Status.relaxed for verdict in verdicts] == [False, False, True]
    # At the model's own period one robot rehearses for all: the second robot's filter has not.
    node = scripted_node(CAR, SETTINGS)
    for tick in range(3):
        one, other = (step(node, tick, robot, period=0.05) for robot in ("r", "s"))
        for name in ("status", "action", "slack", "h_next", "margin", "predicted", "sentence"):
            assert getattr(one, name) == getattr(other, name)


LATENTS = tuple(CAR.latent.tolist())
PERIOD = CAR.period
DELAYED = CAR.with_effect(effect("car", "actuator_delay"), {"seconds": Setting(0.15)})
LAGGING = CAR.with_effect(effect("car", "steering_lag"), {"time_constant": Setting(0.12)})


def commands(count: int) -> list[tuple[float, float]]:
    random = np.random.default_rng(5)
    return [(float(drive), float(steer)) for drive, steer in random.uniform((0.0, -0.3), (2.0, 0.3), (count, 2))]


def followed(model: PhysicsModel, until_action: float, ticks: int) -> tuple[CommandHistory, list[tuple[float, ...]]]:
    """A trail of a robot whose action of tick i is in force from ``until_action`` after the state i, and its states."""
    history, states = CommandHistory(model), []
    sent = commands(ticks)
    latent = np.array(LATENTS)
    begin = np.array((0.0, 0.0, 0.2, 0.5))
    real = model.initial_memory(np.zeros(2), latent)
    memory = model.initial_memory(np.zeros(2), latent)
    for tick in range(ticks):
        applied = sent[tick - 1] if tick else (0.0, 0.0)
        if tick:
            memory = model.felt(applied, memory, LATENTS, period=PERIOD)[1]
        states.append(tuple(begin.tolist()))
        history.add(tick, states[-1], applied, memory)
        history.mark_decided(LATENTS)
        for start in np.arange(0.0, PERIOD, 0.01):  # in pieces of 10 ms, whatever is in force there
            number = int(np.floor((tick * PERIOD + start - until_action) / PERIOD + 1e-9))
            command = sent[number] if number >= 0 else (0.0, 0.0)
            begin, real = model.advance(begin, np.array(command), real, latent, period=0.01)
    return history, states


@pytest.mark.parametrize("model", [CAR, DELAYED, LAGGING], ids=["plain", "delayed", "lagging"])
@pytest.mark.parametrize("until_action", [0.0, 0.03, 0.05, 0.12])
def test_a_prediction_past_the_dead_time_comes_true(model: PhysicsModel, until_action: float) -> None:
    history, states = followed(model, until_action, 14)
    delayed_prediction = history.delayed_prediction(until_action)
    if model is CAR and until_action == 0.0:
        assert delayed_prediction is None
        return
    assert delayed_prediction is not None
    assert delayed_prediction.measured_prev == states[-2]
    np.testing.assert_allclose(delayed_prediction.predicted_prev, states[-2], atol=2e-3)
    np.testing.assert_allclose(delayed_prediction.predicted, states[-1], atol=2e-3)
    assert np.abs(np.array(states[-1]) - states[-2]).max() > 0.02


@pytest.mark.parametrize("until_action", [0.03, 0.05, 0.12])
def test_the_state_is_taken_to_where_the_action_is_put_in_force_and_the_next_ones_expected_there(until_action: float):
    history, states = followed(CAR, until_action, 10)
    pending = history.pending(until_action)
    assert sum(seconds for _, seconds in pending.queue) == pytest.approx(until_action)
    assert pending.last == commands(10)[-2]
    begin = ActuatorModel(CAR).effect_start(states[-1], LATENTS, pending)
    assert begin is not None
    whole = int(until_action / PERIOD + 1e-9)
    longer = followed(CAR, until_action, 11 + whole)[1]
    state, rest = np.array(longer[9 + whole]), until_action - whole * PERIOD
    if rest > 1e-9:
        state = CAR.advance(state, np.array(commands(10)[-2]), (), np.array(LATENTS), period=rest)[0]
    np.testing.assert_allclose(begin.state, state, atol=2e-3)
    history, states = followed(DELAYED, until_action, 10)
    later = followed(DELAYED, until_action, 12)[1]
    assert later[:10] == states
    rows = history.predict(commands(10)[-1], LATENTS, history.pending(until_action), 1)
    np.testing.assert_allclose(rows, [later[10]], atol=2e-3)


def test_after_a_gap_nothing_is_known_of_before() -> None:
    history, _ = followed(DELAYED, 0.0, 8)
    assert history.delayed_prediction(0.0) is not None
    memory = DELAYED.initial_memory(np.zeros(2), np.array(LATENTS))
    history.add(20, (0.0, 0.0, 0.0, 0.0), (0.0, 0.0), memory)
    history.mark_decided(LATENTS)
    assert history.delayed_prediction(0.0) is None
    assert history.pending(0.12).queue == (
        ((0.0, 0.0), pytest.approx(0.02)),
        ((0.0, 0.0), PERIOD),
        ((0.0, 0.0), PERIOD),
    )


def test_a_state_that_nothing_was_decided_at_says_nothing() -> None:
    history = CommandHistory(DELAYED)
    memory = DELAYED.initial_memory(np.zeros(2), np.array(LATENTS))
    for tick in range(9):
        history.add(tick, (0.0, 0.0, 0.0, 0.0), (0.0, 0.0), memory)
    assert history.delayed_prediction(0.0) is None


def test_the_earlier_commands_come_in_order_and_none_after_a_gap() -> None:
    assert CommandHistory(CAR).commands(3, (9.0, 0.0)) == [(9.0, 0.0)]
    history = CommandHistory(CAR)
    for tick in range(5):
        history.add(tick, (0.0, 0.0, 0.0, 0.0), (float(tick), 0.0), ())
    first = [(float(tick), 0.0) for tick in range(5)]
    assert history.commands(5, (9.0, 0.0)) == [*first, (9.0, 0.0)]
    assert history.commands(4, (9.0, 0.0)) == [*first[:4], (9.0, 0.0)], "the newest tick's own is given"
    for tick in (6, 3):
        assert history.commands(tick, (9.0, 0.0)) == [(9.0, 0.0)]


def test_as_much_is_remembered_as_the_longest_dead_time_and_the_oldest_state_need() -> None:
    history = CommandHistory(CAR)
    for tick in range(300):
        history.add(tick, (0.0, 0.0, 0.0, 0.0), (float(tick), 0.0), ())
    assert len(history.commands(300, (0.0, 0.0))) == MAX_PERIODS + 20 + 2 + 1, (
        "a second at 20 Hz, both ends, and the new one"
    )


def test_what_is_expected_goes_on_under_the_newest_action() -> None:
    """It is in force from 0.12 s after its state on: from the third row on, and for as long as is asked."""
    history, _ = followed(DELAYED, 0.12, 10)
    later = followed(DELAYED, 0.12, 14)[1]
    rows = history.predict(commands(10)[-1], LATENTS, history.pending(0.12), 3)
    np.testing.assert_allclose(rows, later[10:13], atol=2e-3)
    assert history.predict(commands(10)[-1], None, history.pending(0.12), 3) == rows, "the model's own latent"


@pytest.mark.parametrize(("until_action", "ticks"), [(0.0, 5), (0.05, 7), (0.12, 11)])
def test_a_prediction_is_compared_with_the_measurement_as_soon_as_possible(until_action: float, ticks: int) -> None:
    """The dead time of 3 periods, the two newest states, and twice the age: of the state, and of what was in force."""
    assert followed(DELAYED, until_action, ticks)[0].delayed_prediction(until_action) is not None
    assert followed(DELAYED, until_action, ticks - 1)[0].delayed_prediction(until_action) is None


def elsewhere(far: range, undecided: int = -1, latent: tuple[float, ...] = LATENTS) -> CommandHistory:
    """Nine ticks of a robot that drives straight on; in those of ``far`` it is measured 100 m away."""
    history = CommandHistory(DELAYED)
    memory = DELAYED.initial_memory(np.array((1.0, 0.0)), np.array(LATENTS))
    for tick in range(9):
        history.add(tick, (0.05 * tick + 100.0 * (tick in far), 0.0, 0.0, 1.0), (1.0, 0.0), memory)
        if tick != undecided:
            history.mark_decided(latent)
    return history


def test_a_prediction_begins_where_the_dead_time_began_and_not_before() -> None:
    for far, away in ((range(4), False), (range(4, 5), True), (range(5, 8), False)):
        delayed_prediction = elsewhere(far).delayed_prediction(0.0)
        assert delayed_prediction is not None
        assert (delayed_prediction.predicted[0] > 50.0) == away


@pytest.mark.parametrize(("undecided", "known"), [(7, False), (4, False), (6, True), (8, True), (3, True)])
def test_both_ends_of_a_prediction_were_decided_at(undecided: int, known: bool) -> None:
    assert (elsewhere(range(0), undecided).delayed_prediction(0.0) is not None) == known


def test_a_prediction_takes_the_latent_of_its_own_decision() -> None:
    heavy = tuple(value + 0.5 for value in LATENTS)
    light, loaded = (
        elsewhere(range(0)).delayed_prediction(0.0),
        elsewhere(range(0), latent=heavy).delayed_prediction(0.0),
    )
    assert light is not None
    assert loaded is not None
    start = np.array((0.2, 0.0, 0.0, 1.0))
    for delayed_prediction, latent in ((light, LATENTS), (loaded, heavy)):
        memory = DELAYED.initial_memory(np.array((1.0, 0.0)), np.array(LATENTS))
        state = start
        for _ in range(4):
            state, memory = DELAYED.advance(state, np.array((1.0, 0.0)), memory, np.array(latent), period=PERIOD)
        np.testing.assert_allclose(delayed_prediction.predicted, state, atol=1e-12)
    assert abs(light.predicted[0] - loaded.predicted[0]) > 1e-5


@pytest.mark.parametrize("count", [2, 3, 5, 9])
def test_a_period_comes_with_the_earlier_commands_and_the_memory_of_then(count: int) -> None:
    """Command by command, the newest first; before the first tick that of the first was always in force."""
    history = CommandHistory(CAR)
    for tick in range(count):
        history.add(tick, (float(tick),) * 4, (0.1 * tick, 0.0), f"after {tick}")
        assert (history.last_transition(3) is None) == (tick == 0)
    found = history.last_transition(3)
    assert found is not None
    assert (found.before, found.now) == ((count - 2.0,) * 4, (count - 1.0,) * 4)
    wanted = [((0.1 * tick, 0.0), f"after {tick - 1}") for tick in range(count - 1, 0, -1)]
    wanted += [((0.0, 0.0), "after 0")] * 4
    assert list(found.commands) == wanted[:4]


@pytest.mark.parametrize(("seconds", "known"), [(0.05, 2), (0.09, 2), (0.11, 1), (-0.05, 1), (0.0, 1)])
def test_ticks_that_follow_each_other_but_are_apart_in_time_are_a_gap(seconds: float, known: int) -> None:
    history = CommandHistory(CAR)
    history.add(0, (0.0, 0.0, 0.0, 0.5), (1.0, 0.0), (), 7.0)
    history.add(1, (0.0, 0.0, 0.0, 0.5), (2.0, 0.0), (), 7.0 + seconds)
    assert len(history.commands(2, (3.0, 0.0))) == known + 1
