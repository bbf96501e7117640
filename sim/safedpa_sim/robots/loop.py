"""The control loop of a robot on the bus: publishes state[k], receives action[k], advances the simulation.

Lockstep: the robot waits for the action and repeats the state meanwhile. Real time: state k is published k periods
after the start, and its action must arrive within 0.9 periods; otherwise the watchdog acts.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from safedpa.bus import ACTION, HEALTH, SCAN, SETUP, STATE, Bus, ReceivedMessage
from safedpa.bus.logging import log_event
from safedpa.bus.messages.messages import ActionMessage, SetupMessage, StateMessage
from safedpa.bus.messages.service_info import SETUP_SECONDS, software_version
from safedpa.errors import BusError
from safedpa_sim.robots.robot import SimulatedRobot
from safedpa_sim.robots.run_summary import TracedPeriod, TraceWriter

_REPEAT_SECONDS = 0.1
_PATIENCE_SECONDS = 60.0
_DEADLINE_SHARE = 0.9
"""Share of the period after which an action is late."""
_LARGEST_AGE_PERIODS = 2.0
"""Largest time between a state and the start of its action; a process that was suspended must not act on an old
state."""
_HEARTBEAT_SECONDS = 0.25
_LONGEST_WAIT_SECONDS = 0.1
"""The loop checks ``stopped`` and its heartbeat at least this often."""
_LONGEST_BRAKING_SECONDS = 5.0
_USUAL_IN_LOCKSTEP = ("late", "repeated")
"""Refusals that are normal in lockstep, because a repeated state is answered again."""
_MOST_REPORTED_LATENCIES = 100


class NoActionError(BusError):
    """No valid action arrived in lockstep."""


class RobotLoop:
    """Runs one robot on the bus under ``name``."""

    def __init__(
        self,
        robot: SimulatedRobot,
        bus: Bus,
        name: str,
        clock: Callable[[], float] = time.monotonic,
        patience: float = _PATIENCE_SECONDS,
        trace: TraceWriter | None = None,
        setup: SetupMessage | None = None,
    ) -> None:
        self.robot = robot
        self.latencies: list[float] = []
        """s from publishing a state to accepting its action."""
        self.overruns = 0
        """Periods that started late because this process was suspended."""
        self._bus = bus
        self._name = name
        self._clock = clock
        self._patience = patience
        self._inbox = bus.inbox((ACTION,), name, alone=True)
        self._trace = trace
        self._published = 0.0
        self._sent: StateMessage | None = None
        self._accepted: ActionMessage | None = None
        self._next_heartbeat = clock()
        self._setup, self._next_setup = setup, clock()
        self._detail = ""
        self._step_microseconds = 0.0
        self._reported_latencies = 0

    def run(self, stopped: Callable[[], bool], ticks: int) -> None:
        """Runs until ``stopped`` or for ``ticks`` periods (0: without limit).

        Raises NoActionError when no valid action arrives in lockstep for ``patience`` seconds.
        """
        begin = self._clock()
        while not stopped() and (ticks == 0 or self.robot.tick < ticks):
            if self.robot.lockstep:
                self._lockstep_tick(stopped)
            else:
                begin = self._real_time_tick(begin)

    def brake(self, publish: bool) -> None:
        """Runs on without accepting actions, so that the watchdog brakes, until the robot is at rest."""
        robot = self.robot
        last = robot.tick + round(_LONGEST_BRAKING_SECONDS / robot.period)
        begin = self._clock()
        while not robot.at_rest and robot.tick < last:
            if publish:
                self._publish()
            begin += 0.0 if robot.lockstep else robot.period
            while self._clock() < begin:
                self._inbox.take(max(0.0, begin - self._clock()))
            self._advance()
        # A recorder whose link was established late has not received the setup on a short drive.
        self._next_setup = self._clock()
        self._report_setup()
        self._report_health("braked")

    def _lockstep_tick(self, stopped: Callable[[], bool]) -> None:
        first = self._publish()
        repeat = first + _REPEAT_SECONDS
        while self.robot.guard.accepted is None:
            self._take(repeat - self._clock())
            now = self._clock()
            if self.robot.guard.accepted is None and stopped():
                return
            if now - first > self._patience:
                raise NoActionError(
                    f"robot '{self._name}': no valid action for tick {self.robot.tick} after {self._patience:.0f} s"
                    f"{self._why()}; are adaptation, policy and safety_filter running in fleet '{self._bus.fleet}'?"
                )
            if self.robot.guard.accepted is None and now >= repeat:
                self._bus.publish(STATE, self._name, self.robot.state_message())
                repeat = now + _REPEAT_SECONDS
        self._advance()

    def _real_time_tick(self, begin: float) -> float:
        """Runs one period from ``begin`` [s]; returns the start of the next one."""
        period = self.robot.period
        self._wait(begin)
        self._publish()
        self._wait(begin + _DEADLINE_SHARE * period)
        self._advance()
        following = begin + period
        now = self._clock()
        if now > following:
            self.overruns += 1
            return now  # missed periods are skipped, not caught up with
        return following

    def _advance(self) -> None:
        began = self._clock()
        guard = self.robot.guard
        too_old = began - self._published > _LARGEST_AGE_PERIODS * self.robot.period
        if guard.accepted is not None and too_old and not self.robot.lockstep:
            guard.withdraw("too old")
            self._accepted = None
        started = time.perf_counter()
        self.robot.advance()
        self._step_microseconds = 1e6 * (time.perf_counter() - started)
        if self._trace is not None and self._sent is not None:
            self._trace.write(self._traced_period(self._sent, began))
        self._sent = self._accepted = None

    def _traced_period(self, sent: StateMessage, began: float) -> TracedPeriod:
        now, accepted = self.robot.state_message(), self._accepted
        return TracedPeriod(
            epoch=sent.epoch,
            tick=sent.tick,
            published=self._published,
            applied_at=began,
            action_epoch=-1 if accepted is None else accepted.epoch,
            action_tick=-1 if accepted is None else accepted.tick,
            applied=now.applied,
            applied_by=now.applied_by,
            values=sent.values,
            collisions=now.collisions,
        )

    def _wait(self, until: float) -> None:
        """Receives messages until the time ``until``, at least once, so that messages already there count."""
        self._take(until - self._clock())
        while self._clock() < until:
            self._take(until - self._clock())

    def _publish(self) -> float:
        self._sent = self.robot.state_message()
        for scan in self.robot.scans():
            self._bus.publish(SCAN, self._name, scan)
        self._published = self._clock()
        self._bus.publish(STATE, self._name, self._sent)
        return self._published

    def _take(self, longest_wait: float) -> None:
        for item in self._inbox.take(max(0.0, min(longest_wait, _LONGEST_WAIT_SECONDS))):
            if not isinstance(item, ReceivedMessage) or not isinstance(item.message, ActionMessage):
                reason: str | None = "malformed"
                self.robot.guard.refuse("malformed")
            else:
                reason = self.robot.receive(item.message)
                if reason is None:
                    self._accepted = item.message
                    self.latencies.append(item.at - self._published)
            self._detail = f"refused: {reason}" if reason else ""
            if reason:
                self._report_refusal(reason)
        if self._clock() >= self._next_heartbeat:
            self._next_heartbeat = self._clock() + _HEARTBEAT_SECONDS
            self._report_health("running")
            self._report_setup()

    def _report_refusal(self, reason: str) -> None:
        if self.robot.lockstep and reason in _USUAL_IN_LOCKSTEP:
            return
        sentence = f"an action was refused: {reason}"
        tick = self.robot.tick
        log_event("message.refused", sentence, level="warning", robot=self._name, tick=tick, service="robot")

    def _why(self) -> str:
        return f" ({self._detail})" if self._detail else ""

    def _report_setup(self) -> None:
        if self._setup is not None and self._clock() >= self._next_setup:
            self._next_setup = self._clock() + SETUP_SECONDS
            self._bus.publish(SETUP, self._name, self._setup, "robot")

    def _report_health(self, state: str) -> None:
        reported, self._reported_latencies = self._reported_latencies, len(self.latencies)
        message = self.robot.health_message(
            state,
            detail=self._detail,
            step_microseconds=self._step_microseconds,
            software=software_version(),
            latencies=tuple(self.latencies[max(reported, len(self.latencies) - _MOST_REPORTED_LATENCIES) :]),
        )
        self._bus.publish(HEALTH, self._name, message, "robot")
