"""For which moments a loop wakes up, what it does of a tick that was not stepped, and who is told whom it met."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from tests.bus.test_service_loop import EPOCH, Clock, Fleet, Wisher

from safedpa.bus import STATE, Bus, MemoryBroker, MemoryTransport, Outputs, StateMessage
from safedpa.bus.loop.journal import Journal
from safedpa.bus.loop.service import ServiceLoop

StateAt = Callable[..., StateMessage]


def test_a_journal_is_told_whom_the_loop_meets_and_what_it_refuses(state_at: StateAt) -> None:
    broker, told = MemoryBroker(), list[tuple[str, str]]()
    journal = Journal("policy", lambda kind, _, **about: told.append((kind, about["robot"])))
    loop = ServiceLoop(Wisher(), Bus(MemoryTransport(broker), "f"), clock=Clock(), journal=journal)
    bus = Bus(MemoryTransport(broker), "f")
    for tick in (5, 4):
        bus.publish(STATE, "r", state_at(tick, epoch=EPOCH))
        loop.turn(0.0)
    assert told == [("robot.met", "r"), ("message.refused", "r")]


def test_nobody_wakes_up_for_the_share_of_a_tick_that_is_over(state_at: StateAt) -> None:
    """At a period of 0.05 s a missing latent is waited for until 0.01 s; here it comes at once, and all is done."""
    fleet = Fleet(state_at, lockstep=False)
    fleet.state(0)
    assert fleet.loop.patience(1.0) == pytest.approx(0.01)
    fleet.latent(0)
    assert fleet.loop.patience(1.0) == pytest.approx(0.005), "for what nobody waits for, after a tenth of the period"
    fleet.wait(0.006)
    assert fleet.loop._slots["r"].unfinished_since is None
    assert fleet.loop.patience(1.0) > 0.1, "until the next heartbeat"


def test_a_moment_of_a_robot_that_has_left_is_nobodys(state_at: StateAt) -> None:
    """Of so long a period that its share would end after it is forgotten."""
    fleet = Fleet(state_at, lockstep=False)
    fleet.state(0, period=200.0)
    fleet.wait(31.0)
    assert fleet.loop._slots == {}
    assert 0.0 < fleet.loop.patience(60.0) <= 0.25
    fleet.wait(20.0)
    assert fleet.wished() == []


def test_what_follows_a_step_is_not_done_while_the_step_waits_for_its_input(
    state_at: StateAt, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []

    def afterwards(_: Wisher, robot: str) -> Outputs:
        done.append(robot)
        return {}

    monkeypatch.setattr(Wisher, "lingers", False)
    monkeypatch.setattr(Wisher, "afterwards", afterwards)
    fleet = Fleet(state_at, lockstep=False)
    fleet.state(0)
    assert done == []
    fleet.latent(0)
    assert done == ["r"]
    fleet.wait(0.02)
    assert done == ["r"]
