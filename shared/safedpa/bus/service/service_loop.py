"""The loop of every service: collect the inputs of a tick, step the node, publish its outputs, send heartbeats.

In lockstep, a node steps once every input of the state's tick is there, however long that takes. The robot repeats its
state meanwhile, and a repeated state is answered with the same outputs. In real time, the node steps at the latest
when its share of the period is over; missing inputs are then marked as stale. A robot that restarts has a new epoch.
Messages of a second robot under a name in use are rejected.

The loop serves any number of robots independently. In one turn every robot gets at most one step, and only a few
messages per robot and topic are read, oldest first. Only robots with new messages or due timers are handled. Invalid
messages and exceptions of a step are counted and logged for the robot concerned and do not affect the others.

Batching: with many robots, a loop handles messages in batches, a few hundred times a second, like interrupt coalescing
in network cards. A message that wakes a process on its own takes several times the CPU time of one in a batch: two
thread switches, cold caches, and a separate packet for the answer. With one robot no message waits. With many, each
loop between sense and act adds at most one batch interval to the latency, which may reach 0.9 of the period.

Threads: the thread that delivers a message runs the loop itself, unless another thread does so; it never waits for the
loop. Waking another thread would add 100 to 150 us at each hop from sense to act. Work that no message triggers runs on
the main thread. In batch mode, messages gather outside Python and only the main thread runs the loops.
"""

from __future__ import annotations

import heapq
import threading
import time
from collections.abc import Callable, Sequence
from math import inf
from typing import final

from safedpa.bus.messages.messages import SetupMessage, StateMessage
from safedpa.bus.messages.service_info import SETUP_SECONDS
from safedpa.bus.messages.topics import ACTION, HEALTH, NO_ROBOT, SETUP, STATE
from safedpa.bus.service.handshake import ModelHandshake
from safedpa.bus.service.node import AbstractNode, Inputs, Outputs, Stale
from safedpa.bus.service.robot_slot import (
    LONG_BURST,
    ComputationTrace,
    HeartbeatCounts,
    RobotSlot,
    consumed,
    heartbeat,
)
from safedpa.bus.service.service_log import ServiceLog
from safedpa.bus.transport.bus import Bus
from safedpa.bus.transport.inbox import ReceivedMessage, RejectedMessage
from safedpa.errors import BusError, InputError

# Longest wait for a message, so that `stopped` and the batch interval are checked even if no message arrives.
_LONGEST_WAIT_SECONDS = 0.25
# Time limit of the shutdown: a car brakes from full speed in 1.2 s, and Docker kills a container after 10 s.
SHUTDOWN_SECONDS = 5.0
# Longest wait while shutting down, so that the process ends soon after the last robot has stopped.
_SHUTDOWN_WAIT_SECONDS = 0.05


@final
class TimerQueue:
    """Timers [s] by robot. A timer cannot be cancelled; handling a robot once too often is cheap."""

    # Robots that are served together have equal due times, so the heap has one entry for all of them.

    def __init__(self) -> None:
        self._times: list[float] = []
        self._robots: dict[float, list[str]] = {}
        """Robots by due time."""

    def at(self, when: float, robot: str) -> None:
        """Adds a timer; an infinite time is ignored."""
        robots = self._robots.get(when)
        if robots is not None:
            robots.append(robot)
        elif when < inf:
            self._robots[when] = [robot]
            heapq.heappush(self._times, when)

    def due(self, now: float) -> list[str]:
        """Removes and returns the robots whose timers are due, earliest first, each once."""
        times = self._times
        if not times or times[0] > now:
            return []
        found: dict[str, None] = {}
        while times and times[0] <= now:
            found.update(dict.fromkeys(self._robots.pop(heapq.heappop(times))))
        return list(found)

    def next(self, awaited: Callable[[str], bool] | None = None) -> float:
        """Returns the earliest due time; infinite without timers.

        Removes timers of which no robot satisfies ``awaited``, so that the loop does not wake up for them.
        """
        times = self._times
        while awaited is not None and times and not any(map(awaited, self._robots[times[0]])):
            del self._robots[heapq.heappop(times)]
        return times[0] if times else inf

    def __len__(self) -> int:
        return sum(map(len, self._robots.values()))


# Number of robots from which batching is used: with fewer, waiting adds latency and too few messages share a wake-up.
# Batching ends only below the second number, so that one robot that joins and leaves does not switch it repeatedly.
_MANY, _FEW = 8, 4
# Batch interval as a fraction of the shortest period: 1.5 ms at 20 Hz. Four loops wait in sequence. A fraction of 0.08
# tripled the latency of fifty robots and saved no CPU time.
_SHARE = 0.03
# Below this interval, the overhead of sleeping exceeds the savings.
_SHORTEST_SECONDS = 0.001
MAX_HOLD_SECONDS = 0.005
"""Longest time that an output waits for the outputs of other robots."""


def batch_interval(periods: Sequence[float], *, coalescing: bool) -> float:
    """Returns the batch interval [s] for robots with these periods [s]; 0: no batching.

    The period of a robot in lockstep is 0, which turns batching off, because the robot waits for every answer.
    ``coalescing`` is whether batching is on now.
    """
    if len(periods) < (_FEW if coalescing else _MANY):
        return 0.0
    quantum = _SHARE * min(periods)
    return quantum if quantum >= _SHORTEST_SECONDS else 0.0


@final
class Scheduler:
    """Runs the service loops of one process, in the given order, which is the order of the data flow."""

    def __init__(self, loops: Sequence[ServiceLoop]) -> None:
        self._loops = loops
        self._running = threading.Lock()
        """Held by the thread that runs the loops."""
        self._next_check = 0.0
        """Time [s] at which the batch interval is computed again."""
        self._changed = threading.Event()
        """Set when another thread has run the loops, after which other timers may be due first."""

    def run(self, stopped: Callable[[], bool]) -> None:
        """Runs until ``stopped``, then until no active robot needs a service, for at most 5 s.

        Checks ``stopped`` four times a second.
        """
        for loop in self._loops:
            loop.inbox.set_listener(self._on_arrival)
        try:
            while not stopped():
                self._turn(_LONGEST_WAIT_SECONDS)
            for loop in self._loops:
                loop.begin_shutdown()
            # The filter keeps braking its robots meanwhile; leaving at once would hand each over to its own watchdog.
            clock = self._loops[0].clock
            end = clock() + SHUTDOWN_SECONDS
            while clock() < end and any(loop.is_needed for loop in self._loops):
                self._turn(_SHUTDOWN_WAIT_SECONDS)
        finally:
            for loop in self._loops:
                loop.inbox.set_listener(None)

    def _turn(self, longest_wait: float) -> None:
        """Waits, then runs the loops; on the main thread."""
        with self._running:  # the thread that runs the loops changes their timers
            wait = min(loop.wait_time(longest_wait) for loop in self._loops)
        # In batch mode the first loop's inbox sleeps for the rest of the interval instead.
        if not self._gathers:
            # If a message arrives between this check and the wait, the event is set and the wait returns at once.
            if not self._waiting:
                self._changed.wait(wait)
                self._changed.clear()
            wait = 0.0
        with self._running:
            for loop in self._loops:
                loop.turn(wait)
                wait = 0.0  # only the first loop waits; the others would wait for the same time again
            self._coalesce()

    def _coalesce(self) -> None:
        """Sets the same batch interval for all loops, because they share one wait."""
        if self._loops[0].clock() >= self._next_check:
            self._next_check = self._loops[0].clock() + _LONGEST_WAIT_SECONDS
            quantum = max(loop.preferred_quantum for loop in self._loops)
            for loop in self._loops:
                loop.coalesce(quantum)

    def _on_arrival(self) -> None:
        """Runs the loops after a message arrived; on the network's thread."""
        if self._gathers:
            return
        # Never block the network's thread. If another thread holds the lock, it takes this message, or the main thread
        # does in its next turn. Checked in a loop, because a message may arrive just before the lock is released.
        while self._waiting and self._running.acquire(blocking=False):
            try:
                for loop in self._loops:
                    loop.serve(0.0)
            finally:
                self._running.release()
        self._changed.set()  # the main thread computes its wait again

    @property
    def _gathers(self) -> bool:
        return self._loops[0].quantum > 0.0

    @property
    def _waiting(self) -> bool:
        return any(loop.inbox.waiting for loop in self._loops)


_HEARTBEAT_SECONDS = 0.25
# A name may be taken over by a new epoch (a restarted robot) after this silence. A second robot cannot displace one
# that is still sending.
_SILENCE_SECONDS = 0.3

# Fractions of the period after a step. `afterwards` runs after the first: by then the urgent work of the tick is
# usually done in all services. Up to the second it also yields to unread messages.
_FINISH_SHARE = 0.1
_LATEST_FINISH_SHARE = 0.5

# A robot that was silent for this long has left; its slot is then free for another robot.
_FORGET_SECONDS = 30.0
# Robots served at once. The names come from the network, and each takes memory.
_MOST_ROBOTS = 1000
# Messages read in one turn per topic and robot, so that one robot's backlog does not delay the others.
_MOST_PER_KEY = 4
# The golden ratio: multiples of it modulo 1 are evenly spread for any number of robots, and so are their heartbeats.
_SPREAD = 0.618
_NO_INPUTS: Inputs = {}
# Errors of the process, not of one robot: they end the process, so that its supervisor restarts it.
_PROCESS_ERRORS = (BusError, MemoryError)


class ServiceLoop:
    """Runs one node for every robot of the fleet, or for one robot by name."""

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
            tuple(dict.fromkeys((STATE, *node.inputs, *node.sensor_inputs, *node.listens))),
            robot,
            keep_all=node.every_tick,
            clock=clock,
        )
        self._handshake = ModelHandshake(node, bus, self.inbox, clock, self._failed)
        self._slots: dict[str, RobotSlot] = {}
        self._mentioned: dict[str, float] = {}
        """Robots that messages were about, but which sent no state themselves: time [s] of the last such message."""
        self._timers = TimerQueue()
        self._touched: dict[str, None] = {}
        """Robots with new messages or due timers; a dict, because it is ordered."""
        self._unserved = HeartbeatCounts()
        """Counts of messages that belong to no served robot."""
        self._next_heartbeat = clock()
        self.quantum = 0.0
        """Batch interval in s; 0: each message is handled as it arrives."""
        self._setup, self._next_setup = setup, clock()

    def run(self, stopped: Callable[[], bool]) -> None:
        """Runs until ``stopped`` returns true (checked four times a second) and the node has shut down, at most 5 s."""
        Scheduler((self,)).run(stopped)

    def begin_shutdown(self) -> None:
        """Begins the shutdown of the node."""
        # Published a last time: a recorder whose link was established late has not received it on a short drive.
        self._next_setup = self.clock()
        self._report_setup()
        self._node.begin_shutdown()

    @property
    def is_needed(self) -> bool:
        """Whether an active robot still needs the node after ``begin_shutdown``."""
        return any(map(self._is_needed_by, self._slots))

    def _is_needed_by(self, robot: str) -> bool:
        slot = self._slots[robot]
        active = self.clock() - slot.heard <= max(_SILENCE_SECONDS, 3.0 * slot.state.period)
        return active and not self._node.at_rest(robot)

    def turn(self, longest_wait: float) -> None:
        """Serves robots as ``serve`` does, then sends due heartbeats and forgets robots that left."""
        self.serve(longest_wait)
        self._housekeeping()

    def serve(self, longest_wait: float) -> None:
        """Reads messages, steps the robots that are due, and does deferred work."""
        wait = self.wait_time(longest_wait) if longest_wait > 0.0 else 0.0
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

    def _housekeeping(self) -> None:
        if self.clock() >= self._next_heartbeat:
            self._next_heartbeat = self.clock() + _HEARTBEAT_SECONDS
            self._forget_silent()
            if not self._slots:
                self._report_health(NO_ROBOT, None)
            self._report_quiet_robots()
            self._report_setup()

    def _report_quiet_robots(self) -> None:
        """Sends due heartbeats about robots that are silent."""
        # Those of active robots go out while their messages are handled: a wake-up takes longer than the heartbeat.
        silent = [entry for entry in self._slots.items() if entry[1].next_heartbeat <= self.clock()]
        self._hold_for(silent)
        for robot, slot in silent:
            self._report_health(robot, slot)
        self._bus.flush()

    def wait_time(self, longest_wait: float) -> float:
        """Returns the time in s until something is due, at most ``longest_wait``."""
        moment = min(self._timers.next(self._is_awaited), self._handshake.deadline(), self._next_heartbeat)
        return max(0.0, min(longest_wait, moment - self.clock()))

    def _is_awaited(self, robot: str) -> bool:
        """Whether the step of the robot's tick, or the deferred work after it, is still due."""
        slot = self._slots.get(robot)
        return slot is not None and (slot.outputs is None or slot.unfinished_since is not None)

    def _serve(self, touched: list[tuple[str, RobotSlot]]) -> None:
        """Steps all robots that are due, then does deferred work and sends heartbeats."""
        self._step_all(touched)
        self._hold_for(touched)
        now = self.clock()
        for robot, slot in touched:
            if slot.unfinished_since is not None and now >= slot.unfinished_since + _FINISH_SHARE * slot.state.period:
                # A waiting message may be a state whose action is urgent. Deferred work is not, until it is half a
                # period late.
                if self.inbox.waiting and now < slot.unfinished_since + _LATEST_FINISH_SHARE * slot.state.period:
                    self._timers.at(now, robot)
                    continue
                self._finish(robot, slot)
            if now >= slot.next_heartbeat:
                self._report_health(robot, slot)
        self._bus.flush()

    def _step_all(self, touched: list[tuple[str, RobotSlot]]) -> None:
        """Steps all robots that are due, and sends the outputs in bundles."""
        due = [entry for entry in touched if entry[1].outputs is None]
        # Robots in real time first (False < True): one in lockstep waits for its action as long as it takes.
        if len(due) > 1:
            due.sort(key=lambda entry: entry[1].state.lockstep)
        self._hold_for(due)
        held_since = self.clock()
        for robot, slot in due:
            self._advance(robot, slot)
            # Outputs of the first robots must not wait for the steps of hundreds of others.
            if self.clock() - held_since >= MAX_HOLD_SECONDS:
                self._bus.flush()
                self._hold_for(due)
                held_since = self.clock()
        self._bus.flush()
        # The same time for all of them, so that their deferred work is due together and its outputs form bundles.
        now = self.clock()
        for robot, slot in due:
            if slot.unfinished_since is not None and not self._node.defers_afterwards:
                self._finish(robot, slot)
            elif slot.unfinished_since is not None:
                slot.unfinished_since = now
                self._timers.at(now + _FINISH_SHARE * slot.state.period, robot)

    def _hold_for(self, touched: list[tuple[str, RobotSlot]]) -> None:
        """Starts a bundle if batching is on, or if several robots are handled whose states arrived in bundles."""
        if self.quantum > 0.0 or (len(touched) > 1 and any(slot.bundled for _, slot in touched)):
            self._bus.hold()

    @property
    def preferred_quantum(self) -> float:
        """Batch interval [s] that suits the robots served now; see ``batch_interval``."""
        # Bundled states arrive in batches already; waiting would only add latency.
        single = [slot.state for slot in self._slots.values() if not slot.bundled]
        periods = [0.0 if state.lockstep else state.period for state in single]
        return batch_interval(periods, coalescing=self.quantum > 0.0)

    def coalesce(self, quantum: float) -> None:
        """Sets the batch interval [s] for messages in both directions; 0 handles each message as it arrives."""
        if quantum != self.quantum:
            self.quantum = quantum
            self.inbox.coalesce(quantum)

    def _take(self, item: ReceivedMessage) -> None:
        robot, topic, node = item.robot, item.topic, self._node
        known = robot in self._slots  # implies that its handshake is done
        if not known and not self._has_room_for(robot):
            self._refuse(f"robot '{robot}' exceeds the limit of {_MOST_ROBOTS} robots; start another service for some")
            return
        # Not delayed by the handshake: steps of a model change must not be missed while it is pending.
        if topic in node.listens:
            self._hear(item)
        if (topic is STATE or topic in node.inputs or topic in node.sensor_inputs) and (
            known or not self._handshake.holds(item)
        ):
            self._take_known(item)

    def _has_room_for(self, robot: str) -> bool:
        # Also counts robots that were only mentioned, because the node may keep data about them.
        if robot not in self._mentioned and len(self._slots) + len(self._mentioned) >= _MOST_ROBOTS:
            return False
        self._mentioned[robot] = self.clock()
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
        except Exception as error:  # noqa: BLE001
            # An error about one robot must not end the service of the others; the same applies below.
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
            self._refuse(f"a second robot uses the name '{item.robot}'", item.robot, state.tick, second=True)
        elif state.tick < slot.state.tick:
            self._refuse(f"state of tick {state.tick} after tick {slot.state.tick}", item.robot, state.tick)
        else:
            # A repeated state: the robot has no action yet. An output was lost, or a service after this one started
            # late. Send the outputs again.
            slot.heard, slot.read = item.at, self.clock()
            if slot.outputs is not None:
                self._publish(item.robot, slot.outputs)

    def _begin(self, item: ReceivedMessage, state: StateMessage, *, again: bool) -> None:
        """Starts serving a robot that is new or has restarted."""
        robot, at = item.robot, item.at
        self._node.forget(robot)  # data of an earlier epoch is about another drive
        self._slots[robot] = slot = RobotSlot(state, at, at, now := self.clock(), now, item.bundled)
        if self._node.every_tick:
            slot.burst = LONG_BURST
        slot.keeps_pace(state, at)
        self._mentioned.pop(robot, None)
        self._service_log.met(robot, state.tick, again=again)
        self._next_setup = self.clock()  # a recording of this robot should have the setup from its first seconds
        self._expect(robot, slot)

    def _take_tick(self, item: ReceivedMessage, slot: RobotSlot, state: StateMessage) -> None:
        robot, at = item.robot, item.at
        slot.heard, slot.read = at, self.clock()
        if not slot.keeps_pace(state, at):
            reason = f"states arrive much faster than their period of {state.period:g} s; send fewer, or correct period"
            self._refuse(reason, robot, state.tick)
            return
        if slot.outputs is None and self._node.every_tick:
            self._step(robot, slot)
        # Outputs of the previous tick that were deferred until now; a node must not see the new tick before.
        if slot.unfinished_since is not None:
            self._finish(robot, slot)
        if slot.outputs is None and slot.prepared:
            slot.skipped.append(float(slot.state.tick))
        slot.state, slot.arrived, slot.bundled, slot.outputs, slot.prepared = state, at, item.bundled, None, False
        self._expect(robot, slot)

    def _expect(self, robot: str, slot: RobotSlot) -> None:
        """Handles the robot in this turn, and again at the deadline of its step."""
        self._touched[robot] = None
        # Without further inputs the step runs in this turn. In lockstep the deadline is infinite: no timer.
        if self._node.needs(slot.state):
            self._timers.at(self._deadline(slot), robot)

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
            except Exception as error:  # noqa: BLE001
                # Only logged: the step follows in any case, and if it fails, too, `rescue` decides.
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
            self._publish(robot, outputs)  # before all bookkeeping: the robot waits for it
        except Exception as error:  # noqa: BLE001
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
        """Publishes the node's safe outputs after a failed step."""
        # Empty outputs, not None: the failed step must not run again for the same tick.
        slot.outputs, slot.unfinished_since, slot.counts.failing = {}, None, True
        reason = self._failed(robot, error, slot.state.tick)
        try:
            outputs = slot.trace.on(self._node.rescue(robot, slot.state, reason))
            self._publish(robot, outputs)
            slot.outputs = outputs
            self._service_log.notice(robot, outputs)
        except Exception as again:  # noqa: BLE001
            # Without an action, the robot's own watchdog brakes.
            self._failed(robot, again, slot.state.tick)

    def _finish(self, robot: str, slot: RobotSlot) -> None:
        """Does the deferred work of a tick and publishes its outputs."""
        slot.unfinished_since = None  # first: deferred work that fails is not repeated
        try:
            further = self._node.afterwards(robot)
            if further:
                self._publish(robot, slot.trace.on(further))
        except Exception as error:  # noqa: BLE001
            # Only logged: the action of this tick was sent before.
            self._failed(robot, error, slot.state.tick)
            return
        if further:
            self._service_log.notice(robot, further)
            # Added to the outputs that a repeated state is answered with.
            slot.outputs = {**(slot.outputs or {}), **further}

    def _publish(self, robot: str, outputs: Outputs) -> None:
        publish, service = self._bus.publish, self._node.name
        for topic, message in outputs.items():
            # A robot must not receive bundles, which contain actions of others. One whose states arrive in bundles runs
            # in a process that simulates many robots, and that process may.
            alone = topic is ACTION and not self._slots[robot].bundled
            publish(topic, robot, message, service, alone=alone)

    def _forget_silent(self) -> None:
        oldest = self.clock() - _FORGET_SECONDS
        # A process that is far behind reads messages of long ago from a robot that still sends.
        for robot in [robot for robot, slot in self._slots.items() if slot.read < oldest]:
            del self._slots[robot]
            self._leave(robot)
            self._service_log.forgot(robot)
        for robot in [robot for robot, at in self._mentioned.items() if at < oldest]:
            del self._mentioned[robot]
            self._leave(robot)

    def _leave(self, robot: str) -> None:
        self._node.leave(robot)
        self._handshake.forget(robot)
        self._bus.forget(robot)

    def _refuse(self, reason: str, robot: str = "", tick: int = -1, *, second: bool = False) -> None:
        """Counts and logs a rejected message, for its robot if that one is served."""
        self._service_log.refused(reason, robot, tick, second=second)
        slot = self._slots.get(robot)
        counts = self._unserved if slot is None else slot.counts
        counts.refused += 1
        counts.detail = f"refused: {reason}"

    def _failed(self, robot: str, error: Exception, tick: int = -1) -> str:
        """Counts and logs an exception about a robot; returns it as text. Raises an error of the process again."""
        if isinstance(error, _PROCESS_ERRORS):
            raise error
        # InputError means invalid data from outside; any other exception is a defect of this program.
        if isinstance(error, InputError):
            self._refuse(str(error), robot, tick)
            return str(error)
        reason = f"{type(error).__name__}: {error}"
        self._service_log.failed(reason, error, robot, tick)
        slot = self._slots.get(robot)
        (self._unserved if slot is None else slot.counts).detail = f"failed: {reason}"
        return reason

    def _report_setup(self) -> None:
        if self._setup is not None and self.clock() >= self._next_setup:
            self._next_setup = self.clock() + SETUP_SECONDS
            self._bus.publish(SETUP, NO_ROBOT, self._setup, self._node.name)

    def _report_health(self, robot: str, slot: RobotSlot | None) -> None:
        if slot is not None:
            # The first heartbeat of a robot goes out at once, its second after a part of the interval that differs from
            # robot to robot. The heartbeats of robots that joined together are then spread in time.
            share = 1.0 if slot.reported else (_SPREAD * len(self._slots)) % 1.0
            slot.reported, slot.next_heartbeat = True, self.clock() + share * _HEARTBEAT_SECONDS
        message = heartbeat(self._node.name, slot, self._unserved, self._node.model_of(robot) if slot else "")
        self._bus.publish(HEALTH, robot, message, self._node.name)
