"""The robot on an in-memory bus: lockstep, real time, refusals, heartbeats, braking at the end."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from safedpa.bus import (
    ACTION,
    HEALTH,
    STATE,
    ActionMessage,
    Bus,
    HealthMessage,
    MemoryBroker,
    MemoryTransport,
    ReceivedMessage,
    RejectedMessage,
)
from safedpa.bus.messages.codec import decode
from safedpa.bus.messages.messages import StateMessage
from safedpa.errors import BusError
from safedpa_sim.robots import CarRobot, Scene
from safedpa_sim.robots.claim import claim_name
from safedpa_sim.robots.loop import NoActionError, RobotLoop
from safedpa_sim.robots.run_summary import percentile, summarise_run

Answer = Callable[[StateMessage], ActionMessage | bytes | None]


def action(state: StateMessage, values: tuple[float, ...] = (1.0, 0.1), **other: int) -> ActionMessage:
    stamp = {"epoch": state.epoch, "tick": state.tick, **other}
    return ActionMessage(robot_time=0.0, publish_time=0.0, values=values, **stamp)


class Fleet:
    """A robot, and a filter that answers each state at once with the result of ``answer``."""

    def __init__(
        self, answer: Answer, *, lockstep: bool = True, period: float = 0.05, patience: float = 60.0,
        clock: Callable[[], float] = time.monotonic, bus: type[Bus] = Bus,
    ) -> None:  # fmt: skip
        broker = MemoryBroker()
        self.states: list[StateMessage] = []
        self.health: list[HealthMessage] = []
        self.answer = answer
        self.filter = MemoryTransport(broker)
        self.filter.subscribe("safedpa/test/r1/state", self.on_state)
        self.filter.subscribe(
            f"safedpa/test/r1/{HEALTH.name}/robot",
            lambda _, payload: self.health.append(decode(HealthMessage, payload)),
        )
        self.sender = Bus(self.filter, "test")
        self.robot = CarRobot(Scene.random(1), period, lockstep, epoch=9)
        self.loop = RobotLoop(self.robot, bus(MemoryTransport(broker), "test"), "r1", clock, patience)

    @classmethod
    def by_its_own_clock(cls, answer: Answer, period: float) -> Fleet:
        """Runs in real time by a clock that advances only while the loop waits, independent of the machine's load."""
        now = [0.0]

        class Waiting(Bus):
            """Its clock advances by the time that its inboxes would wait; they return at once."""

            def inbox(self, *given: Any, **named: Any) -> Any:
                inbox = super().inbox(*given, **named)

                def take(longest_wait: float) -> list[ReceivedMessage | RejectedMessage]:
                    found = inbox.take(0.0)
                    now[0] += 0.0 if found else longest_wait
                    return found

                return SimpleNamespace(take=take)

        return cls(answer, lockstep=False, period=period, clock=lambda: now[0], bus=Waiting)

    def on_state(self, _: str, payload: bytes) -> None:
        state = decode(STATE.message, payload)
        assert isinstance(state, StateMessage)
        self.states.append(state)
        answered = self.answer(state)
        if isinstance(answered, bytes):
            self.filter.put("safedpa/test/r1/action", answered, never_drop=False)
        elif answered is not None:
            self.sender.publish(ACTION, "r1", answered)


def never() -> bool:
    return False


def after(calls: int) -> Callable[[], bool]:
    counter = itertools.count()
    return lambda: next(counter) >= calls


def test_lockstep_takes_one_action_a_tick_and_repeats_bit_for_bit():
    hashes = set()
    for _ in range(2):
        fleet = Fleet(action)
        fleet.loop.run(never, 50)
        assert [state.tick for state in fleet.states] == list(range(50))
        assert fleet.robot.watchdog_ticks == 0
        assert fleet.states[-1].applied_by == "filter"
        assert len(fleet.loop.latencies) == 50
        hashes.add(fleet.robot.trajectory_hash)
    assert len(hashes) == 1


def test_lockstep_repeats_an_unanswered_state_gives_up_with_the_reason_and_can_be_stopped():
    asked = itertools.count()
    fleet = Fleet(lambda state: action(state) if next(asked) >= 2 else None)
    fleet.loop.run(never, 1)
    assert [state.tick for state in fleet.states] == [0, 0, 0]
    assert fleet.robot.tick == 1
    fleet = Fleet(lambda state: action(state, (9.0, 0.0)), patience=0.15)
    with pytest.raises(NoActionError, match=r"tick 0 .*out of range.*safety_filter"):
        fleet.loop.run(never, 5)
    assert fleet.robot.tick == 0
    fleet = Fleet(lambda _: None)
    fleet.loop.run(after(2), 0)
    assert fleet.robot.tick == 0


def test_real_time_brakes_in_each_period_without_an_action():
    fleet = Fleet.by_its_own_clock(lambda state: action(state) if state.tick % 2 else None, period=0.05)
    fleet.loop.run(never, 12)
    assert fleet.robot.tick == 12
    assert fleet.robot.watchdog_ticks == 6
    assert [state.applied_by for state in fleet.states[1:5]] == ["watchdog", "filter", "watchdog", "filter"]


@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        (lambda state: action(state, tick=max(0, state.tick - 1)) if state.tick else None, "late"),
        (lambda state: action(state, tick=state.tick + 1), "from the future"),
        (lambda state: action(state, epoch=8), "wrong epoch"),
        (lambda state: action(state, (1.0,)), "wrong length"),
        (lambda state: action(state, (1.0, 0.5)), "out of range"),
        (lambda _: b"\xc1", "malformed"),
        (lambda _: b"", "malformed"),
    ],
)
def test_what_the_robot_refuses_is_counted_and_braked_for(answer, reason):
    fleet = Fleet.by_its_own_clock(answer, period=0.005)
    fleet.loop.run(never, 6)
    assert fleet.robot.watchdog_ticks == 6
    assert set(fleet.robot.guard.refusals) == {reason}
    assert fleet.robot.guard.refusals[reason] >= 5
    assert summarise_run(fleet.robot, [], 0, "test")["refusals"] == dict(fleet.robot.guard.refusals)


def test_it_brakes_to_rest_before_it_ends_whatever_the_filter_sends():
    fleet = Fleet(lambda state: action(state, (1.5, 0.0)))
    fleet.loop.run(never, 12)
    assert fleet.robot.values[3] > 1.0
    fleet.loop.brake(publish=True)
    assert abs(fleet.robot.values[3]) <= 0.01
    assert fleet.states[-1].applied_by == "watchdog"
    assert fleet.health[-1].state == "braked"


def test_heartbeats_come_from_the_loop_and_a_suspended_loop_counts_an_overrun_and_skips_periods():
    fleet = Fleet.by_its_own_clock(action, period=0.02)
    fleet.loop.run(never, 30)
    assert len(fleet.health) == 3, "at 0, 0.25 and 0.5 s of 0.6"
    assert fleet.health[-1].service == "robot"
    assert fleet.health[-1].steps > fleet.health[0].steps
    now = itertools.count(0.0, 0.02)  # every reading of the clock advances it by two periods
    fleet = Fleet(action, lockstep=False, period=0.01, clock=lambda: next(now))
    fleet.loop.run(never, 5)
    assert fleet.loop.overruns == 5
    assert fleet.robot.tick == 5


def test_percentiles_are_entries_in_microseconds():
    latencies = [index * 1e-3 for index in range(1, 101)]
    assert percentile(latencies, 0.5) == pytest.approx(50e3)
    assert percentile(latencies, 0.99) == pytest.approx(99e3)
    assert percentile([2e-3], 0.99) == pytest.approx(2e3)
    assert percentile([], 0.5) is None


def test_a_name_that_another_robot_uses_is_refused():
    broker = MemoryBroker()
    living, newcomer = Bus(MemoryTransport(broker), "test"), Bus(MemoryTransport(broker), "test")
    claim_name(living, "r1")
    with pytest.raises(BusError, match="is already running"):
        claim_name(newcomer, "r1")
    claim_name(newcomer, "r2")


def test_an_unannounced_robot_is_detected_by_its_states():
    broker = MemoryBroker()
    speaker, newcomer = Bus(MemoryTransport(broker), "test"), Bus(MemoryTransport(broker), "test")
    times = itertools.count(0.0, 0.1)

    def clock() -> float:
        speaker.publish(STATE, "r1", CarRobot(Scene.random(0)).state_message())
        return next(times)

    with pytest.raises(BusError, match="is already running"):
        claim_name(newcomer, "r1", clock)
