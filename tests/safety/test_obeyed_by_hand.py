"""What the filter learns from a tick where the robot did what it was told, and what where something else drove."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.safety.node_steps import (
    CAR,
    LATE,
    SETTINGS,
    asked,
    driven,
    latent_at,
    memory_of,
    state_at,
    told,
    verdict_of,
)

from safedpa.bus import LatentMessage
from safedpa.errors import InputError
from safedpa.live.finding import History
from safedpa.safety.drive_heights import DrivenTick, _go_on
from safedpa.safety.filtered_robot import Decided, FilteredRobot
from safedpa.safety.node import SafetyFilterNode
from safedpa.safety.verdict import Status


class Noted:
    """Notes the calls of some methods in place of them."""

    def __init__(self, **answers: Any) -> None:
        self.calls, self._answers = list[tuple[str, Any]](), answers

    def __getattr__(self, name: str) -> Any:
        def called(*given: Any, **more: Any) -> Any:
            self.calls.append((name, given))
            return self._answers.get(name)

        return called


OBEYED = ({}, {"applied_by": "watchdog"}, {"applied_by": "none"}, {"tick": 4}, {"tick": 2})


@pytest.mark.parametrize("changed", OBEYED, ids=str)
def test_an_error_is_seen_where_the_next_tick_says_that_the_filter_s_action_was_taken(changed: dict[str, Any]) -> None:
    memory = driven(ticks=3)
    margin: Any = Noted()
    memory.margin = margin
    memory.watch_margin(state_at(**{"tick": 3, **changed}))
    assert (("expect", (None,)) in margin.calls) is bool(changed)
    assert [name for name, _ in margin.calls if name != "expect"] == ["observe", "rise"]
    assert memory.tick == changed.get("tick", 3)


@pytest.mark.parametrize(
    ("model", "applied_by", "asked"), [(LATE, "filter", True), (LATE, "watchdog", False), (CAR, "filter", False)]
)
def test_past_a_dead_time_it_is_asked_what_was_foretold_where_the_filter_drove(
    model: Any, applied_by: str, asked: bool
) -> None:
    memory = driven(model, ticks=8)
    assert bool(memory.pending) is (model is LATE)
    memory.margin = Noted()  # type: ignore[assignment]
    trail: Any = Noted()
    memory.trail = trail
    memory.watch_margin(state_at(8, applied_by=applied_by))
    assert (trail.calls != []) is asked


def test_of_a_state_that_is_no_scene_nothing_rises() -> None:
    memory = driven(ticks=3)
    margin: Any = Noted()
    memory.margin, memory.barriers = margin, "no goal"
    memory.watch_margin(state_at(3))
    assert [name for name, _ in margin.calls] == ["observe"]


def flat(memory: Any) -> str:
    """Dictionaries of arrays cannot be compared as they are."""
    return repr(memory)


def test_actuators_remember_what_was_expected_where_the_robot_obeyed() -> None:
    memory = driven(LATE, ticks=5)
    expected = memory.expected_memory
    assert expected
    memory.remember_actuators(state_at(5, applied=told(memory)))
    assert memory.memory is expected


@pytest.mark.parametrize("applied_by", ["watchdog", "none"])
def test_where_something_else_drove_they_remember_what_it_sent_behind_what_is_on_its_way(applied_by: str) -> None:
    memory = driven(LATE, ticks=5)
    before = memory.memory
    memory.remember_actuators(state_at(5, applied=(0.25, -0.1), applied_by=applied_by))
    wanted = LATE.felt((0.25, -0.1), before, period=0.05)[1]
    assert flat(memory.memory) == flat(wanted)
    assert flat(memory.memory) != flat(memory.expected_memory)


def test_after_a_tick_of_which_nothing_could_be_remembered_the_watchdogs_action_is_where_it_begins() -> None:
    """The first state told an action of another size: the filter falls back, and knows nothing of the actuators."""
    node = SafetyFilterNode(LATE, SETTINGS)
    first = state_at(0, applied=(0.1,))
    verdict = asked(node, first, latent_at(first))
    assert (verdict.status, verdict.predicted) == ("fallback", ())
    second = state_at(1, applied=(0.25, -0.1), applied_by="watchdog")
    asked(node, second, latent_at(second))
    assert flat(memory_of(node).memory) == flat(LATE.initial_memory(np.array([0.25, -0.1])))


@pytest.mark.parametrize("changed", [{"tick": 6}, {"tick": 4}, {"epoch": 2}], ids=str)
def test_where_ticks_are_lost_they_remember_rest_at_what_is_applied(changed: dict[str, Any]) -> None:
    memory = driven(LATE, ticks=5)
    memory.remember_actuators(state_at(**{"tick": 5, "applied": (0.25, -0.1), **changed}))
    assert flat(memory.memory) == flat(LATE.initial_memory(np.array([0.25, -0.1])))


@pytest.mark.parametrize("applied", [(), (0.1,), (0.1, 0.2, 0.3)])
def test_of_an_action_of_another_size_nothing_is_remembered(applied: tuple[float, ...]) -> None:
    memory = driven(LATE, ticks=5)
    before, trail = memory.memory, Noted()
    memory.trail = trail  # type: ignore[assignment]
    memory.remember_actuators(state_at(5, applied=applied))
    assert memory.memory is before
    assert trail.calls == []


@pytest.mark.parametrize(("age", "pending"), [(0.0, False), (0.1, True), (1.5, False)])
def test_what_is_on_its_way_is_looked_at_while_a_state_is_late_and_not_too_late(age: float, pending: bool) -> None:
    memory = driven(ticks=5)
    memory.remember_actuators(state_at(5, applied=told(memory), until_action=age))
    assert bool(memory.pending) is pending


def decided_of(memory: FilteredRobot, **changed: Any) -> Decided:
    assert memory.decision is not None
    return memory.decision._replace(verdict=verdict_of(memory, **changed))


PREDICTED = ((0.1, 0.0, 0.0, 0.5),)


@pytest.mark.parametrize(
    ("changed", "predicted", "promised"),
    [
        ({}, PREDICTED, True),
        ({}, (), False),
        ({"status": Status.corrected}, (), False),
        ({"status": Status.relaxed}, (), False),
        ({"wish": None}, PREDICTED, None),
        ({"wish": None}, (), None),
        ({"status": Status.stopped}, PREDICTED, False),
        ({"status": Status.corrected}, PREDICTED, True),
        ({"status": Status.disabled}, PREDICTED, True),
        ({"wish": "resting"}, PREDICTED, False),
        ({"wish": "resting", "status": Status.corrected}, PREDICTED, False),
    ],
)
def test_a_promise_is_kept_of_a_wish_that_would_move_it(
    changed: dict[str, Any], predicted: Any, promised: bool | None
) -> None:
    memory = driven(ticks=3)
    resting = memory.filter.settings.resting_action
    changes = {**changed, "wish": resting} if changed.get("wish") == "resting" else changed
    memory.decision = decided_of(memory, **changes)
    standing: Any = Noted()
    memory.standing = standing
    memory.watch_standing(state_at(3), predicted)
    called = [] if promised is None else ["promise" if promised else "interrupted"]
    assert [name for name, _ in standing.calls] == called, "a wish that is missing does neither at once"
    if promised and changed.get("status") is not Status.corrected:
        assert standing.calls[0][1] == (state_at(3).values, predicted[0], predicted[0])


@pytest.mark.parametrize(
    ("status", "failed", "fails", "rests", "given_up"),
    [
        (Status.corrected, 0.1, True, Status.passed, True),
        (Status.passed, 0.1, True, Status.passed, False),
        (Status.fallback, 0.1, True, Status.passed, False),
        (Status.corrected, 0.0, True, Status.passed, False),
        (Status.corrected, 0.1, False, Status.passed, False),
        (Status.corrected, 0.1, True, Status.corrected, False),
        (Status.corrected, 0.1, True, Status.relaxed, False),
    ],
)
def test_a_correction_that_moves_nothing_is_given_up_for_a_rest_that_is_safe(
    status: Status, failed: float, fails: bool, rests: Status, given_up: bool
) -> None:
    memory = driven(ticks=3)
    memory.standing = SimpleNamespace(failed=failed, way=lambda *_: 0.05, would_fail=lambda _: fails)  # type: ignore[assignment]
    verdict = verdict_of(memory, status=status)
    resting = verdict_of(memory, status=rests, action=np.zeros(2))
    latent = np.array(CAR.latent)
    found = memory.out_of_dead_band(state_at(3), verdict, latent, lambda: resting)
    if given_up:
        assert (found.status, found.action.tolist()) == (Status.corrected, [0.0, 0.0])
        assert found.wish is verdict.wish
        assert "dead band" in found.reason
    else:
        assert found is verdict


@pytest.mark.parametrize(
    ("status", "predicted", "refused"),
    [(Status.passed, PREDICTED, False), (Status.fallback, PREDICTED, True), (Status.passed, (), True)],
)
def test_a_model_that_falls_back_or_foretells_nothing_where_another_decided_is_refused(
    status: Status, predicted: Any, refused: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    memory = driven(ticks=3)
    decided, barriers = decided_of(memory), memory.barriers
    answer = verdict_of(memory, status=status)
    memory.filter = SimpleNamespace(decide=lambda *_, **__: answer)  # type: ignore[assignment]
    monkeypatch.setattr(FilteredRobot, "predicted", lambda *_: (predicted, None))
    if refused:
        with pytest.raises(InputError, match="the filter cannot decide with it: "):
            memory.try_out(decided, barriers)
        memory.try_out(decided, "no scene")  # then nobody can, and this one is not to blame
        memory.try_out(decided_of(memory, status=Status.fallback), barriers)
    else:
        memory.try_out(decided, barriers)


@pytest.mark.parametrize(("stopped", "asked"), [(True, "action"), (False, "wish")])
def test_of_one_who_was_stopped_the_action_is_tried_and_else_the_wish(stopped: bool, asked: str) -> None:
    memory = driven(ticks=3)
    wish, action = np.array([0.3, 0.1]), np.array([-0.2, 0.0])
    status = Status.stopped if stopped else Status.passed
    decided = decided_of(memory, status=status, wish=wish, action=action)
    seen: list[Any] = []

    def decide(_: Any, wished: Any, *__: Any, **___: Any) -> Any:
        seen.append(wished)
        return verdict_of(memory)

    memory.filter = SimpleNamespace(decide=decide)  # type: ignore[assignment]
    memory.try_out(decided, memory.barriers)
    assert seen[0] is {"action": action, "wish": wish}[asked]


@pytest.mark.parametrize(("stands", "speeds"), [(True, (3,)), (False, ())])
def test_only_a_robot_that_has_a_stand_has_speeds_that_braking_takes_away(
    stands: bool, speeds: tuple[int, ...]
) -> None:
    memory = driven(ticks=1)
    memory.scene = SimpleNamespace(stands=stands)  # type: ignore[assignment]
    assert memory.speeds == speeds


@pytest.mark.parametrize(
    ("changed_at", "tick", "may"),
    [
        (-1, 0, False),
        (0, 0, True),
        (0, 20, True),
        (0, 21, False),
        (5, 4, False),
        (5, 5, True),
        (5, 25, True),
        (5, 26, False),
    ],
)
def test_a_model_in_force_is_waited_for_a_second(changed_at: int, tick: int, may: bool) -> None:
    memory = driven(ticks=1)
    memory.changed_at = changed_at
    assert memory.may_wait(state_at(tick)) is may


FOLLOWING = state_at(3, applied=(0.5, 0.1))


@pytest.mark.parametrize(
    ("following", "problems", "barriers", "foreseen"),
    [
        (FOLLOWING, [], None, True),
        (None, [], None, False),
        (replace(FOLLOWING, tick=4), [], None, False),
        (replace(FOLLOWING, tick=2), [], None, False),
        (replace(FOLLOWING, applied_by="watchdog"), [], None, False),
        (FOLLOWING, ["no latent"], None, False),
        (FOLLOWING, [], "no scene", False),
    ],
)
def test_of_a_recorded_drive_only_what_the_filter_did_at_the_next_tick_is_foreseen(
    following: Any, problems: list[str], barriers: Any, foreseen: bool
) -> None:
    latent: LatentMessage = latent_at(state_at(2))
    margin = Noted()
    memory: Any = Noted(usable_latent=(None, problems))
    memory.margin, memory.barriers = margin, barriers
    _go_on(memory, DrivenTick(state_at(2), latent), following)
    assert [name for name, _ in memory.calls] == ["usable_latent", *(["foresee"] if foreseen else [])]
    assert margin.calls == ([] if foreseen else [("expect", (None,))])
    if foreseen:
        verdict = memory.calls[1][1][1]
        assert (verdict.action.tolist(), verdict.status) == ([0.5, 0.1], Status.passed)


@pytest.mark.parametrize(
    ("state", "applied", "kept"),
    [
        ((0.0, 0.0, 0.0, 0.5), (0.1, 0.1), True),
        ((0.0, 0.0, 0.0, 1e6), (0.1, 0.1), False),
        ((np.nan, 0.0, 0.0, 0.5), (0.1, 0.1), False),
        ((0.0, 0.0, 0.0, 0.5), (np.nan, 0.1), False),
        ((0.0, 0.0, 0.0, 0.5), (0.1, -np.inf), False),
    ],
)
def test_a_tick_that_cannot_be_believed_makes_a_gap_in_the_history(
    state: tuple[float, ...], applied: tuple[float, ...], kept: bool
) -> None:
    history = History(CAR.system, 0.05, longest=0.15)
    history.add(7, np.array(state), np.array(applied))
    assert [tick for tick, *_ in history.last(10.0)] == ([7] if kept else [])
    assert history.seconds_since(7) == pytest.approx(0.05 if kept else 0.0)
    assert history.seconds_since(8) == 0.0
    for tick in (8, 9, 10):  # three rows at most: the oldest one goes
        history.add(tick, np.zeros(4), np.zeros(2))
    assert [tick for tick, *_ in history.last(10.0)] == [8, 9, 10]
    assert [tick for tick, *_ in history.last(0.1)] == [9, 10]
    assert [tick for tick, *_ in history.last(0.0)] == [10]
