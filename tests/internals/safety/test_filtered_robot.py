"""What the filter keeps of one robot between two ticks."""

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.internals.safety.robot_memory import driven, reported, verdict_of
from tests.safety.node_steps import ABSENT, CAR, LATE, SETTINGS, latent_at, state_at, surroundings

from safedpa.bus import LATENT, StateMessage
from safedpa.dynamics import PhysicsModel
from safedpa.dynamics.recorded_step import rollout_held_action
from safedpa.errors import InputError
from safedpa.runtime.robot_session import RobotSession
from safedpa.runtime.scene import AbstractScene
from safedpa.safety.margins.online import OnlineMarginMonitor
from safedpa.safety.prediction.command_history import CommandHistory
from safedpa.safety.prediction.delay_estimator import DelayEstimator
from safedpa.safety.prediction.predictor import Prediction


def kept_calls(monkeypatch: pytest.MonkeyPatch, where: type, name: str, answer: Any = None) -> list[Any]:
    """What a method is called with from now on: its first argument behind self, and all by name."""
    calls: list[Any] = []

    def noted(self: Any, *arguments: Any, **named: Any) -> Any:
        del self
        calls.append(named or (arguments[0] if arguments else None))
        return answer

    monkeypatch.setattr(where, name, noted)
    return calls


def test_a_latent_that_is_a_tick_old_is_used_however_long_the_tick() -> None:
    memory = driven()
    memory.latent = latent_at(state_at(0))
    assert memory.usable_latent(state_at(1, period=2.0), {LATENT: ABSENT})[0] is not None, "1 s and half a tick"
    assert memory.usable_latent(state_at(1, period=2.1), {LATENT: ABSENT})[0] is None


@pytest.mark.parametrize(
    ("since", "tick", "waits"),
    [(-1, 0, False), (0, 0, True), (0, 20, True), (0, 21, False), (5, 4, False), (5, 25, True), (5, 26, False)],
)
def test_a_model_may_decide_for_a_second_after_another_is_in_force(since: int, tick: int, waits: bool) -> None:
    memory = driven()
    memory.changed_at = since
    assert memory.may_use_previous_model(state_at(tick)) is waits


@pytest.mark.parametrize(("before", "now"), [((), ("laser",)), (("laser",), ()), (("laser",), ("laser",)), ((), ())])
def test_a_scene_that_sensors_see_is_another_one_with_each_tick(monkeypatch, before, now):
    memory = driven()
    assert memory.decision is not None
    memory.decision = memory.decision._replace(state=replace(memory.decision.state, sources=before))
    calls = kept_calls(monkeypatch, OnlineMarginMonitor, "observe")
    memory.watch_margin(state_at(1, applied=reported(memory), sources=now))
    assert [call["same_scene"] for call in calls] == [not before and not now]


@pytest.mark.parametrize(
    ("model", "applied_by", "late"), [(LATE, "filter", True), (LATE, "watchdog", False), (CAR, "filter", True)]
)
def test_where_the_action_acts_late_the_prediction_is_of_that_moment(monkeypatch, model, applied_by, late):
    memory = driven(model)
    delayed_prediction = object()
    monkeypatch.setattr(CommandHistory, "delayed_prediction", lambda *_: delayed_prediction)
    calls = kept_calls(monkeypatch, OnlineMarginMonitor, "observe")
    memory.watch_margin(state_at(1, applied=reported(memory), applied_by=applied_by))
    assert [call["late"] for call in calls] == [delayed_prediction if late else None]


@pytest.mark.parametrize("model", [CAR, LATE])
def test_only_what_is_on_its_way_is_noted_as_decided(monkeypatch: pytest.MonkeyPatch, model: PhysicsModel) -> None:
    calls = kept_calls(monkeypatch, CommandHistory, "mark_decided")
    memory = driven(model)
    assert calls == ([tuple(model.latent.tolist())] if memory.pending else [])


class Watched:
    """A margin whose rises are noted; the rest is its own."""

    def __init__(self, own: Any, risen: list[float]) -> None:
        self.own, self.rise = own, lambda *known: risen.append(known[-1])

    def __getattr__(self, name: str) -> Any:
        return getattr(self.own, name)


def test_without_a_scene_no_margin_rises() -> None:
    """Where no h is known, more of a new margin must not come into force."""
    memory, risen = driven(ticks=3), list[float]()
    memory.margin = Watched(memory.margin, risen)
    memory.watch_margin(state_at(3))
    memory.barriers = "no goal"
    memory.watch_margin(state_at(4))
    assert risen == [0.05]


@pytest.mark.parametrize(
    ("before", "now", "again"),
    [
        ({"car": 0.01, "speed": 0.1}, {"car": 0.01, "speed": 0.1}, False),
        ({"car": 0.01, "speed": 0.1}, {"car": 0.02, "speed": 0.1}, True),
        ({"car": 0.01, "speed": 0.1}, {"car": 0.02, "speed": 0.05}, True),
        ({"car": 0.02, "speed": 0.1}, {"car": 0.01, "speed": 0.05}, False),
        ({"speed": 0.1}, {"car": 0.5, "speed": 0.1}, True),
    ],
)
def test_where_any_margin_widens_by_this_state_it_looks_around_once_more(monkeypatch, before, now, again):
    memory, state, asked_for = driven(), state_at(1, sources=("laser",), obstacles=()), list[dict[str, float]]()

    def around(_state: Any, _ahead: Any, epsilon: dict[str, float], _late: float) -> str:
        asked_for.append(epsilon)
        return f"scene {len(asked_for)}"

    def widened(self: RobotSession, _state: StateMessage) -> None:
        self.margin = SimpleNamespace(epsilon=now)  # type: ignore[assignment]

    memory.margin, memory.scene.around = SimpleNamespace(epsilon=before), around  # type: ignore[assignment,method-assign]
    monkeypatch.setattr(RobotSession, "watch_margin", widened)
    memory.observe_surroundings(state, surroundings(state))
    assert asked_for == ([before, now] if again else [before])
    assert memory.barriers == f"scene {len(asked_for)}"


def test_a_model_that_refuses_its_dead_time_has_none(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: Any) -> float:
        raise InputError("no such latent")

    monkeypatch.setattr(Prediction, "dead_time", refused)
    assert driven()._dead_time() == 0.0


def test_where_nothing_was_expected_the_command_is_felt_all_the_same() -> None:
    memory = driven(LATE)
    before, memory.expected_memory = memory.memory, None
    memory.sync_actuators(state_at(1, applied=reported(memory)))
    assert memory.memory == LATE.felt(reported(memory), before, period=0.05)[1]


def test_another_models_memory_begins_with_what_was_sent_while_the_first_was_in_force() -> None:
    former = driven(LATE, ticks=4)
    state = state_at(4, applied=reported(former))
    oldest, *sent = former.history.commands(4, state.applied) or ()
    assert sent, "several commands are in flight"
    wanted = LATE.initial_memory(np.array(oldest))
    for command in sent:
        wanted = LATE.felt(command, wanted, period=0.05)[1]
    begun = RobotSession.create(former.held, SETTINGS)
    begun.inherit_from(former)
    begun.sync_actuators(state)
    assert begun.memory == wanted
    assert begun.memory != LATE.initial_memory(np.array(oldest))


@pytest.mark.parametrize(
    ("applied_by", "sources", "stood", "learns"),
    [
        ("filter", (), False, True), ("filter", (), True, True), ("filter", ("laser",), False, True),
        ("filter", ("laser",), True, True), ("watchdog", (), False, False),
    ],
)  # fmt: skip
def test_a_delay_is_looked_for_where_the_robot_obeyed_the_filter(monkeypatch, applied_by, sources, stood, learns):
    memory = driven()
    passed = SimpleNamespace(is_stationary=lambda speeds: stood and speeds == (3,))
    monkeypatch.setattr(CommandHistory, "last_transition", lambda *_: passed)
    calls = kept_calls(monkeypatch, DelayEstimator, "observe")
    memory._watch_delay(state_at(1, applied=reported(memory), applied_by=applied_by, sources=sources), CAR.latent)
    assert calls == ([{"stationary": stood}] if learns else [])


def test_a_delay_is_weighed_by_the_ranges_of_the_actions() -> None:
    assert driven().delay._ranges == pytest.approx((SETTINGS.high - SETTINGS.low).tolist())


def test_a_step_on_the_straight_line_is_taken_at_its_own_time() -> None:
    times = []

    def step(entries: Sequence[float], action: Any, free: Any, seconds: float) -> list[float]:
        times.append(seconds)
        return [entry + 1.0 for entry in entries]

    state = state_at(4)
    rows = rollout_held_action(step, state.values, np.zeros(2), np.zeros(1), state.robot_time, state.period, 3)
    assert times == pytest.approx([0.2, 0.25, 0.3])
    assert rows == tuple(tuple(value + count for value in state.values) for count in (1.0, 2.0, 3.0))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_path_with_a_number_that_is_none_is_no_path(monkeypatch: pytest.MonkeyPatch, bad: float) -> None:
    def broken(*_: Any, **__: Any) -> Any:
        return np.array(((0.0, 0.0, 0.0, bad),)), ("memory",)

    memory = driven()
    state = state_at(1)
    assert (
        rollout_held_action(lambda at, *_: [*at[:3], bad], state.values, np.zeros(2), np.zeros(1), 0.05, 0.05, 2) == ()
    )
    monkeypatch.setattr(PhysicsModel, "scalar_step", lambda *_: None)
    monkeypatch.setattr(PhysicsModel, "rollout_held", broken)
    assert memory.predicted(state, verdict_of(memory), CAR.latent) == ((), None)
    late = driven(CAR)
    late.pending = SimpleNamespace(queue=(1,))
    monkeypatch.setattr(CommandHistory, "predict", lambda *_: broken()[0])
    assert late.predicted(state_at(1), verdict_of(late), CAR.latent) == ((), None)


@pytest.mark.parametrize("latent", [None, LATE.latent])
def test_behind_what_is_on_its_way_the_path_and_the_memory_are_those_of_this_action(monkeypatch, latent):
    memory, asked_with = driven(LATE, ticks=2), list[Any]()
    memory.pending = memory.pending._replace(queue=((0.5, 0.0),))

    def expected(_: CommandHistory, action: Any, known: Any, pending: Any, steps: int) -> Any:
        asked_with.append((action, known, steps))
        return np.ones((steps, 4))

    monkeypatch.setattr(CommandHistory, "predict", expected)
    verdict, known = verdict_of(memory), None if latent is None else tuple(latent.tolist())
    rows, after = memory.predicted(state_at(2, applied=reported(memory)), verdict, latent)
    action = tuple(verdict.action.tolist())
    assert asked_with == [(action, known, 1)]
    assert rows == ((1.0, 1.0, 1.0, 1.0),)
    assert after == LATE.felt(action, memory.memory, known, period=0.05)[1]


def test_without_a_memory_of_the_actuators_none_comes_of_what_is_on_its_way(monkeypatch: pytest.MonkeyPatch) -> None:
    memory = driven(CAR)
    memory.pending = SimpleNamespace(queue=((0.0, 0.0),))
    monkeypatch.setattr(CommandHistory, "predict", lambda *_: np.ones((1, 4)))
    assert memory.predicted(state_at(1), verdict_of(memory), CAR.latent)[1] == memory.memory


class Scene(AbstractScene):
    """A scene with a backup of its own."""

    def __init__(self, backup: Any) -> None:
        self.backup = backup

    def of(self, state: StateMessage) -> str:
        return "scene"


def failing(state: Any) -> Any:
    raise RuntimeError("no backup")


@pytest.mark.parametrize(
    ("backup", "wanted"),
    [
        (None, (0.0, 0.0)),
        (failing, (0.0, 0.0)),
        (lambda _: np.zeros(3), (0.0, 0.0)),
        (lambda _: (np.nan, 0.1), (0.0, 0.0)),
        (lambda _: (0.1, np.inf), (0.0, 0.0)),
        (lambda _: (-0.3, 0.1), (-0.3, 0.1)),
        (lambda _: (9.0, -9.0), (2.0, -0.34)),
    ],
)
def test_the_last_resort_is_the_backup_of_the_scene_within_the_bounds(backup: Any, wanted: tuple[float, float]) -> None:
    memory = driven()
    memory.scene = Scene(backup)
    assert memory.last_resort(state_at(1)).tolist() == pytest.approx(wanted)


@pytest.mark.parametrize(("can_stop", "speeds"), [(True, (3,)), (False, ())])
def test_only_a_robot_that_can_stand_has_speeds_that_braking_takes_away(can_stop: bool, speeds: tuple[int, ...]):
    memory = driven()
    memory.can_stop = can_stop
    assert memory.speeds == speeds
