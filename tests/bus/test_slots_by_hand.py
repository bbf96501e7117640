"""What a loop keeps of each robot and for how long: newer input, silence, room for strangers, what is told and when."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from tests.bus.test_service_loop import EPOCH, Fleet, Wisher

from safedpa.bus import ACTION, LATENT, STATE, VERDICT, WISH, FindingMessage, LatentMessage, Stale, StateMessage
from safedpa.bus.loop import service as module
from safedpa.bus.loop.journal import Journal
from safedpa.bus.loop.slot import Counts, Slot, heartbeat
from safedpa.bus.loop.turning import quantum_for

StateAt = Callable[..., StateMessage]


def latent(tick: int, epoch: int = EPOCH) -> LatentMessage:
    stamp: dict[str, Any] = {"epoch": epoch, "tick": tick, "robot_time": 0.0, "publish_time": 0.0}
    return LatentMessage(**stamp, model="m", values=(0.1,), deviations=(0.1,))


def slot_at(state_at: StateAt, tick: int = 5, *, lockstep: bool = False, period: float = 0.05) -> Slot:
    return Slot(state_at(tick, epoch=EPOCH, lockstep=lockstep, period=period), 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("tick", "epoch", "kept"),
    [(4, EPOCH, False), (5, EPOCH, False), (6, EPOCH, True), (9, EPOCH + 1, False), (9, EPOCH - 1, False)],
)
def test_an_input_is_kept_where_it_is_newer_and_of_the_same_epoch(
    tick: int, epoch: int, kept: bool, state_at: StateAt
) -> None:
    slot = slot_at(state_at)
    assert slot.keep(LATENT, latent(5))
    assert slot.keep(LATENT, latent(tick, epoch)) is kept
    assert slot.inputs[LATENT].tick == (tick if kept else 5)


def test_what_was_kept_of_a_former_epoch_is_displaced_whatever_its_tick(state_at: StateAt) -> None:
    slot = slot_at(state_at)
    slot.inputs[LATENT] = latent(90, EPOCH - 1)
    assert slot.keep(LATENT, latent(1))
    assert slot.inputs[LATENT].tick == 1


@pytest.mark.parametrize(
    ("tick", "lockstep", "slack", "complete"),
    [(5, False, 0, True), (4, False, 0, False), (4, False, 1, True), (3, False, 1, False), (6, False, 1, False),
     (5, True, 0, True), (4, True, 1, False)],
)  # fmt: skip
def test_inputs_are_complete_with_those_of_the_tick_or_what_slack_allows(
    tick: int, lockstep: bool, slack: int, complete: bool, state_at: StateAt
) -> None:
    slot = slot_at(state_at, lockstep=lockstep)
    assert not slot.is_complete((LATENT,), {LATENT: slack})
    assert slot.is_complete((), {})
    slot.inputs[LATENT] = latent(tick)
    assert slot.is_complete((LATENT,), {LATENT: slack}) is complete
    slot.inputs[LATENT] = latent(tick, EPOCH + 1)
    assert not slot.is_complete((LATENT,), {LATENT: slack})


@pytest.mark.parametrize("tick", range(1, 8))
def test_an_input_that_is_too_old_or_of_a_later_tick_is_stale(tick: int, state_at: StateAt) -> None:
    """A latent may be as old as its topic allows; of no epoch but this one."""
    slot, oldest = slot_at(state_at), 5 - LATENT.largest_age_ticks
    slot.inputs[LATENT] = latent(tick)
    (given,) = slot.given((LATENT,), {}).values()
    assert isinstance(given, Stale) is not (oldest <= tick <= 5)
    if isinstance(given, Stale):
        assert given.age_ticks == max(5 - tick, 0)
        assert given.sentence
    slot.inputs[LATENT] = latent(5, EPOCH + 1)
    assert slot.given((LATENT,), {})[LATENT] == Stale(LATENT, None)


def test_stale_says_whether_anything_has_arrived() -> None:
    assert Stale(LATENT, None).sentence == f"no {LATENT.name} has arrived"
    assert "3" in Stale(LATENT, 3).sentence


def test_a_heartbeat_counts_what_strangers_sent_beside_the_robot_s_own(state_at: StateAt) -> None:
    slot = slot_at(state_at)
    slot.counts.refused, slot.counts.steps, slot.counts.detail = 2, 7, "late"
    strangers = Counts(refused=3, detail="refused: foreign")
    own, nobody = heartbeat("s", slot, strangers, "m"), heartbeat("s", None, strangers, "")
    assert (own.refused, own.steps, own.detail, own.state, own.tick) == (5, 7, "late", "running", 5)
    assert (nobody.refused, nobody.steps, nobody.detail, nobody.state) == (3, 0, "refused: foreign", "ready")
    slot.counts.failing = True
    assert heartbeat("s", slot, strangers, "m").state == "failing"


@pytest.mark.parametrize(
    ("period", "silence", "anew"),
    [(0.05, 0.3, False), (0.05, 0.31, True), (0.5, 1.5, False), (0.5, 1.51, True), (0.1, 0.29, False)],
)
def test_who_was_silent_for_three_tenths_of_a_second_or_three_periods_may_start_anew(
    period: float, silence: float, anew: bool, state_at: StateAt
) -> None:
    fleet = Fleet(state_at, lockstep=True)
    fleet.state(5, period=period)
    fleet.clock.now = 100.0 + silence
    fleet.state(0, epoch=EPOCH + 1, period=period)
    assert len(fleet.node.forgotten) == (2 if anew else 1)
    assert fleet.health()["r"].refused == (0 if anew else 1)


@pytest.mark.parametrize(("epoch", "tick"), [(EPOCH, 4), (EPOCH + 1, 9), (EPOCH - 1, 9)])
def test_neither_an_older_state_nor_a_second_robot_s_displaces_the_newest(
    epoch: int, tick: int, state_at: StateAt
) -> None:
    fleet = Fleet(state_at, lockstep=True)
    fleet.state(5)
    fleet.state(tick, epoch=epoch)
    assert fleet.loop._slots["r"].state.tick == 5
    fleet.latent(5)
    assert fleet.wished() == [("r", 5)]
    assert fleet.health()["r"].refused == 1


@pytest.mark.parametrize(("silence", "known"), [(30.0, True), (30.5, False)])
def test_who_was_silent_for_thirty_seconds_has_left(silence: float, known: bool, state_at: StateAt) -> None:
    fleet = Fleet(state_at, lockstep=True)
    fleet.state(5)
    fleet.wait(silence)
    assert ("r" in fleet.loop._slots) is known


def test_room_is_for_so_many_names_and_who_is_known_needs_none(
    state_at: StateAt, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_MOST_ROBOTS", 2)
    fleet = Fleet(state_at, lockstep=True)
    fleet.latent(0, "spoken of")
    fleet.state(0, "a")
    assert fleet.health()["a"].refused == 0
    fleet.state(0, "b")
    fleet.latent(1, "b")
    assert set(fleet.loop._slots) == {"a"}
    told = fleet.health()["a"]
    assert told.refused == 2
    fleet.latent(1, "spoken of")  # has its room already
    fleet.state(1, "a")
    assert fleet.loop._slots["a"].state.tick == 1
    fleet.state(0, "spoken of")
    assert set(fleet.loop._slots) == {"a", "spoken of"}
    assert fleet.health()["a"].refused == 2


@pytest.mark.parametrize(("rests", "silence", "needed"), [(False, 0.3, True), (False, 0.31, False), (True, 0.0, False)])
def test_at_the_end_a_loop_is_needed_by_robots_that_speak_and_are_not_at_rest(
    rests: bool, silence: float, needed: bool, state_at: StateAt, monkeypatch: pytest.MonkeyPatch
) -> None:
    fleet = Fleet(state_at, lockstep=True)
    monkeypatch.setattr(Wisher, "at_rest", lambda *_: rests)
    assert not fleet.loop.is_needed
    fleet.state(5)
    fleet.clock.now = 100.0 + silence
    assert fleet.loop.is_needed is needed


def test_an_action_travels_alone_unless_its_robot_s_state_came_among_others(state_at: StateAt) -> None:
    fleet = Fleet(state_at, lockstep=True)
    fleet.state(5)
    said: list[tuple[str, bool]] = []
    fleet.loop._bus.publish = lambda topic, *_, alone=False: said.append((topic.name, alone))  # type: ignore[method-assign,assignment,misc]
    message: Any = None
    for bundled in (False, True):
        fleet.loop._slots["r"].bundled = bundled
        fleet.loop._publish("r", {ACTION: message, VERDICT: message, WISH: message})
    names = [topic.name for topic in (ACTION, VERDICT, WISH)]
    assert said == [(names[0], True), (names[1], False), (names[2], False), *((name, False) for name in names)]


def test_ticks_whose_states_were_shown_and_not_stepped_are_told(state_at: StateAt) -> None:
    """In lockstep a state whose input never came is shown to the node; the next one that is stepped names it."""
    fleet = Fleet(state_at, lockstep=True)
    fleet.state(5)
    fleet.state(6)
    fleet.latent(6)
    assert fleet.loop._slots["r"].trace.skipped == (5.0,)
    fleet.latent(7)
    fleet.state(7)
    assert fleet.loop._slots["r"].trace.skipped == ()


def test_a_stage_of_a_finding_is_told_once_and_again_after_the_robot_left() -> None:
    told: list[str] = []
    journal = Journal("s", lambda kind, *_, **about: told.append(f"{kind} {about['robot']} {about.get('stage', '')}"))
    message: Any = object.__new__(FindingMessage)
    for stage, robot in (("learning", "a"), ("raised", "a"), ("raised", "a"), ("raised", "b"), ("calm", "a")):
        object.__setattr__(message, "stage", stage)
        object.__setattr__(message, "sentence", stage)
        object.__setattr__(message, "tick", 1)
        journal.said(robot, {STATE: message})
    assert told == ["finding.changed a raised", "finding.changed b raised", "finding.changed a calm"]


@pytest.mark.parametrize("coalescing", [False, True])
def test_few_robots_are_served_at_once(coalescing: bool) -> None:
    assert quantum_for([], coalescing=coalescing) == 0.0
    assert quantum_for([0.05], coalescing=coalescing) == 0.0


@pytest.mark.parametrize(
    ("age", "slack", "lockstep", "usable"),
    [(1, 0, False, False), (1, 1, False, True), (2, 1, False, False), (2, 3, False, True), (1, 1, True, False)],
)
def test_a_step_is_given_what_its_topic_or_its_node_still_allows(
    age: int, slack: int, lockstep: bool, usable: bool, state_at: StateAt
) -> None:
    """Of a latent the topic allows no age; a node with slack takes an older one, and in lockstep nobody does."""
    slot = slot_at(state_at, lockstep=lockstep)
    slot.inputs[LATENT] = latent(5 - age)
    (given,) = slot.given((LATENT,), {LATENT: slack}).values()
    assert given == (latent(5 - age) if usable else Stale(LATENT, age))
