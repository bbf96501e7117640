"""The interface of a node, the computing part of a service: one step per tick and robot.

The service loop does the waiting and publishing.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar

from safedpa.bus.messages.messages import Message, ModelMessage, StateMessage
from safedpa.bus.messages.requests import Answer
from safedpa.bus.messages.topics import Topic
from safedpa.bus.service.sandbox import JobHandle


@dataclass(frozen=True, slots=True)
class Stale:
    """Replaces an input that did not arrive in time."""

    topic: Topic
    age_ticks: int | None
    """Age of the last message in ticks; None if there was none."""

    @property
    def sentence(self) -> str:
        """Description for people."""
        if self.age_ticks is None:
            return f"no {self.topic.name} has arrived"
        return f"the {self.topic.name} is {self.age_ticks} ticks old"


Inputs = Mapping[Topic, "Message | Stale"]
"""The inputs besides the state, each usable or stale."""

Outputs = Mapping[Topic, Message]
"""The messages that a step publishes."""


class AbstractNode(ABC):
    """The computing part of a service. It serves any number of robots and keeps separate data for each.

    - ``inputs``: topics needed besides the state;
    - ``outputs``: topics published;
    - ``listens``: topics that are not inputs of a tick; their messages go to ``hear`` as they arrive;
    - ``share``: in real time, the fraction of the robot's period after which the step runs with the inputs at hand.
    """

    name: ClassVar[str]
    inputs: ClassVar[tuple[Topic, ...]]
    outputs: ClassVar[tuple[Topic, ...]]
    share: ClassVar[float]
    listens: ClassVar[tuple[Topic, ...]] = ()
    slack: ClassVar[Mapping[Topic, int]] = {}
    """By topic, the age in ticks up to which an input is good enough in real time: the step does not wait for a newer
    one, but uses it if it is there. For other topics the step waits for the message of its tick."""
    every_tick: ClassVar[bool] = False
    """Whether ticks that were overtaken while the process had no processor are stepped, too: for a node whose outputs
    have no deadline."""
    defers_afterwards: ClassVar[bool] = True
    """Whether ``afterwards`` takes so long that the loop defers it to a pause; otherwise it runs right after a step."""

    sensor_inputs: ClassVar[tuple[Topic, ...]] = ()
    """Further inputs for robots whose states name sources."""

    def needs(self, state: StateMessage) -> tuple[Topic, ...]:
        """Returns the inputs besides the state that this tick's step needs."""
        return (*self.inputs, *self.sensor_inputs) if state.sources else self.inputs

    @abstractmethod
    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:
        """Computes the outputs of one tick. Called at most once per tick and robot, with increasing ticks."""

    def prepare(self, robot: str, state: StateMessage) -> None:
        """Does the work that needs the state only, while other inputs are pending; ``step`` follows."""
        del robot, state

    def afterwards(self, robot: str) -> Outputs:
        """Computes outputs of the same tick that are not urgent; called after the outputs of ``step`` were sent."""
        return {}

    def hear(self, robot: str, message: Message) -> None:
        """Handles a message of a topic in ``listens``: each one once, in order, of any tick."""
        del robot, message

    def use_sandbox(self, submit: Callable[[str, ModelMessage], JobHandle]) -> None:
        """Has offered models tried by ``submit(robot, offer)``, in the sandbox, before this process loads them."""
        del submit

    def newest(self, robot: str) -> StateMessage | None:
        """Returns the robot's newest state, at which an offered model is tried; None without one."""
        return None

    def adopt_model(self, robot: str, status: Answer | None) -> None:
        """Adopts the agreed model of a new robot; called before its first step if MODEL is among ``listens``.

        ``status`` is the diagnosis's or another service's answer about the model; None without an answer.
        """
        del robot, status

    def agreed(self, robot: str) -> Answer | None:
        """Returns the model that the robot's services agreed on, with its document; None if unknown.

        Called on any thread, when another service was restarted and the diagnosis does not answer.
        """
        return None

    def model_of(self, robot: str) -> str:
        """Returns the fingerprint of the active model of a robot, for heartbeats; empty without a model."""
        return ""

    def begin_shutdown(self) -> None:
        """Begins the shutdown; called once. The loop continues until ``at_rest`` is true for all robots, or 5 s."""
        return

    def at_rest(self, robot: str) -> bool:
        """Whether a robot no longer needs this service; called after ``begin_shutdown``."""
        return True

    def rescue(self, robot: str, state: StateMessage, reason: str) -> Outputs:
        """Returns the safe outputs of a tick whose step failed with ``reason``; by default none.

        It must not depend on what may have failed, such as the node's data of the robot or the model.
        """
        return {}

    def forget(self, robot: str) -> None:
        """Drops the data of a robot's current drive, because it restarted or left."""
        del robot

    def leave(self, robot: str) -> None:
        """Drops all data of a robot that left; the handshake asks for its model again when it returns."""
        self.forget(robot)
