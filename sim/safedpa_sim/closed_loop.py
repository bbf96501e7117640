"""A robot and the real nodes of the services in one process, in lockstep over an in-memory bus: for experiments."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Protocol, final, runtime_checkable

from safedpa.bus import (
    ACTION,
    SCAN,
    STATE,
    TOPICS,
    VERDICT,
    AbstractNode,
    ActionMessage,
    Bus,
    MemoryBroker,
    MemoryTransport,
    ReceivedMessage,
    ScanMessage,
    ServiceLoop,
    StateMessage,
    VerdictMessage,
)
from safedpa.errors import BusError

__all__ = ["Robot", "RobotGroup", "Sensing", "SensingRobot", "Tick", "drive", "drive_together"]

_NAME = "r1"


class Robot(Protocol):
    """What the closed loop needs of a robot."""

    def state_message(self) -> StateMessage:
        """The state of this tick."""

    def receive(self, message: ActionMessage) -> str | None:
        """Accepts an action, or says why not."""

    def advance(self) -> None:
        """Lives through one period."""


@runtime_checkable
class Sensing(Protocol):
    """A robot with sensors of its own."""

    def scans(self) -> Sequence[ScanMessage]:
        """What they have to tell before the state of this tick."""


class SensingRobot(Robot, Sensing, Protocol):
    """Both."""


class RobotGroup(Protocol):
    """Robots that live through their periods together."""

    @property
    def robots(self) -> Sequence[SensingRobot]:
        """In an order that stays."""

    def advance(self) -> None:
        """All of them live through one period."""


@dataclass(frozen=True)
class Tick:
    """What happened in one period."""

    state: StateMessage
    verdict: VerdictMessage
    refusal: str | None


def drive(
    robot: Robot,
    nodes: Sequence[AbstractNode],
    ticks: int,
    fleet: str = "experiment",
    hear: Callable[[ReceivedMessage], None] | None = None,
) -> Generator[Tick, None, None]:
    """Runs ``ticks`` periods; nodes in the order of the data flow, the one that sends actions last; who only listens
    may stand behind it.

    ``hear`` gets every message of every topic, at the end of its tick. The messages are encoded and decoded as on the
    network. Raises BusError when no action comes out of a tick.
    """
    broker = MemoryBroker()
    with Bus(MemoryTransport(broker), fleet) as bus:
        inbox = bus.inbox((ACTION, VERDICT), _NAME)
        everything = None if hear is None else bus.inbox(tuple(TOPICS.values()), keep_all=True)
        now = 0.0
        # by the robot's clock: a node that thinks for long must not find that the robot was silent meanwhile
        loops = [ServiceLoop(node, Bus(MemoryTransport(broker), fleet), clock=lambda: now) for node in nodes]
        for _ in range(ticks):
            state = robot.state_message()
            now = state.robot_time
            for scan in robot.scans() if isinstance(robot, Sensing) else ():
                bus.publish(SCAN, _NAME, scan)
            bus.publish(STATE, _NAME, state)
            for loop in loops:
                loop.turn(0.0)
            messages = [item.message for item in inbox.take(0.0) if isinstance(item, ReceivedMessage)]
            actions = [message for message in messages if isinstance(message, ActionMessage)]
            verdicts = [message for message in messages if isinstance(message, VerdictMessage)]
            if not actions or not verdicts:
                raise BusError(f"tick {state.tick}: got no action, wanted one; does one of the nodes send it?")
            if hear is not None and everything is not None:
                for item in everything.take(0.0):
                    if isinstance(item, ReceivedMessage):
                        hear(item)
            refusal = robot.receive(actions[-1])
            robot.advance()
            yield Tick(state, verdicts[-1], refusal)


def drive_together(
    field: RobotGroup, nodes: Sequence[Sequence[AbstractNode]], ticks: int
) -> Generator[tuple[Tick, ...], None, None]:
    """Runs ``ticks`` periods of all robots of a field, each with nodes and a bus of its own, as ``drive`` does.

    All have their actions of a tick before any of them moves. Raises BusError as ``drive`` does.
    """
    drives = [drive(_WaitingRobot(robot), own, ticks) for robot, own in zip(field.robots, nodes, strict=True)]
    try:
        for _ in range(ticks):
            reported = tuple(next(one) for one in drives)
            field.advance()
            yield reported
    finally:
        for one in drives:
            one.close()


@final
class _WaitingRobot:
    """A robot that does not move alone."""

    def __init__(self, robot: SensingRobot) -> None:
        self.state_message, self.receive, self.scans = robot.state_message, robot.receive, robot.scans

    def advance(self) -> None:
        """Nothing: its field moves it."""
