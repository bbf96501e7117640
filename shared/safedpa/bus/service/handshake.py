"""The model handshake: a service asks for a robot's agreed model before it serves that robot for the first time.

Otherwise a restarted service would use the model of its command line while the others use a newer one. It asks the
diagnosis and, if that does not answer, the other services. Without an answer it starts with its own model after a short
time, and the diagnosis offers the agreed model again.
"""

from __future__ import annotations

from collections.abc import Callable

from safedpa.bus.messages.requests import Answer
from safedpa.bus.messages.topics import MODEL, STATE, Topic
from safedpa.bus.service.node import AbstractNode
from safedpa.bus.transport.bus import Bus
from safedpa.bus.transport.inbox import Inbox, ReceivedMessage

# Time-out for the diagnosis, and again for the other services. A process on the same machine answers in milliseconds;
# if no process answers such questions, the bus reports that immediately.
_TIMEOUT_SECONDS = 0.3


class ModelHandshake:
    """Holds back messages of robots whose agreed model is still unknown. A node without models never waits.

    Exceptions of the node about one robot go to ``failed(robot, error)``; the other robots are served all the same.
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
        self._waiting: dict[str, tuple[dict[Topic, ReceivedMessage], float]] = {}
        """By robot: the newest message of each topic, and the time [s] at which to give up."""

    def holds(self, item: ReceivedMessage) -> bool:
        """Whether a message has to wait. ``ready`` returns it later, if it is still the newest of its topic."""
        if MODEL not in self._node.listens or item.robot in self._met:
            return False
        waiting = self._waiting.get(item.robot)
        if waiting is not None:
            waiting[0][item.topic] = item
            return True
        # Only a state proves that there is a robot to serve. Other inputs are useless without one.
        if item.topic is not STATE:
            return False
        # One time-out for the diagnosis, one for the other services, and a third because a busy machine answers late.
        self._waiting[item.robot] = {STATE: item}, self._clock() + 3.0 * _TIMEOUT_SECONDS
        self._bus.ask_model(self._inbox, item.robot, self._node.name, _TIMEOUT_SECONDS)
        return True

    def ready(self) -> list[ReceivedMessage]:
        """Returns the held messages of robots that can be served now, states first; the node has their models."""
        answers: dict[str, Answer | None] = {item.robot: item.answer for item in self._inbox.take_answers()}
        now = self._clock()
        served: list[ReceivedMessage] = []
        for robot in [name for name, (_, until) in self._waiting.items() if name in answers or now >= until]:
            self._met.add(robot)
            try:
                self._node.adopt_model(robot, answers.get(robot))
            except Exception as error:  # noqa: BLE001
                # Serve the robot with the model of the command line rather than not at all.
                self._failed(robot, error)
            served += self._waiting.pop(robot)[0].values()
        return served

    def deadline(self) -> float:
        """Returns the time [s] of the next time-out; infinite if no question is open."""
        return min((until for _, until in self._waiting.values()), default=float("inf"))

    def forget(self, robot: str) -> None:
        """Forgets a robot that left; its model is asked for again when it returns."""
        self._met.discard(robot)
