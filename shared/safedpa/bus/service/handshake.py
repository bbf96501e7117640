"""Before a service serves a robot that it has not met, it asks which model that robot's services agreed on.

A service that was restarted would otherwise begin with the model of its own options while the others have moved on.
No one waits long: without an answer the service begins with its own model, and the diagnosis offers the right one
again. While no diagnosis answers, the other services tell what they agreed on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from safedpa.bus.messages.requests import Answer
from safedpa.bus.messages.topics import MODEL, STATE, Topic
from safedpa.bus.service.node import AbstractNode
from safedpa.bus.transport.bus import Bus
from safedpa.bus.transport.inbox import Inbox, ReceivedMessage

__all__ = ["ModelHandshake"]

_PATIENCE_SECONDS = 0.3
"""With the diagnosis, then with the other services. A process on the same machine answers in a few milliseconds, and
where there is none the bus says so at once."""


@dataclass
class _Waiting:
    newest: dict[Topic, ReceivedMessage]
    """The newest message of every topic."""
    give_up: float


class ModelHandshake:
    """Holds back what robots say whose model is being asked for; a node that holds no model waits for nothing.

    ``failed(robot, error)`` is told what the node raises about one of them; the others are welcomed all the same.
    """

    def __init__(
        self,
        node: AbstractNode,
        bus: Bus,
        inbox: Inbox,
        clock: Callable[[], float],
        failed: Callable[[str, Exception], object],
    ) -> None:
        self._failed = failed
        self._node, self._bus, self._inbox, self._clock = node, bus, inbox, clock
        if MODEL in node.listens:
            bus.answer_agreed(node.agreed)
        self._met: set[str] = set()
        self._waiting: dict[str, _Waiting] = {}

    def holds(self, item: ReceivedMessage) -> bool:
        """Whether a message of a tick must wait; it comes back from ``ready``, if it is still the newest."""
        if MODEL not in self._node.listens or item.robot in self._met:
            return False
        waiting = self._waiting.get(item.robot)
        if waiting is not None:
            waiting.newest[item.topic] = item
            return True
        if item.topic is not STATE:
            return False
        self._waiting[item.robot] = _Waiting({STATE: item}, self._clock() + 3.0 * _PATIENCE_SECONDS)
        self._bus.ask_model(self._inbox, item.robot, self._node.name, _PATIENCE_SECONDS)
        return True

    def ready(self) -> list[ReceivedMessage]:
        """What robots that can be served from now on have said, states first; the node was told of their models."""
        answers: dict[str, Answer | None] = {item.robot: item.answer for item in self._inbox.take_answers()}
        now = self._clock()
        served: list[ReceivedMessage] = []
        for robot in [name for name, item in self._waiting.items() if name in answers or now >= item.give_up]:
            self._met.add(robot)
            try:
                self._node.welcome(robot, answers.get(robot))
            except Exception as error:  # noqa: BLE001  it is served with the model of our own options then
                self._failed(robot, error)
            served += self._waiting.pop(robot).newest.values()
        return served

    def deadline(self) -> float:
        """s; when the patience with the next unanswered question ends."""
        return min((item.give_up for item in self._waiting.values()), default=float("inf"))

    def forget(self, robot: str) -> None:
        """The robot left; it is asked for again when it returns."""
        self._met.discard(robot)
