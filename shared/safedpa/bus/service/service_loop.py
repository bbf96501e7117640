"""The loop of every service, written once: collect the inputs of a tick, step, publish, tell the own health.

In lockstep a node steps when every input of the state's tick is there, however long it takes; the robot repeats its
state meanwhile and a repeated tick is answered with the same output again. In real time it steps at the latest when its
share of the period is over, with the missing inputs named as stale. A robot that restarts has a new epoch; messages
of a second robot under a name in use are refused.

Any number of robots is served, each for itself. In one turn every robot gets at most one step and a few messages are
taken of each, those that wait longest first; only robots of which something came, or whose moment has come, are looked
at. What one of them says, and whatever its step raises, is refused, counted and told under its own name.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from safedpa.bus.messages.messages import SetupMessage, StateMessage
from safedpa.bus.messages.service_info import SETUP_SECONDS
from safedpa.bus.messages.topics import ACTION, HEALTH, SETUP, STATE
from safedpa.bus.service.handshake import ModelHandshake
from safedpa.bus.service.node import AbstractNode, Inputs, Outputs, Stale
from safedpa.bus.service.robot_slot import NO_ROBOT, ComputationTrace, HeartbeatCounts, RobotSlot, consumed, heartbeat
from safedpa.bus.service.scheduler import MAX_HOLD_SECONDS, Scheduler, TimerQueue, batch_interval
from safedpa.bus.service.service_log import ServiceLog
from safedpa.bus.transport.bus import Bus
from safedpa.bus.transport.inbox import ReceivedMessage, RejectedMessage
from safedpa.errors import BusError, InputError

__all__ = ["NO_ROBOT", "ServiceLoop"]

_HEARTBEAT_SECONDS = 0.25
_SILENCE_SECONDS = 0.3
"""A robot that was silent for so long may restart under its name; one that speaks is not replaced."""

_FINISH_SHARE = 0.1
"""Of the period: the pause after a step before what no one waits for; the tick is usually over by then."""
_LATEST_FINISH_SHARE = 0.5
"""Of the period: until then it also gives way to whatever waits in the inbox."""

_FORGET_SECONDS = 30.0
"""A robot that was silent for so long has left."""
_MOST_ROBOTS = 1000
"""Names of robots that are served at once; further ones are refused, anyone who makes them up."""
_MOST_PER_KEY = 4
"""Messages of one topic of one robot that are taken in one turn."""
_SPREAD = 0.618
"""Golden ratio: so many heartbeats spread over their period best, however many robots there are."""
_NO_INPUTS: Inputs = {}
_NOT_A_ROBOTS = (BusError, MemoryError)
"""Errors of the process itself: it ends, and anyone who watches it starts it again."""


class ServiceLoop:
    """Runs one node for every robot that appears in the bus's fleet (or for one robot by name)."""

    def __init__(
        self,
        node: AbstractNode,
        bus: Bus,
        robot: str = "*",
        clock: Callable[[], float] = time.monotonic,
        setup: SetupMessage | None = None,
        service_log: ServiceLog | None = None,
    ) -> None:
        self._service_log = service_log or ServiceLog.silent()
        self._node = node
        self._bus = bus
        self.clock = clock
        self.inbox = bus.inbox(
            tuple(dict.fromkeys((STATE, *node.inputs, *node.sensor_inputs, *node.listens))), robot, clock=clock
        )
        self._handshake = ModelHandshake(node, bus, self.inbox, clock, self._failed)
        self._slots: dict[str, RobotSlot] = {}
        self._spoken_of: dict[str, float] = {}
        """s; when a robot that was not heard itself was spoken of last."""
        self._timers = TimerQueue()
        self._touched: dict[str, None] = {}
        """Robots of which something came since the last look, in that order."""
        self._strangers = HeartbeatCounts()
        """What came from no one who is served."""
        self._next_heartbeat = clock()
        self.quantum = 0.0
        """s from one batch to the next; 0: each message as it comes."""
        self._setup, self._next_setup = setup, clock()

    def run(self, stopped: Callable[[], bool]) -> None:
        """Turns until ``stopped`` says so, then until the node may end, 5 s at most; looks four times a second."""
        Scheduler((self,)).run(stopped)

    def wind_up(self) -> None:
        """Tells the node that the process shall end."""
        self._node.wind_up()

    @property
    def is_needed(self) -> bool:
        """After ``wind_up``: whether something is left to do for any robot that still speaks."""
        return any(map(self._needs_us, self._slots))

    def _needs_us(self, robot: str) -> bool:
        slot = self._slots[robot]
        speaks = self.clock() - slot.heard <= max(_SILENCE_SECONDS, 3.0 * slot.state.period)
        return speaks and not self._node.at_rest(robot)

    def turn(self, longest_wait: float) -> None:
        """Takes what arrived, steps what is due, sends heartbeats and forgets who left when it is time."""
        self.serve(longest_wait)
        self._keep_house()

    def serve(self, longest_wait: float) -> None:
        """Takes what arrived, steps what is due, and does what no one waits for when its moment has come."""
        wait = self.patience(longest_wait) if longest_wait > 0.0 else 0.0
        for item in self.inbox.take(wait, _MOST_PER_KEY):
            if isinstance(item, RejectedMessage):
                self._refuse(item.reason, item.robot)
            else:
                self._take(item)
        for known in self._handshake.ready():
            self._take_known(known)
        slots = self._slots
        self._touched.update(dict.fromkeys(filter(self._is_awaited, self._timers.due(self.clock()))))
        if self._touched:
            touched, self._touched = self._touched, {}
            self._serve([(robot, slots[robot]) for robot in touched if robot in slots])

    def _keep_house(self) -> None:
        if self.clock() >= self._next_heartbeat:
            self._next_heartbeat = self.clock() + _HEARTBEAT_SECONDS
            self._forget_silent()
            if not self._slots:
                self._report_health(NO_ROBOT, None)
            self._report_of_silent()
            self._report_setup()

    def _report_of_silent(self) -> None:
        """Who speaks is told of when it speaks; waking up for each heartbeat would cost more than the heartbeat."""
        silent = [entry for entry in self._slots.items() if entry[1].next_heartbeat <= self.clock()]
        self._hold_for(silent)
        for robot, slot in silent:
            self._report_health(robot, slot)
        self._bus.flush()

    def patience(self, longest_wait: float) -> float:
        """s until something is due, at most ``longest_wait``."""
        moment = min(self._timers.next(self._is_awaited), self._handshake.deadline(), self._next_heartbeat)
        return max(0.0, min(longest_wait, moment - self.clock()))

    def _is_awaited(self, robot: str) -> bool:
        """Whether something is left to do for the robot in the tick of its state."""
        slot = self._slots.get(robot)
        return slot is not None and (slot.outputs is None or slot.unfinished_since is not None)

    def _serve(self, touched: list[tuple[str, RobotSlot]]) -> None:
        """Steps first, of robots that do not wait for us before those that do; then what no one waits for."""
        self._step_all(touched)
        self._hold_for(touched)
        now = self.clock()
        for robot, slot in touched:
            if slot.unfinished_since is not None and now >= slot.unfinished_since + _FINISH_SHARE * slot.state.period:
                if self.inbox.waiting and now < slot.unfinished_since + _LATEST_FINISH_SHARE * slot.state.period:
                    self._timers.at(now, robot)
                    continue
                self._finish(robot, slot)
            if now >= slot.next_heartbeat:
                self._report_health(robot, slot)
        self._bus.flush()

    def _step_all(self, touched: list[tuple[str, RobotSlot]]) -> None:
        """Steps what is due. With many robots the outputs go out together, but no later than the limit."""
        due = [entry for entry in touched if entry[1].outputs is None]
        if len(due) > 1:
            due.sort(key=lambda entry: entry[1].state.lockstep)
        self._hold_for(due)
        held_since = self.clock()
        for robot, slot in due:
            self._advance(robot, slot)
            if self.clock() - held_since >= MAX_HOLD_SECONDS:
                self._bus.flush()
                self._hold_for(due)
                held_since = self.clock()
        self._bus.flush()
        now = self.clock()  # one moment for all of them: what comes afterwards comes together, too
        for robot, slot in due:
            if slot.unfinished_since is not None and not self._node.lingers:
                self._finish(robot, slot)
            elif slot.unfinished_since is not None:
                slot.unfinished_since = now
                self._timers.at(now + _FINISH_SHARE * slot.state.period, robot)

    def _hold_for(self, touched: list[tuple[str, RobotSlot]]) -> None:
        """Whether what is said now travels together: while batches are made, or of robots that speak together."""
        if self.quantum > 0.0 or (len(touched) > 1 and any(slot.bundled for _, slot in touched)):
            self._bus.hold()

    @property
    def wanted_quantum(self) -> float:
        """s from one batch to the next that suits the robots served now; see ``batch_interval``."""
        apart = [slot.state for slot in self._slots.values() if not slot.bundled]  # the others come in batches anyway
        periods = [0.0 if state.lockstep else state.period for state in apart]
        return batch_interval(periods, coalescing=self.quantum > 0.0)

    def coalesce(self, quantum: float) -> None:
        """From now on takes in batches what comes, and sends so what goes out; 0: each message as it comes."""
        if quantum != self.quantum:
            self.quantum = quantum
            self.inbox.coalesce(quantum)

    def _take(self, item: ReceivedMessage) -> None:
        robot, topic, node = item.robot, item.topic, self._node
        known = robot in self._slots  # then it was greeted, too
        if not known and not self._has_room_for(robot):
            self._refuse(f"got robot '{robot}' next to {_MOST_ROBOTS} others; start another service for some")
            return
        if topic in node.listens:
            self._hear(item)
        if (topic is STATE or topic in node.inputs or topic in node.sensor_inputs) and (
            known or not self._handshake.holds(item)
        ):
            self._take_known(item)

    def _has_room_for(self, robot: str) -> bool:
        if robot not in self._spoken_of and len(self._slots) + len(self._spoken_of) >= _MOST_ROBOTS:
            return False
        self._spoken_of[robot] = self.clock()
        return True

    def _take_known(self, item: ReceivedMessage) -> None:
        if item.topic is STATE:
            self._take_state(item)
            return
        slot = self._slots.get(item.robot)
        if slot is not None and slot.keep(item.topic, item.message):
            self._touched[item.robot] = None

    def _hear(self, item: ReceivedMessage) -> None:
        try:
            self._node.hear(item.robot, item.message)
        except _NOT_A_ROBOTS:
            raise
        except Exception as error:  # noqa: BLE001  whatever one robot's message brings about, the others are served on
            self._failed(item.robot, error)

    def _take_state(self, item: ReceivedMessage) -> None:
        state = item.message
        assert isinstance(state, StateMessage)
        slot = self._slots.get(item.robot)
        if slot is not None and state.epoch == slot.state.epoch and state.tick > slot.state.tick:
            self._take_tick(item, slot, state)
        elif slot is None or self._is_new_epoch(slot, state, item.at):
            self._begin(item, state, again=slot is not None)
        elif state.epoch != slot.state.epoch:
            self._refuse(f"a second robot speaks as '{item.robot}'", item.robot, state.tick, second=True)
        elif state.tick < slot.state.tick:
            self._refuse(f"state of tick {state.tick} after tick {slot.state.tick}", item.robot, state.tick)
        else:
            slot.heard = item.at
            if slot.outputs is not None:  # the robot still waits: something on the way was lost or started late
                self._publish(item.robot, slot.outputs)

    def _begin(self, item: ReceivedMessage, state: StateMessage, *, again: bool) -> None:
        """A robot that is new, or restarted."""
        robot, at = item.robot, item.at
        self._node.forget(robot)
        self._slots[robot] = slot = RobotSlot(state, at, at, self.clock(), item.bundled)
        slot.keeps_pace(state, at)
        self._spoken_of.pop(robot, None)
        self._service_log.met(robot, state.tick, again=again)
        self._next_setup = self.clock()  # anyone who records the robot shall know the setup from the first seconds on
        self._expect(robot, slot)

    def _take_tick(self, item: ReceivedMessage, slot: RobotSlot, state: StateMessage) -> None:
        robot, at = item.robot, item.at
        slot.heard = at
        if not slot.keeps_pace(state, at):
            reason = f"got states far faster than their period of {state.period:g} s; sense less often, or say so"
            self._refuse(reason, robot, state.tick)
            return
        if slot.unfinished_since is not None:
            self._finish(robot, slot)
        if slot.outputs is None and slot.prepared:
            slot.skipped.append(float(slot.state.tick))
        slot.state, slot.arrived, slot.bundled, slot.outputs, slot.prepared = state, at, item.bundled, None, False
        self._expect(robot, slot)

    def _expect(self, robot: str, slot: RobotSlot) -> None:
        """Looks at the robot now, and again when in real time its share of the period is over."""
        self._touched[robot] = None
        if self._node.needs(slot.state):  # else it is stepped now
            self._timers.at(self._deadline(slot), robot)  # in lockstep never: it waits for its inputs alone

    def _deadline(self, slot: RobotSlot) -> float:
        return float("inf") if slot.state.lockstep else slot.arrived + self._node.share * slot.state.period

    def _is_new_epoch(self, slot: RobotSlot, state: StateMessage, at: float) -> bool:
        return state.epoch != slot.state.epoch and at - slot.heard > max(_SILENCE_SECONDS, 3.0 * slot.state.period)

    def _advance(self, robot: str, slot: RobotSlot) -> None:
        if slot.is_complete(self._node.needs(slot.state), self._node.slack) or self.clock() >= self._deadline(slot):
            self._step(robot, slot)
        elif not slot.prepared:
            slot.prepared = True
            try:
                self._node.prepare(robot, slot.state)
            except _NOT_A_ROBOTS:
                raise
            except Exception as error:  # noqa: BLE001  the step will say what it comes to
                self._failed(robot, error, slot.state.tick)

    def _step(self, robot: str, slot: RobotSlot) -> None:
        node = self._node
        needs = node.needs(slot.state)
        inputs = slot.given(needs, node.slack) if needs else _NO_INPUTS
        read = consumed(needs, inputs, slot.state) if needs else ()
        skipped: tuple[float, ...] = ()
        if slot.skipped:
            skipped = tuple(slot.skipped)
            slot.skipped.clear()
        slot.trace = ComputationTrace(slot.trace.step + 1, read, skipped)
        started = time.perf_counter()
        try:
            outputs = slot.trace.on(node.step(robot, slot.state, inputs))
            slot.counts.microseconds = 1e6 * (time.perf_counter() - started)
            self._publish(robot, outputs)
        except _NOT_A_ROBOTS:
            raise
        except Exception as error:  # noqa: BLE001  what one robot brings about must not end the service of the others
            self._rescue(robot, slot, error)
            return
        slot.outputs, counts = outputs, slot.counts
        self._service_log.notice(robot, outputs)
        late = [item.sentence for item in inputs.values() if type(item) is Stale] if needs else []
        counts.failing, counts.detail = False, "; ".join(late) if late else ""
        counts.steps += 1
        counts.stale += bool(late)
        slot.unfinished_since = self.clock()
        if slot.state.lockstep:
            self._finish(robot, slot)

    def _rescue(self, robot: str, slot: RobotSlot, error: Exception) -> None:
        """The step failed: the node says what is right for this robot then, from as little as possible."""
        slot.outputs, slot.unfinished_since, slot.counts.failing = {}, None, True
        reason = self._failed(robot, error, slot.state.tick)
        try:
            outputs = slot.trace.on(self._node.rescue(robot, slot.state, reason))
            self._publish(robot, outputs)
            slot.outputs = outputs
            self._service_log.notice(robot, outputs)
        except _NOT_A_ROBOTS:
            raise
        except Exception as again:  # noqa: BLE001  then the robot's own watchdog acts
            self._failed(robot, again, slot.state.tick)

    def _finish(self, robot: str, slot: RobotSlot) -> None:
        """What no one waits for; in real time a little later, when the processor is not needed by those on the way."""
        slot.unfinished_since = None
        try:
            further = self._node.afterwards(robot)
            if further:
                self._publish(robot, slot.trace.on(further))
        except _NOT_A_ROBOTS:
            raise
        except Exception as error:  # noqa: BLE001  the action is on its way; the others are served on
            self._failed(robot, error, slot.state.tick)
            return
        if further:
            self._service_log.notice(robot, further)
            slot.outputs = {**(slot.outputs or {}), **further}

    def _publish(self, robot: str, outputs: Outputs) -> None:
        publish, service = self._bus.publish, self._node.name
        for topic, message in outputs.items():
            alone = topic is ACTION and not self._slots[robot].bundled  # a robot may not see what others are told
            publish(topic, robot, message, service, alone=alone)

    def _forget_silent(self) -> None:
        oldest = self.clock() - _FORGET_SECONDS
        for robot in [robot for robot, slot in self._slots.items() if slot.heard < oldest]:
            del self._slots[robot]
            self._leave(robot)
            self._service_log.forgot(robot)
        for robot in [robot for robot, at in self._spoken_of.items() if at < oldest]:
            del self._spoken_of[robot]
            self._leave(robot)

    def _leave(self, robot: str) -> None:
        self._node.leave(robot)
        self._handshake.forget(robot)
        self._bus.forget(robot)

    def _refuse(self, reason: str, robot: str = "", tick: int = -1, *, second: bool = False) -> None:
        """Counts what was not taken: for its robot, or for no one where that one is not served."""
        self._service_log.refused(reason, robot, tick, second=second)
        slot = self._slots.get(robot)
        counts = self._strangers if slot is None else slot.counts
        counts.refused += 1
        counts.detail = f"refused: {reason}"

    def _failed(self, robot: str, error: Exception, tick: int = -1) -> str:
        """Counts and tells what a robot brought about; returns it in words."""
        if isinstance(error, InputError):
            self._refuse(str(error), robot, tick)
            return str(error)
        reason = f"{type(error).__name__}: {error}"
        self._service_log.failed(reason, error, robot, tick)
        slot = self._slots.get(robot)
        (self._strangers if slot is None else slot.counts).detail = f"failed: {reason}"
        return reason

    def _report_setup(self) -> None:
        if self._setup is not None and self.clock() >= self._next_setup:
            self._next_setup = self.clock() + SETUP_SECONDS
            self._bus.publish(SETUP, NO_ROBOT, self._setup, self._node.name)

    def _report_health(self, robot: str, slot: RobotSlot | None) -> None:
        if slot is not None:
            share = 1.0 if slot.reported else (_SPREAD * len(self._slots)) % 1.0
            slot.reported, slot.next_heartbeat = True, self.clock() + share * _HEARTBEAT_SECONDS
        message = heartbeat(self._node.name, slot, self._strangers, self._node.model_of(robot) if slot else "")
        self._bus.publish(HEALTH, robot, message, self._node.name)
