"""What the loop of a service knows of one robot.

What a step consumed, written into what it computed: a recording then says which inputs a decision had.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from safedpa.bus.messages.messages import ComputedMessage, HealthMessage, Message, StateMessage
from safedpa.bus.messages.service_info import software_version
from safedpa.bus.messages.topics import Topic
from safedpa.bus.service.node import Inputs, Outputs, Stale

__all__ = [
    "NO_ROBOT",
    "ComputationTrace",
    "HeartbeatCounts",
    "RobotSlot",
    "consumed",
    "heartbeat",
]

_NEVER = -1.0
_write = object.__setattr__


class ComputationTrace(NamedTuple):
    """The fields of ``ComputedMessage`` for the outputs of one step."""

    step: int = 0
    consumed: tuple[tuple[float, ...], ...] = ()
    skipped: tuple[float, ...] = ()

    def on(self, outputs: Outputs) -> Outputs:
        """The outputs, with the trace written into those that carry one.

        In place: the node made these messages for this step, and no one has them yet. A copy of each would cost more
        than everything else that the loop does between the step and its sending.
        """
        for message in outputs.values():
            if isinstance(message, ComputedMessage):
                _write(message, "step", self.step)
                if self.consumed:
                    _write(message, "consumed", self.consumed)
                if self.skipped:
                    _write(message, "skipped", self.skipped)
        return outputs


def consumed(topics: Sequence[Topic], inputs: Inputs, state: StateMessage) -> tuple[tuple[float, ...], ...]:
    """(inputs, 2): age in ticks and publish time of each input as ``ComputedMessage.consumed`` has them."""
    rows = []
    for topic in topics:
        item = inputs[topic]
        if isinstance(item, Stale):
            rows.append((_NEVER if item.age_ticks is None else float(item.age_ticks), 0.0))
        else:
            rows.append((float(state.tick - item.tick), item.publish_time))
    return tuple(rows)


_NO_SLACK: Mapping[Topic, int] = {}
_BURST = 10.0
"""States that may come at once: a network that was held up delivers what it kept."""
_PACE = 2.0
"""Times faster than it says a robot may sense on average."""
_SHORTEST_PERIOD = 0.001
"""s; a robot that says it senses more often than that is served as if it sensed that often."""


@dataclass(slots=True)
class HeartbeatCounts:
    """What goes into a heartbeat."""

    steps: int = 0
    stale: int = 0
    refused: int = 0
    microseconds: float = 0.0
    failing: bool = False
    detail: str = ""


@dataclass(slots=True)
class RobotSlot:
    """One robot."""

    state: StateMessage
    arrived: float
    """s; when the state of this tick came first: from here the share of the period counts."""
    heard: float
    """s; when the robot spoke last, be it a repetition."""
    next_heartbeat: float
    bundled: bool = False
    """Whether the newest state came among others: then the answer may, too."""
    reported: bool = False
    """Whether there was a heartbeat already."""
    counts: HeartbeatCounts = field(default_factory=HeartbeatCounts)
    inputs: dict[Topic, Message] = field(default_factory=dict)
    outputs: Outputs | None = None
    """Of the state's tick; None while the step is due."""
    unfinished_since: float | None = None
    """When the step of the state's tick ended, while what comes afterwards is still to be done."""
    prepared: bool = False
    """Whether the node was shown the state before its step."""
    trace: ComputationTrace = field(default_factory=ComputationTrace)
    """Of the newest step."""
    skipped: list[float] = field(default_factory=list)
    """Ticks since then whose states the node was shown, but did not step."""
    _credit: float = _BURST
    _credited: float = float("-inf")

    def keeps_pace(self, state: StateMessage, at: float) -> bool:
        """Whether a new tick may come at ``at`` [s]: not where a robot senses far faster than its period says.

        In lockstep a robot waits for its action, so that it cannot run ahead of those who answer.
        """
        if state.lockstep:
            return True
        earned = _PACE * max(at - self._credited, 0.0) / max(state.period, _SHORTEST_PERIOD)
        self._credit, self._credited = min(_BURST, self._credit + earned), at
        if self._credit < 1.0:
            return False
        self._credit -= 1.0
        return True

    def is_complete(self, topics: Sequence[Topic], slack: Mapping[Topic, int]) -> bool:
        """Whether every input is there: of the state's tick, or in real time older by at most its topic's ``slack``."""
        slack = _NO_SLACK if self.state.lockstep else slack
        for topic in topics:  # noqa: SIM110  a loop costs half of what `all` does, and every message asks
            if not _fits(self.inputs.get(topic), self.state, slack.get(topic, 0)):
                return False
        return True

    def keep(self, topic: Topic, message: Message) -> bool:
        """Keeps an input that is newer than the one before; False when it is of no use.

        An input of an epoch that ended, or of one that is not heard yet, is repeated if it still matters.
        """
        if message.epoch != self.state.epoch:
            return False
        known = self.inputs.get(topic)
        if known is not None and known.epoch == message.epoch and known.tick >= message.tick:
            return False
        self.inputs[topic] = message
        return True

    def given(self, topics: Sequence[Topic], slack: Mapping[Topic, int]) -> Inputs:
        """The inputs of a step, stale where they are missing or too old."""
        slack, state, found = _NO_SLACK if self.state.lockstep else slack, self.state, dict[Topic, Message | Stale]()
        for topic in topics:
            message = self.inputs.get(topic)
            if message is None or message.tick != state.tick or message.epoch != state.epoch:
                found[topic] = _usable(topic, message, state, slack.get(topic, 0))
            else:
                found[topic] = message
        return found


def _fits(message: Message | None, state: StateMessage, slack: int) -> bool:
    return message is not None and message.epoch == state.epoch and 0 <= state.tick - message.tick <= slack


def _usable(topic: Topic, message: Message | None, state: StateMessage, slack: int) -> Message | Stale:
    """The message, unless it is of another epoch, of a later tick, or older than the topic and the node allow."""
    if message is None or message.epoch != state.epoch:
        return Stale(topic, None)
    age = state.tick - message.tick
    return message if 0 <= age <= max(topic.largest_age_ticks, slack) else Stale(topic, max(age, 0))


NO_ROBOT = "-"
"""Stands for the robot in the health key of a service that serves none yet."""


def heartbeat(service: str, slot: RobotSlot | None, strangers: HeartbeatCounts, model: str) -> HealthMessage:
    """What ``service`` tells of one robot: its own steps, stale inputs and refusals, and those of no one it serves."""
    counts = strangers if slot is None else slot.counts
    refused = counts.refused if slot is None else counts.refused + strangers.refused
    return HealthMessage(
        epoch=slot.state.epoch if slot else 0,
        tick=slot.state.tick if slot else 0,
        robot_time=slot.state.robot_time if slot else 0.0,
        publish_time=time.time(),
        service=service,
        pid=os.getpid(),
        state="failing" if counts.failing else "running" if slot else "ready",
        detail=counts.detail,
        steps=counts.steps,
        stale=counts.stale,
        refused=refused,
        step_microseconds=counts.microseconds,
        model=model,
        software=software_version(),
    )
