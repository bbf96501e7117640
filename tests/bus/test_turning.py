"""Who turns the loops of a process: the thread that brings the message, and the main thread for everything else."""

from __future__ import annotations

import threading
from collections.abc import Callable

from safedpa.bus import (
    ACTION,
    HEALTH,
    LATENT,
    STATE,
    WISH,
    AbstractNode,
    Bus,
    Inputs,
    LatentMessage,
    MemoryBroker,
    MemoryTransport,
    Outputs,
    Received,
    ServiceLoop,
    StateMessage,
    WishMessage,
)
from safedpa.bus.loop.turning import Turning
from safedpa.bus.transport.in_process import JointTransport

PATIENCE = 30.0


class Guesser(AbstractNode):
    """A latent for every state."""

    name, inputs, outputs, share = "adaptation", (), (LATENT,), 0.0

    def __init__(self) -> None:
        self.threads: set[str] = set()

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:
        del robot, inputs
        self.threads.add(threading.current_thread().name)
        stamp = {"epoch": state.epoch, "tick": state.tick, "robot_time": 0.0, "publish_time": 0.0}
        return {LATENT: LatentMessage(**stamp, model="m", values=(0.5,), deviations=(0.1,))}


class Wisher(AbstractNode):
    """Wishes what the latent says, and is in no hurry to end."""

    name, inputs, outputs, share = "policy", (LATENT,), (WISH,), 0.2

    def __init__(self) -> None:
        self.prepared: list[int] = []
        self.ends = 0

    def prepare(self, robot: str, state: StateMessage) -> None:
        del robot
        self.prepared.append(state.tick)

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:
        del robot
        latent = inputs[LATENT]
        stamp = {"epoch": state.epoch, "tick": state.tick, "robot_time": 0.0, "publish_time": 0.0}
        values = latent.values if isinstance(latent, LatentMessage) else (-1.0,)
        return {WISH: WishMessage(**stamp, values=values, controller="test")}

    def wind_up(self) -> None:
        self.ends += 1


class Process:
    """A process with two services, and a robot's end of the bus."""

    def __init__(self) -> None:
        broker = MemoryBroker()
        self.bus = Bus(MemoryTransport(broker), "f")
        self.nodes = (Guesser(), Wisher())
        joint = JointTransport(MemoryTransport(broker), frozenset(["latent"]))
        self.loops = [ServiceLoop(node, Bus(joint, "f")) for node in self.nodes]
        self.wishes, self.healths = self.bus.inbox((WISH,), keep_all=True), self.bus.inbox((HEALTH,), keep_all=True)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=lambda: Turning(self.loops).run(self._stop.is_set), name="main")

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
            answers += process.wishes.take(PATIENCE)
    wishes = [item.message for item in answers if isinstance(item, Received)]
    assert [wish.tick for wish in wishes] == list(range(20))
    assert {wish.values for wish in wishes if isinstance(wish, WishMessage)} == {(0.5,)}
    assert threading.current_thread().name in process.nodes[0].threads
    assert process.nodes[1].ends == 1


def test_what_no_message_brings_the_main_thread_does(state_at: Callable[..., StateMessage]) -> None:
    with Process() as process:
        process.bus.publish(STATE, "r", state_at(7, lockstep=False))
        spoken = []
        for _ in range(12):  # heartbeats about the robot, long after its only message
            spoken += [item.robot for item in process.healths.take(PATIENCE) if isinstance(item, Received)]
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
            items = [item for item in process.wishes.take(PATIENCE) if isinstance(item, Received)]
            assert items, f"{len(heard)} answers, then none"
            heard += [(item.robot, item.message.tick) for item in items]
            for item in items:
                answered[item.robot].release()
        for thread in threads:
            thread.join(PATIENCE)
    assert sorted(heard) == sorted((robot, tick) for robot in robots for tick in range(ticks))


def test_what_the_state_alone_allows_is_prepared_once_while_inputs_are_on_their_way(
    state_at: Callable[..., StateMessage],
) -> None:
    broker = MemoryBroker()
    node, bus = Wisher(), Bus(MemoryTransport(broker), "f")
    node.inputs = (LATENT, ACTION)  # type: ignore[assignment]
    loop = ServiceLoop(node, Bus(MemoryTransport(broker), "f"))
    bus.publish(STATE, "r", state_at(3, lockstep=True))
    loop.turn(0.0)
    assert node.prepared == [3]
    stamp = {"epoch": state_at(3).epoch, "tick": 3, "robot_time": 0.0, "publish_time": 0.0}
    bus.publish(LATENT, "r", LatentMessage(**stamp, model="m", values=(0.5,), deviations=(0.1,)))
    loop.turn(0.0)
    assert node.prepared == [3]


def test_what_is_due_is_asked_by_nobody_while_another_thread_turns() -> None:
    process = Process()
    turning, asked = Turning(process.loops), list[bool]()
    for loop in process.loops:

        def patience(longest_wait: float, ask: Callable[[float], float] = loop.patience) -> float:
            asked.append(turning._turns.locked())
            return ask(min(longest_wait, 0.001))

        loop.patience = patience  # type: ignore[method-assign]
    turns = iter([False] * 5 + [True])
    turning.run(lambda: next(turns))
    assert len(asked) >= 10
    assert all(asked), "moments that nobody awaits are taken back meanwhile"
