"""Which moments nobody wakes up for, what travels among others, and which change is taken up."""

from __future__ import annotations

import io
import math
import sys
from collections.abc import Callable

import pytest
from tests.bus.test_service_loop import EPOCH, Clock

from safedpa.bus import (
    ACTION,
    HEALTH,
    MODEL,
    STATE,
    VERDICT,
    Answer,
    Bus,
    MemoryBroker,
    MemoryTransport,
    ModelMessage,
    StateMessage,
)
from safedpa.bus.log import log_event
from safedpa.bus.loop.model_versions import ModelVersions
from safedpa.bus.loop.turning import Agenda
from safedpa.bus.wire.topics import Topic

StateAt = Callable[..., StateMessage]


@pytest.mark.parametrize(
    ("awaited", "earliest", "left"),
    [(None, 1.0, 4), ("ab", 1.0, 4), ("b", 1.0, 4), ("c", 2.0, 2), ("d", 3.0, 1), ("", math.inf, 0)],
)
def test_nobody_wakes_up_for_a_moment_of_which_no_robot_is_awaited_any_more(
    awaited: str | None, earliest: float, left: int
) -> None:
    agenda = Agenda()
    for robot, when in (("a", 1.0), ("d", 3.0), ("b", 1.0), ("c", 2.0), ("e", math.inf)):
        agenda.at(when, robot)
    assert agenda.next(None if awaited is None else awaited.__contains__) == earliest
    assert len(agenda) == left


@pytest.mark.parametrize(
    ("topic", "robot", "alone", "asked"),
    [
        (STATE, "r1", False, ["r1", "-"]),
        (STATE, "r1", True, ["r1"]),
        (STATE, "*", False, ["*"]),
        (MODEL, "r1", False, ["r1"]),  # travels alone
        (MODEL, "*", False, ["*"]),
        (ACTION, "r1", True, ["r1"]),
        (VERDICT, "r1", False, ["r1", "-"]),
        (HEALTH, "*", True, ["*"]),
    ],
)
def test_bundles_are_asked_for_where_messages_travel_in_them_and_may_be_seen(
    topic: Topic, robot: str, alone: bool, asked: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    transport = MemoryTransport(MemoryBroker())
    keys: list[str] = []
    subscribe = transport.subscribe

    def noted(key: str, accept: object) -> object:
        keys.append(key.split("/")[2])
        return subscribe(key, accept)  # type: ignore[arg-type]

    monkeypatch.setattr(transport, "subscribe", noted)
    Bus(transport, "fleet").inbox((topic,), robot, alone=alone)
    assert keys[:1] == asked[:1]
    assert len(keys) == len(asked)
    assert all(key not in ("*", robot) for key in keys[1:])


@pytest.mark.parametrize(("topic", "waits"), [(STATE, True), (MODEL, False)])
@pytest.mark.parametrize("alone", [False, True])
def test_only_what_travels_among_others_waits_for_them(
    topic: Topic, waits: bool, alone: bool, state_at: StateAt
) -> None:
    broker = MemoryBroker()
    bus, ear = Bus(MemoryTransport(broker), "f"), Bus(MemoryTransport(broker), "f").inbox((topic,))
    message = state_at(1, epoch=EPOCH, lockstep=False, period=0.05) if topic is STATE else offer_of("any", 1)
    bus.hold()
    bus.publish(topic, "r1", message, alone=alone)
    assert len(ear.take(0.0)) == (0 if waits and not alone else 1)
    bus.flush()
    assert len(ear.take(0.0)) == (1 if waits and not alone else 0)


@pytest.mark.parametrize(
    ("pending", "known", "loaded"),
    [("", False, []), ("offer", False, ["pending"]), ("take", False, ["pending"]), ("offer", True, ["other"])],
)
def test_who_is_welcomed_takes_up_a_change_that_is_under_way_and_no_other(
    pending: str, known: bool, loaded: list[str], state_at: StateAt
) -> None:
    """An offer that came before the answer is newer than what the answer says."""
    tried: list[str] = []

    def load(_: str, offer: ModelMessage) -> str:
        tried.append(offer.document)
        return offer.document

    versions: ModelVersions[str] = ModelVersions("policy", "first", "0" * 12, load, clock=Clock())
    if known:
        versions.hear("r", offer_of("other", 8))
    status = Answer(
        ok=True, sentence="", fingerprint="0" * 12, change=7, pending=pending, pending_document="pending",
        pending_fingerprint="1" * 12, epoch=EPOCH, from_tick=3,
    )  # fmt: skip
    versions.welcome("r", status)
    answer = versions.answer("r", state_at(1, epoch=EPOCH))
    assert tried == loaded
    assert (answer is not None) == bool(loaded)


@pytest.mark.parametrize(("error", "reason"), [(ValueError("two\n  lines"), "two lines"), (KeyError(), "KeyError")])
def test_whatever_a_document_brings_about_is_answered_in_one_line(
    error: Exception, reason: str, state_at: StateAt
) -> None:
    def load(_: str, __: ModelMessage) -> str:
        raise error

    versions: ModelVersions[str] = ModelVersions("policy", "first", "0" * 12, load, clock=Clock())
    versions.hear("r", offer_of("any", 1))
    answer = versions.answer("r", state_at(1, epoch=EPOCH))
    assert answer is not None
    assert (answer.state, answer.reason) == ("refused", reason)


def offer_of(document: str, change: int) -> ModelMessage:
    stamp = {"epoch": EPOCH, "tick": 0, "robot_time": 0.0, "publish_time": 0.0}
    return ModelMessage(
        **stamp, step="offer", change=change, fingerprint="2" * 12, replaces="", document=document, margin=""
    )


def test_a_line_of_the_log_is_out_when_it_is_written(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever looks into the log of a process that hangs or is killed finds its last words there."""
    below = io.BytesIO()
    monkeypatch.setattr(sys, "stderr", io.TextIOWrapper(io.BufferedWriter(below, 1 << 16), "utf-8"))  # type: ignore[arg-type]
    log_event("loop.last_words", "it hangs", service="a service of this test alone")
    assert b"it hangs" in below.getvalue()
