"""Who turns the loops of a process: the thread that brings the message, and the main thread for everything else."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from tests.bus.fleet import latent_of, stamp

from safedpa.bus import (
    ACTION,
    HEALTH,
    LATENT,
    NOMINAL,
    STATE,
    AbstractNode,
    Bus,
    Inputs,
    LatentMessage,
    MemoryBroker,
    MemoryTransport,
    NominalMessage,
    Outputs,
    ReceivedMessage,
    ServiceLoop,
    StateMessage,
)
from safedpa.bus.service.service_loop import Scheduler, TimerQueue
from safedpa.bus.transport.memory import JointTransport

PATIENCE = 30.0


class Guesser(AbstractNode):
    """A latent for every state."""

    name, inputs, outputs, share = "adaptation", (), (LATENT,), 0.0

    def __init__(self) -> None:
        self.threads: set[str] = set()

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:
        del robot, inputs
        self.threads.add(threading.current_thread().name)
        return {LATENT: latent_of(state.tick, state.epoch)}


class FixedPolicy(AbstractNode):
    """Publishes the latent as the nominal action, and takes its time to end."""

    name, inputs, outputs, share = "policy", (LATENT,), (NOMINAL,), 0.2

    def __init__(self) -> None:
        self.prepared: list[int] = []
        self.ends = 0

    def prepare(self, robot: str, state: StateMessage) -> None:
        del robot
        self.prepared.append(state.tick)

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:
        del robot
        latent = inputs[LATENT]
        values = latent.values if isinstance(latent, LatentMessage) else (-1.0,)
        return {NOMINAL: NominalMessage(**stamp(state.tick, state.epoch), values=values, controller="test")}

    def begin_shutdown(self) -> None:
        self.ends += 1


class Process:
    """A process with two services, and a robot's end of the bus."""

    def __init__(self) -> None:
        broker = MemoryBroker()
        self.bus = Bus(MemoryTransport(broker), "f")
        self.nodes = (Guesser(), FixedPolicy())
        joint = JointTransport(MemoryTransport(broker), frozenset(["latent"]))
        self.loops = [ServiceLoop(node, Bus(joint, "f")) for node in self.nodes]
        self.nominal_actions, self.healths = (
            self.bus.inbox((NOMINAL,), keep_all=True),
            self.bus.inbox((HEALTH,), keep_all=True),
        )
        self._stop = threading.Event()
        self._thread = threading.Thread(target=lambda: Scheduler(self.loops).run(self._stop.is_set), name="main")

    def __enter__(self) -> Process:
        self._thread.start()
        assert self.healths.take(PATIENCE), "no sign of life"  # it runs
        return self

    def __exit__(self, *_error: object) -> None:
        self._stop.set()
        self._thread.join(PATIENCE)
        assert not self._thread.is_alive()


def test_a_state_is_answered_on_the_thread_that_brought_it(state_at: Callable[..., StateMessage]) -> None:
    with Process() as process:
        answers = []
        for tick in range(20):
            process.bus.publish(STATE, "r", state_at(tick, lockstep=True))
            answers += process.nominal_actions.take(PATIENCE)
    nominal_actions = [item.message for item in answers if isinstance(item, ReceivedMessage)]
    assert [nominal.tick for nominal in nominal_actions] == list(range(20))
    assert {nominal.values for nominal in nominal_actions if isinstance(nominal, NominalMessage)} == {(0.1,)}
    assert threading.current_thread().name in process.nodes[0].threads
    assert process.nodes[1].ends == 1


def test_the_main_thread_does_what_no_message_brings(state_at: Callable[..., StateMessage]) -> None:
    with Process() as process:
        process.bus.publish(STATE, "r", state_at(7, lockstep=False))
        spoken = []
        for _ in range(12):  # heartbeats about the robot, long after its only message
            spoken += [item.robot for item in process.healths.take(PATIENCE) if isinstance(item, ReceivedMessage)]
            if spoken.count("r") >= 4:
                break
    assert spoken.count("r") >= 4


def test_messages_from_many_threads_at_once_are_each_answered_once(state_at: Callable[..., StateMessage]) -> None:
    robots, ticks = [f"r{number}" for number in range(6)], 30

    def drive(robot: str) -> None:
        for tick in range(ticks):
            process.bus.publish(STATE, robot, state_at(tick, lockstep=True))
            answered[robot].acquire(timeout=PATIENCE)

    with Process() as process:
        answered = {robot: threading.Semaphore(0) for robot in robots}
        threads = [threading.Thread(target=drive, args=(robot,)) for robot in robots]
        for thread in threads:
            thread.start()
        heard: list[tuple[str, int]] = []
        while len(heard) < len(robots) * ticks:
            items = [item for item in process.nominal_actions.take(PATIENCE) if isinstance(item, ReceivedMessage)]
            assert items, f"{len(heard)} answers, then none"
            heard += [(item.robot, item.message.tick) for item in items]
            for item in items:
                answered[item.robot].release()
        for thread in threads:
            thread.join(PATIENCE)
    assert sorted(heard) == sorted((robot, tick) for robot in robots for tick in range(ticks))


def test_a_node_prepares_once_while_its_inputs_are_missing(state_at: Callable[..., StateMessage]):
    broker = MemoryBroker()
    node, bus = FixedPolicy(), Bus(MemoryTransport(broker), "f")
    node.inputs = (LATENT, ACTION)  # type: ignore[assignment]
    loop = ServiceLoop(node, Bus(MemoryTransport(broker), "f"))
    bus.publish(STATE, "r", state_at(3, lockstep=True))
    loop.turn(0.0)
    assert node.prepared == [3]
    bus.publish(LATENT, "r", latent_of(3, state_at(3).epoch))
    loop.turn(0.0)
    assert node.prepared == [3]


class Loop:
    """In place of a service loop: its clock moves as it waits; it is needed until ``until`` [s]."""

    def __init__(self, now: list[float], until: float = 0.0, *, leads: bool = True, quantum: float = 0.0) -> None:
        self.now, self.until, self.leads, self.quantum, self.preferred_quantum = now, until, leads, quantum, quantum
        self.inbox = SimpleNamespace(set_listener=self.led, waiting=True)
        self.came: Callable[[], None] | None = None
        self.ended, self.served, self.waits = 0, 0, list[float]()
        self.asked: Callable[[float], float] = lambda longest: longest

    def led(self, came: Callable[[], None] | None) -> None:
        self.came = came

    def clock(self) -> float:
        return self.now[0]

    def wait_time(self, longest: float) -> float:
        self.waits.append(longest)
        return self.asked(longest)

    def turn(self, _: float) -> None:
        self.now[0] += self.waits[-1] if self.leads else 0.0

    def serve(self, wait: float) -> None:
        assert wait == 0.0, "a thread of the network never waits"
        self.served += 1
        self.inbox.waiting = self.served < 3

    def coalesce(self, quantum: float) -> None:
        self.quantum = quantum

    def begin_shutdown(self) -> None:
        self.ended += 1

    @property
    def is_needed(self) -> bool:
        return self.now[0] < self.until


@pytest.mark.parametrize(
    ("needed", "turned"),
    [((0.0, 0.0), 0.0), ((1.0, 0.0), 1.0), ((0.0, 1.0), 1.0), ((9.0, 0.0), 5.0), ((9.0, 9.0), 5.0)],
)
def test_at_the_end_loops_are_turned_until_none_is_needed_and_five_seconds_at_most(needed, turned):
    """Until then it looks four times a second whether it shall end; at the end it turns twenty times a second."""
    now, stops = [0.0], iter([False] * 4)
    loops: Any = [Loop(now, 100.0 + until, leads=not number) for number, until in enumerate(needed)]

    def stopped() -> bool:
        if next(stops, True):
            now[0] = 100.0
        return now[0] >= 100.0

    Scheduler(loops).run(stopped)
    assert [loop.ended for loop in loops] == [1, 1]
    assert now[0] - 100.0 == pytest.approx(turned, abs=0.051)
    assert loops[0].waits[:4] == [0.25] * 4
    assert all(wait <= 0.1 for wait in loops[0].waits[4:])
    assert loops[0].came is None, "messages that come later turn nothing"


@pytest.mark.parametrize(("quantum", "waiting", "served"), [(0.0, True, 3), (0.0, False, 0), (0.002, True, 0)])
def test_a_thread_that_brings_a_message_serves_until_nothing_waits_unless_batches_are_made(quantum, waiting, served):
    loop: Any = Loop([0.0], quantum=quantum)

    def stopped() -> bool:
        loop.inbox.waiting = waiting
        loop.came()
        return True

    Scheduler([loop]).run(stopped)
    assert loop.served == served


def test_while_one_thread_turns_or_asks_for_the_next_moment_no_other_thread_does() -> None:
    """Moments that are not needed any more are removed meanwhile."""
    loop: Any = Loop([0.0])
    loop.asked = lambda longest: loop.came() or longest
    turns = iter([False] * 3 + [True])
    Scheduler([loop]).run(lambda: next(turns))
    assert (len(loop.waits), loop.served) == (3, 0)


def test_a_message_that_another_thread_served_wakes_the_main_thread() -> None:
    """What is due may be due earlier now; here the main thread would sleep for a minute."""
    loop: Any = Loop([0.0])
    loop.inbox.waiting = False

    def asked(longest: float) -> float:
        del longest
        threading.Timer(0.05, loop.came).start()
        return 60.0

    loop.asked = asked
    turns, began = iter([False, True]), time.monotonic()
    Scheduler([loop]).run(lambda: next(turns))
    assert time.monotonic() - began < PATIENCE


def test_the_main_thread_wakes_up_for_the_loop_that_has_work_first() -> None:
    loops: Any = [Loop([0.0]), Loop([0.0])]
    for loop, patience in zip(loops, (60.0, 0.01), strict=True):
        loop.inbox.waiting = False
        loop.asked = lambda _, patience=patience: patience
    turns, began = iter([False, True]), time.monotonic()
    Scheduler(loops).run(lambda: next(turns))
    assert time.monotonic() - began < PATIENCE


def test_all_loops_of_a_process_make_batches_as_soon_as_one_of_them_wants_to() -> None:
    loops: Any = [Loop([0.0]), Loop([0.0])]
    loops[1].preferred_quantum = 0.002
    turns = iter([False, True])
    Scheduler(loops).run(lambda: next(turns))
    assert [loop.quantum for loop in loops] == [0.002, 0.002]


def test_moments_are_taken_when_they_have_come_earliest_first_and_later_ones_stay() -> None:
    timers = TimerQueue()
    for when, robot in ((3.0, "c"), (1.0, "a"), (2.0, "b"), (1.5, "a"), (3.0, "d"), (math.inf, "e")):
        timers.at(when, robot)
    assert timers.due(0.9) == []
    assert timers.due(2.0) == ["a", "b"]
    assert (timers.next(), len(timers)) == (3.0, 2)
    assert timers.due(2.9) == []
    assert timers.due(3.0) == ["c", "d"]
    assert (timers.due(9.0), len(timers)) == ([], 0)


@pytest.mark.parametrize(
    ("awaited", "earliest", "left"),
    [(None, 1.0, 4), ("ab", 1.0, 4), ("b", 1.0, 4), ("c", 2.0, 2), ("d", 3.0, 1), ("", math.inf, 0)],
)
def test_a_moment_for_which_no_robot_waits_any_more_is_removed(awaited: str | None, earliest: float, left: int) -> None:
    timers = TimerQueue()
    for robot, when in (("a", 1.0), ("d", 3.0), ("b", 1.0), ("c", 2.0)):
        timers.at(when, robot)
    assert timers.next(None if awaited is None else awaited.__contains__) == earliest
    assert len(timers) == left
