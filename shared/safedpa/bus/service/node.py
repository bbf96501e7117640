"""What a service computes: a node, one pure step per tick of each robot. Waiting and publishing is the loop's work."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar

from safedpa.bus.messages.messages import Message, ModelMessage, StateMessage
from safedpa.bus.messages.requests import Answer
from safedpa.bus.messages.topics import Topic
from safedpa.bus.service.sandbox import AbstractJobHandle

__all__ = ["AbstractNode", "Inputs", "Outputs", "Stale"]


@dataclass(frozen=True, slots=True)
class Stale:
    """Stands in place of an input that did not arrive in time."""

    topic: Topic
    age_ticks: int | None
    """Ticks since the last one that did; None when there never was one."""

    @property
    def sentence(self) -> str:
        """The finding in words."""
        if self.age_ticks is None:
            return f"no {self.topic.name} has arrived"
        return f"the {self.topic.name} is {self.age_ticks} ticks old"


Inputs = Mapping[Topic, "Message | Stale"]
"""The inputs besides the state, each of the state's tick or stale."""

Outputs = Mapping[Topic, Message]
"""What a step publishes."""


class AbstractNode(ABC):
    """The computing part of one service. It serves any number of robots; each has a state of its own inside.

    - ``inputs``: topics needed besides the state;
    - ``outputs``: topics published;
    - ``listens``: topics that are no input of a tick: their messages are handed to ``hear`` as they come;
    - ``share``: part of the robot's period after which, in real time, the step runs with what is there.
    """

    name: ClassVar[str]
    inputs: ClassVar[tuple[Topic, ...]]
    outputs: ClassVar[tuple[Topic, ...]]
    share: ClassVar[float]
    listens: ClassVar[tuple[Topic, ...]] = ()
    slack: ClassVar[Mapping[Topic, int]] = {}
    """By topic, the age in ticks up to which, in real time, an input is as good as that of the tick: no one waits for a
    newer one, which is taken all the same where it is there. Topics that are not named are waited for."""
    lingers: ClassVar[bool] = True
    """Whether ``afterwards`` takes so long that it waits for a pause; else it follows at once."""

    sensor_inputs: ClassVar[tuple[Topic, ...]] = ()
    """Further inputs, for the ticks of robots whose states name sources."""

    def needs(self, state: StateMessage) -> tuple[Topic, ...]:
        """The inputs besides the state that this tick's step is given."""
        return (*self.inputs, *self.sensor_inputs) if state.sources else self.inputs

    @abstractmethod
    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:
        """The outputs of one tick; called once per tick and robot, ticks growing."""

    def prepare(self, robot: str, state: StateMessage) -> None:
        """What can be done with the state alone while other inputs are still on their way; ``step`` follows."""
        del robot, state

    def afterwards(self, robot: str) -> Outputs:
        """Outputs of the same tick for which no one waits; called when those of ``step`` are on their way."""
        del robot
        return {}

    def hear(self, robot: str, message: Message) -> None:
        """Takes a message of one of the topics in ``listens``; each once, in order, whatever tick it belongs to."""
        del robot, message

    def try_apart(self, hand_in: Callable[[str, ModelMessage], AbstractJobHandle]) -> None:
        """From now on offered models are tried by ``hand_in(robot, offer)`` before this process looks into them."""
        del hand_in

    def newest(self, robot: str) -> StateMessage | None:
        """The robot's newest state, to try an offered model at; None without one."""
        del robot
        return None

    def welcome(self, robot: str, status: Answer | None) -> None:
        """Told before the first step for a robot that this process has not met, when MODEL is among ``listens``.

        ``status`` is what the diagnosis says of the robot's model; None when no one answered.
        """
        del robot, status

    def agreed(self, robot: str) -> Answer | None:
        """What this service knows of the model that the robot's services agreed on, with its document; None: nothing.

        Called on any thread, when another service was restarted and no diagnosis answers.
        """
        del robot
        return None

    def model_of(self, robot: str) -> str:
        """Fingerprint of the model in force for a robot, for the health message; empty without one."""
        del robot
        return ""

    def wind_up(self) -> None:
        """Told once when the process shall end: what must be done before is begun; the loop goes on meanwhile."""
        return

    def at_rest(self, robot: str) -> bool:
        """Asked after ``wind_up``: whether nothing is left to do for a robot."""
        del robot
        return True

    def rescue(self, robot: str, state: StateMessage, reason: str) -> Outputs:
        """The outputs of a tick whose step failed, for ``reason``; nothing, unless a node knows what is safe then.

        It must not depend on what may have failed: on the robot's memory, on the model.
        """
        del robot, state, reason
        return {}

    def forget(self, robot: str) -> None:
        """Drops what is remembered of a robot's drive: it restarted, or left."""
        del robot

    def leave(self, robot: str) -> None:
        """Drops everything that is remembered of a robot: it left, and is asked for its model when it returns."""
        self.forget(robot)
