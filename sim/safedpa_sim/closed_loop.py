"""Runs a robot and the nodes of the services in one process, in lockstep over an in-memory bus, for experiments."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Protocol, final

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

_NAME = "r1"


class Robot(Protocol):
    """The interface that the closed loop needs of a robot."""

    def scans(self) -> Sequence[ScanMessage]:
        """Returns the new scans before the state of this tick; none for a robot without sensors."""

    def state_message(self) -> StateMessage:
        """Returns the state of this tick."""

    def receive(self, message: ActionMessage) -> str | None:
        """Returns None if the action is accepted, otherwise the reason for the refusal."""

    def advance(self) -> None:
        """Simulates one period."""


class RobotGroup(Protocol):
    """Robots that advance together, such as the cars of a shared field."""

    @property
    def robots(self) -> Sequence[Robot]:
        """The robots, in a fixed order."""

    def advance(self) -> None:
        """Simulates one period of all robots."""


@dataclass(frozen=True)
class Tick:
    """The messages of one period."""

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
    """Runs ``ticks`` periods and yields the messages of each.

    ``nodes`` are in the order of the data flow: the one that sends actions comes last, except for nodes that only
    listen. ``hear`` receives every message of every topic at the end of its tick. Messages are encoded and decoded as
    on the network. Raises BusError when a tick gives no action.
    """
    broker = MemoryBroker()
    with Bus(MemoryTransport(broker), fleet) as bus:
        inbox = bus.inbox((ACTION, VERDICT), _NAME)
        everything = None if hear is None else bus.inbox(tuple(TOPICS.values()), keep_all=True)
        now = 0.0
        # Nodes use the robot's clock: a slow node must not conclude from the wall clock that the robot went silent.
        loops = [ServiceLoop(node, Bus(MemoryTransport(broker), fleet), clock=lambda: now) for node in nodes]
        for _ in range(ticks):
            state = robot.state_message()
            now = state.robot_time
            for scan in robot.scans():
                bus.publish(SCAN, _NAME, scan)
            bus.publish(STATE, _NAME, state)
            for node, loop in zip(nodes, loops, strict=True):
                loop.turn(0.0)
                while SCAN in node.listens and loop.inbox.waiting:
                    loop.turn(0.0)  # a turn reads four messages of a topic; a ring of sensors sends more scans
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
    """Runs ``ticks`` periods of all robots of a field, each with its own nodes and bus, as ``drive`` does.

    All robots receive their action of a tick before any of them moves. Raises BusError as ``drive`` does.
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
    """A robot that is advanced by its field."""

    def __init__(self, robot: Robot) -> None:
        self.state_message, self.receive, self.scans = robot.state_message, robot.receive, robot.scans

    def advance(self) -> None:
        """Does nothing: the field advances the robot."""
