"""The service loop's data of one robot: state, inputs, counts for heartbeats, and the trace of consumed inputs.

The trace is written into the computed messages, so that a recording shows which inputs a decision had.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from safedpa.bus.messages.messages import ComputedMessage, HealthMessage, Message, StateMessage, header
from safedpa.bus.messages.service_info import is_supervised, software_version
from safedpa.bus.messages.topics import Topic
from safedpa.bus.service.node import Inputs, Outputs, Stale

_NEVER = -1.0
# Messages are frozen dataclasses; this sets a field of one that is not published yet.
_write = object.__setattr__


class ComputationTrace(NamedTuple):
    """The fields of ``ComputedMessage`` for the outputs of one step."""

    step: int = 0
    consumed: tuple[tuple[float, ...], ...] = ()
    skipped: tuple[float, ...] = ()

    def on(self, outputs: Outputs) -> Outputs:
        """Writes the trace into those outputs that have its fields, and returns the outputs."""
        # In place: the node created these messages for this step and no other code has seen them. Copying them would
        # take longer than everything else that the loop does between a step and sending its outputs.
        for message in outputs.values():
            if isinstance(message, ComputedMessage):
                _write(message, "step", self.step)
                if self.consumed:
                    _write(message, "consumed", self.consumed)
                if self.skipped:
                    _write(message, "skipped", self.skipped)
        return outputs


def consumed(topics: Sequence[Topic], inputs: Inputs, state: StateMessage) -> tuple[tuple[float, ...], ...]:
    """Returns ``ComputedMessage.consumed``: (inputs, 2), age in ticks and publish time of each input."""
    rows = []
    for topic in topics:
        item = inputs[topic]
        if isinstance(item, Stale):
            rows.append((_NEVER if item.age_ticks is None else float(item.age_ticks), 0.0))
        else:
            rows.append((float(state.tick - item.tick), item.publish_time))
    return tuple(rows)


_NO_SLACK: Mapping[Topic, int] = {}
# Rate limit of a robot's states, a token bucket. Without it one robot could take the CPU time of all others.
# States accepted at once: a network that stalled delivers several states together.
_BURST = 10.0
LONG_BURST = 200.0
"""The same for a node that steps every tick: on a busy machine the network delivers those of seconds at once."""
# Accepted average rate relative to the robot's stated period; 2 tolerates jitter and clock errors.
_PACE = 2.0
# s; a shorter stated period counts as this one, so that a robot cannot raise its limit at will.
_SHORTEST_PERIOD = 0.001


@dataclass(slots=True)
class HeartbeatCounts:
    """Counts and times reported in heartbeats."""

    steps: int = 0
    stale: int = 0
    refused: int = 0
    microseconds: float = 0.0
    failing: bool = False
    detail: str = ""


@dataclass(slots=True)
class RobotSlot:
    """The loop's data of one robot."""

    state: StateMessage
    arrived: float
    """Time [s] at which the state of this tick first arrived; the node's share of the period starts here."""
    heard: float
    """Time [s] of the robot's last message, including repetitions."""
    next_heartbeat: float
    read: float
    """Time [s] at which this process read it: later by its backlog."""
    bundled: bool = False
    """Whether the newest state arrived in a bundle; the outputs may then be bundled, too."""
    reported: bool = False
    """Whether a heartbeat was sent for this robot."""
    counts: HeartbeatCounts = field(default_factory=HeartbeatCounts)
    inputs: dict[Topic, Message] = field(default_factory=dict)
    outputs: Outputs | None = None
    """Outputs of the state's tick; None while the step is due."""
    unfinished_since: float | None = None
    """Time [s] at which the tick's step ended, while ``afterwards`` is still to be called."""
    prepared: bool = False
    """Whether the node has prepared the state."""
    trace: ComputationTrace = field(default_factory=ComputationTrace)
    """Trace of the newest step."""
    burst: float = _BURST
    """States accepted at once after a pause."""
    skipped: list[float] = field(default_factory=list)
    """Ticks since then that the node has prepared but not stepped."""
    _credit: float = _BURST
    _credited: float = float("-inf")

    def keeps_pace(self, state: StateMessage, at: float) -> bool:
        """Whether a new tick at time ``at`` [s] is within the rate limit of the robot's stated period."""
        # A robot in lockstep waits for its action, so it cannot send faster than it is served.
        if state.lockstep:
            return True
        earned = _PACE * max(at - self._credited, 0.0) / max(state.period, _SHORTEST_PERIOD)
        self._credit, self._credited = min(self.burst, self._credit + earned), at
        if self._credit < 1.0:
            return False
        self._credit -= 1.0
        return True

    def is_complete(self, topics: Sequence[Topic], slack: Mapping[Topic, int]) -> bool:
        """Whether all inputs are there: of the state's tick or, in real time, at most ``slack`` ticks older."""
        # No slack in lockstep: experiments must be reproducible, whatever the timing.
        slack = _NO_SLACK if self.state.lockstep else slack
        # Called for every message; a loop takes half the time of `all` with a generator.
        for topic in topics:
            message = self.inputs.get(topic)
            if message is None or message.epoch != self.state.epoch:
                return False
            if not 0 <= self.state.tick - message.tick <= slack.get(topic, 0):
                return False
        return True

    def keep(self, topic: Topic, message: Message) -> bool:
        """Stores an input if it is newer than the stored one; returns whether it was."""
        # Of an earlier start of the robot, or of a new one whose first state has not arrived. An input that still
        # matters is sent again, because the robot repeats its state until it has an action.
        if message.epoch != self.state.epoch:
            return False
        known = self.inputs.get(topic)
        if known is not None and known.epoch == message.epoch and known.tick >= message.tick:
            return False
        self.inputs[topic] = message
        return True

    def given(self, topics: Sequence[Topic], slack: Mapping[Topic, int]) -> Inputs:
        """Returns the inputs of a step; missing or outdated ones are ``Stale``."""
        slack, state, found = _NO_SLACK if self.state.lockstep else slack, self.state, dict[Topic, Message | Stale]()
        for topic in topics:
            message = self.inputs.get(topic)
            if message is None or message.tick != state.tick or message.epoch != state.epoch:
                found[topic] = _usable(topic, message, state, slack.get(topic, 0))
            else:
                found[topic] = message
        return found


def _usable(topic: Topic, message: Message | None, state: StateMessage, slack: int) -> Message | Stale:
    """Returns the message, or ``Stale`` if it is of another epoch or a later tick, or older than allowed."""
    if message is None or message.epoch != state.epoch:
        return Stale(topic, None)
    age = state.tick - message.tick
    return message if 0 <= age <= max(topic.largest_age_ticks, slack) else Stale(topic, max(age, 0))


def heartbeat(service: str, slot: RobotSlot | None, unserved: HeartbeatCounts, model: str) -> HealthMessage:
    """Returns the heartbeat of ``service`` about one robot, or about none (``slot`` is None).

    ``unserved`` counts rejected messages that belong to no served robot; they are included for every robot.
    """
    counts = unserved if slot is None else slot.counts
    refused = counts.refused if slot is None else counts.refused + unserved.refused
    return HealthMessage(
        **header(slot.state if slot else None),
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
        supervised=is_supervised(),
    )
