"""For which moments a loop wakes up, when it lets go of what it holds, and which states come too fast."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from tests.bus.test_service_loop import EPOCH, Clock, Fleet, Wisher

from safedpa.bus import (
    LATENT,
    STATE,
    Bus,
    Inputs,
    LatentMessage,
    MemoryBroker,
    MemoryTransport,
    Outputs,
    Received,
    StateMessage,
)
from safedpa.bus.loop.journal import Journal
from safedpa.bus.loop.service import ServiceLoop
from safedpa.bus.loop.turning import LONGEST_HOLD_SECONDS

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


class Taking(Wisher):
    """Steps that take ``seconds`` each; notes what the robots had heard when it began one, and when it went on."""

    lingers = False

    def __init__(self, fleet: Fleet, seconds: float) -> None:
        super().__init__()
        self.fleet, self.seconds = fleet, seconds
        self.out: list[str] = []
        self.before, self.after = list[int](), list[int]()

    def _heard(self) -> int:
        self.out += [robot for robot, _ in self.fleet.wished()]
        return len(self.out)

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:
        self.before.append(self._heard())
        self.fleet.clock.now += self.seconds
        return super().step(robot, state, inputs)

    def afterwards(self, robot: str) -> Outputs:
        self.after.append(self._heard())
        return {}


def spoken(fleet: Fleet, state_at: StateAt, names: list[str], tick: int = 0) -> None:
    """Each robot's state and latent, of one moment."""
    for name in names:
        fleet.bus.publish(STATE, name, state_at(tick, epoch=EPOCH, lockstep=False, period=0.5))
        stamp = {"epoch": EPOCH, "tick": tick, "robot_time": 0.0, "publish_time": 0.0}
        fleet.bus.publish(LATENT, name, LatentMessage(**stamp, model="m", values=(0.1,), deviations=(0.1,)))


@pytest.mark.parametrize(("seconds", "together"), [(0.0, 6), (0.002, 3), (0.006, 1)])
def test_what_is_ready_waits_for_that_of_others_five_milliseconds_at_most(
    state_at: StateAt, seconds: float, together: int
) -> None:
    """Of six robots that speak together; what nobody waits for comes when all of them have theirs."""
    assert LONGEST_HOLD_SECONDS == 0.005
    fleet = Fleet(state_at, lockstep=False)
    node = fleet.loop._node = Taking(fleet, seconds)
    fleet.loop.quantum = 0.005
    names = [f"r{number}" for number in range(6)]
    spoken(fleet, state_at, names)
    fleet.loop.serve(0.0)
    assert node.before == [together * (number // together) for number in range(6)]
    fleet.clock.now += 0.06
    fleet.loop.serve(0.0)
    assert node.after == [6] * 6


def test_the_outputs_of_a_turn_are_on_the_bus_before_what_nobody_waits_for_is_done(state_at: StateAt) -> None:
    fleet = Fleet(state_at, lockstep=False)
    node = fleet.loop._node = Taking(fleet, 0.0)
    fleet.loop.quantum = 0.005
    spoken(fleet, state_at, [f"r{number}" for number in range(6)])
    fleet.loop.serve(0.0)
    assert node.after == [6] * 6


def test_heartbeats_about_robots_that_fell_silent_are_on_the_bus_when_the_turn_ends(state_at: StateAt) -> None:
    fleet = Fleet(state_at, lockstep=False)
    names = [f"r{number}" for number in range(9)]
    spoken(fleet, state_at, names)
    for _ in range(3):  # until nothing is left to do for any of them
        fleet.loop.turn(0.0)
        fleet.clock.now += 0.2
    fleet.loop.quantum = 0.005
    fleet.healths.take(0.0)
    fleet.clock.now += 0.3
    fleet.loop.turn(0.0)
    assert {item.robot for item in fleet.healths.take(0.0) if isinstance(item, Received)} == set(names)


@pytest.mark.parametrize(("apart", "refused"), [(0.05, 0), (0.04, 0), (0.005, 1), (0.0, 1)])
def test_states_that_come_far_faster_than_their_period_are_no_ticks(
    state_at: StateAt, apart: float, refused: int
) -> None:
    """Of sixty at a period of 0.05 s: those that come ten times as fast are refused but for the first few."""
    fleet = Fleet(state_at, lockstep=False)
    for tick in range(60):
        fleet.clock.now += apart
        fleet.state(tick)
        fleet.latent(tick)
    steps = len(fleet.loop._node.steps)  # type: ignore[attr-defined]
    told = fleet.health()["r"]
    assert (steps == 60, bool(told.refused)) == (not refused, bool(refused))
    assert told.refused == 60 - steps
    assert steps < 40 or not refused


def test_in_lockstep_no_state_comes_too_fast(state_at: StateAt) -> None:
    fleet = Fleet(state_at, lockstep=True)
    for tick in range(60):
        fleet.state(tick)
        fleet.latent(tick)
    assert fleet.health()["r"].steps == 60
