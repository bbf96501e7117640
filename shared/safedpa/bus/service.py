"""The loop of every service, written once: collect the inputs of a tick, step, publish, tell the own health.

In lockstep a node steps when every input of the state's tick is there, however long it takes; the robot repeats its
state meanwhile and a repeated tick is answered with the same output again. In real time it steps at the latest when its
share of the period is over, with the missing inputs named as stale. A robot that starts anew has a new epoch; messages
of a second robot under a name in use are refused.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from safedpa.bus.bus import Bus
from safedpa.bus.greeting import Greeting
from safedpa.bus.inbox import Received, Refused
from safedpa.bus.journal import Journal
from safedpa.bus.messages import HealthMessage, Message, SetupMessage, StateMessage
from safedpa.bus.node import AbstractNode, Inputs, Outputs, Stale
from safedpa.bus.setup import SETUP_SECONDS
from safedpa.bus.topics import HEALTH, SETUP, STATE, Topic
from safedpa.bus.trace import Trace, consumed
from safedpa.bus.version import software_version
from safedpa.errors import InputError

__all__ = ["NO_ROBOT", "ServiceLoop"]

NO_ROBOT = "-"
"""Stands for the robot in the health key of a service that serves none yet."""

_HEARTBEAT_SECONDS = 0.25
_SILENCE_SECONDS = 0.3
"""A robot that was silent for so long may start anew under its name; one that speaks is not replaced."""

_FINISH_SHARE = 0.1
"""Of the period: the pause after a step before what nobody waits for; the tick is usually over by then."""

_LONGEST_END_SECONDS = 5.0
"""A car brakes from full speed to a stand in 1.2 s; a container gets 10 s before it is killed."""
_END_TURN_SECONDS = 0.05
_FORGET_SECONDS = 30.0
"""A robot that was silent for so long has left."""


@dataclass
class _Slot:
    """What the loop knows of one robot."""

    state: StateMessage
    arrived: float
    """s; when the state of this tick came first: from here the share of the period counts."""
    heard: float
    """s; when the robot spoke last, be it a repetition."""
    inputs: dict[Topic, Message] = field(default_factory=dict)
    outputs: Outputs | None = None
    """Of the state's tick; None while the step is due."""
    unfinished_since: float | None = None
    """When the step of the state's tick ended, while what comes afterwards is still to be done."""
    prepared: bool = False
    """Whether the node was shown the state before its step."""
    trace: Trace = field(default_factory=Trace)
    """Of the newest step."""
    skipped: list[float] = field(default_factory=list)
    """Ticks since then whose states the node was shown, but did not step."""


@dataclass
class _Counts:
    steps: int = 0
    stale: int = 0
    refused: int = 0
    microseconds: float = 0.0
    failing: bool = False
    detail: str = ""


class ServiceLoop:
    """Runs one node for every robot that appears in the bus's fleet (or for one robot by name)."""

    def __init__(
        self,
        node: AbstractNode,
        bus: Bus,
        robot: str = "*",
        clock: Callable[[], float] = time.monotonic,
        setup: SetupMessage | None = None,
        journal: Journal | None = None,
    ) -> None:
        self._journal = journal or Journal.silent()
        self._node = node
        self._bus = bus
        self._clock = clock
        self._inbox = bus.inbox(tuple(dict.fromkeys((STATE, *node.inputs, *node.listens))), robot, clock=clock)
        self._greeting = Greeting(node, bus, self._inbox, clock)
        self._slots: dict[str, _Slot] = {}
        self._counts = _Counts()
        self._next_heartbeat = clock()
        self._setup, self._next_setup = setup, clock()

    def run(self, stopped: Callable[[], bool]) -> None:
        """Turns until ``stopped`` says so, then until the node may end, 5 s at most; looks four times a second."""
        while not stopped():
            self.turn(_HEARTBEAT_SECONDS)
        self._wind_up()

    def _wind_up(self) -> None:
        """Goes on until nothing is left to do for any robot that still speaks, but not for ever."""
        self._node.wind_up()
        end = self._clock() + _LONGEST_END_SECONDS
        while self._clock() < end and any(map(self._needs_us, self._slots)):
            self.turn(_END_TURN_SECONDS)

    def _needs_us(self, robot: str) -> bool:
        slot = self._slots[robot]
        speaks = self._clock() - slot.heard <= max(_SILENCE_SECONDS, 3.0 * slot.state.period)
        return speaks and not self._node.at_rest(robot)

    def turn(self, longest_wait: float) -> None:
        """Takes what arrived, steps what is due, sends a heartbeat when it is time."""
        for item in self._inbox.take(self._patience(longest_wait)):
            if isinstance(item, Refused):
                self._refuse(item.reason, item.robot)
            else:
                self._take(item)
        for known in self._greeting.ready():
            self._take_known(known)
        for robot, slot in self._slots.items():
            if slot.outputs is None:
                self._advance(robot, slot)
            elif self._clock() >= self._finish_at(slot):
                self._finish(robot, slot)
        if self._clock() >= self._next_heartbeat:
            self._next_heartbeat = self._clock() + _HEARTBEAT_SECONDS
            self._forget_silent()
            self._tell_health()
            self._tell_setup()

    def _patience(self, longest_wait: float) -> float:
        now = self._clock()
        due = [self._deadline(slot) if slot.outputs is None else self._finish_at(slot) for slot in self._slots.values()]
        return max(0.0, min(longest_wait, min((*due, self._greeting.deadline())) - now))

    def _finish_at(self, slot: _Slot) -> float:
        if slot.unfinished_since is None:
            return float("inf")
        return slot.unfinished_since + _FINISH_SHARE * slot.state.period

    def _deadline(self, slot: _Slot) -> float:
        if slot.state.lockstep:
            return float("inf")
        return slot.arrived + self._node.share * slot.state.period

    def _take(self, item: Received) -> None:
        if item.topic in self._node.listens:
            self._hear(item)
        if (item.topic is STATE or item.topic in self._node.inputs) and not self._greeting.holds(item):
            self._take_known(item)

    def _take_known(self, item: Received) -> None:
        if item.topic is STATE:
            self._take_state(item)
        else:
            self._take_input(item)

    def _hear(self, item: Received) -> None:
        try:
            self._node.hear(item.robot, item.message)
        except InputError as error:
            self._refuse(str(error), item.robot, item.message.tick)

    def _take_state(self, item: Received) -> None:
        state = item.message
        assert isinstance(state, StateMessage)
        slot = self._slots.get(item.robot)
        if slot is None or self._is_new_epoch(slot, state, item.at):
            self._node.forget(item.robot)
            self._journal.met(item.robot, state.tick, again=slot is not None)
            self._slots[item.robot] = _Slot(state, item.at, item.at)
        elif state.epoch != slot.state.epoch:
            self._refuse(f"a second robot speaks as '{item.robot}'", item.robot, state.tick, second=True)
        elif state.tick < slot.state.tick:
            self._refuse(f"state of tick {state.tick} after tick {slot.state.tick}", item.robot, state.tick)
        elif state.tick > slot.state.tick:
            if slot.unfinished_since is not None:
                self._finish(item.robot, slot)
            if slot.outputs is None and slot.prepared:
                slot.skipped.append(float(slot.state.tick))
            slot.state, slot.arrived, slot.heard = state, item.at, item.at
            slot.outputs, slot.prepared = None, False
        else:
            slot.heard = item.at
            if slot.outputs is not None:  # the robot still waits: something on the way was lost or started late
                self._publish(item.robot, slot.outputs)

    def _is_new_epoch(self, slot: _Slot, state: StateMessage, at: float) -> bool:
        return state.epoch != slot.state.epoch and at - slot.heard > max(_SILENCE_SECONDS, 3.0 * slot.state.period)

    def _take_input(self, item: Received) -> None:
        slot = self._slots.get(item.robot)
        if slot is None or item.message.epoch != slot.state.epoch:
            return  # of a robot not heard yet, or of an epoch that ended: repeated if it still matters
        known = slot.inputs.get(item.topic)
        if known is None or known.epoch != item.message.epoch or known.tick < item.message.tick:
            slot.inputs[item.topic] = item.message

    def _is_due(self, slot: _Slot) -> bool:
        if all(_fits(slot.inputs.get(topic), slot.state) for topic in self._node.inputs):
            return True
        return self._clock() >= self._deadline(slot)

    def _advance(self, robot: str, slot: _Slot) -> None:
        if self._is_due(slot):
            self._step(robot, slot)
        elif not slot.prepared:
            slot.prepared = True
            self._node.prepare(robot, slot.state)

    def _step(self, robot: str, slot: _Slot) -> None:
        inputs = self._inputs(slot)
        read = consumed(self._node.inputs, inputs, slot.state)
        slot.trace, slot.skipped = Trace(slot.trace.step + 1, read, tuple(slot.skipped)), []
        started = time.perf_counter()
        try:
            slot.outputs = slot.trace.on(self._node.step(robot, slot.state, inputs))
            self._counts.microseconds = 1e6 * (time.perf_counter() - started)
            self._publish(robot, slot.outputs)
            self._journal.said(robot, slot.outputs)
        except InputError as error:  # what one robot says must not end the service of the others
            slot.outputs = {}
            self._counts.failing = True
            self._refuse(str(error), robot, slot.state.tick)
            return
        self._counts.failing = False
        self._counts.steps += 1
        late = [item.sentence for item in inputs.values() if isinstance(item, Stale)]
        self._counts.stale += bool(late)
        self._counts.detail = "; ".join(late)
        slot.unfinished_since = self._clock()
        if slot.state.lockstep:
            self._finish(robot, slot)

    def _finish(self, robot: str, slot: _Slot) -> None:
        """What nobody waits for; in real time a little later, when the processor is not needed by those on the way."""
        slot.unfinished_since = None
        further = slot.trace.on(self._node.afterwards(robot))
        self._publish(robot, further)
        self._journal.said(robot, further)
        slot.outputs = {**(slot.outputs or {}), **further}

    def _inputs(self, slot: _Slot) -> Inputs:
        return {topic: _usable(topic, slot.inputs.get(topic), slot.state) for topic in self._node.inputs}

    def _publish(self, robot: str, outputs: Outputs) -> None:
        for topic, message in outputs.items():
            self._bus.publish(topic, robot, message, self._node.name)

    def _forget_silent(self) -> None:
        oldest = self._clock() - _FORGET_SECONDS
        for robot in [robot for robot, slot in self._slots.items() if slot.heard < oldest]:
            self._node.forget(robot)
            self._journal.forgot(robot)
            self._greeting.forget(robot)
            del self._slots[robot]

    def _refuse(self, reason: str, robot: str = "", tick: int = -1, *, second: bool = False) -> None:
        self._journal.refused(reason, robot, tick, second=second)
        self._counts.refused += 1
        self._counts.detail = f"refused: {reason}"

    def _tell_setup(self) -> None:
        if self._setup is not None and self._clock() >= self._next_setup:
            self._next_setup = self._clock() + SETUP_SECONDS
            self._bus.publish(SETUP, NO_ROBOT, self._setup, self._node.name)

    def _tell_health(self) -> None:
        counts = self._counts
        for robot in self._slots or (NO_ROBOT,):
            slot = self._slots.get(robot)
            message = HealthMessage(
                epoch=slot.state.epoch if slot else 0,
                tick=slot.state.tick if slot else 0,
                robot_time=slot.state.robot_time if slot else 0.0,
                publish_time=time.time(),
                service=self._node.name,
                pid=os.getpid(),
                state="failing" if counts.failing else "running" if slot else "ready",
                detail=counts.detail,
                steps=counts.steps,
                stale=counts.stale,
                refused=counts.refused,
                step_microseconds=counts.microseconds,
                model=self._node.model_of(robot) if slot else "",
                software=software_version(),
            )
            self._bus.publish(HEALTH, robot, message, self._node.name)


def _fits(message: Message | None, state: StateMessage) -> bool:
    return message is not None and message.epoch == state.epoch and message.tick == state.tick


def _usable(topic: Topic, message: Message | None, state: StateMessage) -> Message | Stale:
    """The message, unless it is of another epoch, of a later tick, or older than the topic allows."""
    if message is None or message.epoch != state.epoch:
        return Stale(topic, None)
    age = state.tick - message.tick
    return message if 0 <= age <= topic.largest_age_ticks else Stale(topic, max(age, 0))
