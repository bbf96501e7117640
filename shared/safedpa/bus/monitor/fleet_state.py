"""The state of a fleet as a listener on the bus knows it: robots by name, processes by service and pid.

``FleetOverview`` listens to the bus and holds a ``RobotOverview`` per robot and a ``ServiceOverview`` per process.
``SlidingCounter`` counts events over the last seconds in bounded memory.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field

from safedpa.bus.messages.messages import (
    FindingMessage,
    HealthMessage,
    Message,
    RosterMessage,
    StateMessage,
    SurroundingsMessage,
    VerdictMessage,
)
from safedpa.bus.messages.topics import FINDING, HEALTH, NO_ROBOT, ROSTER, STATE, SURROUNDINGS, VERDICT
from safedpa.bus.monitor.measurement_times import MeasurementTimes
from safedpa.bus.monitor.roster import SILENT_SECONDS, Roster
from safedpa.bus.transport.bus import Bus
from safedpa.bus.transport.inbox import ReceivedMessage

RECENT_SECONDS = 10.0
"""Window of shares and rates in s: long enough to resolve a percent at 20 Hz, short enough to show the present."""
# Width of a counter's slices. A counter holds 20 of them, however many events there are.
_SLICE_SECONDS = 0.5


class SlidingCounter:
    """Counts events by kind over the last ``seconds``, with a resolution of half a second."""

    def __init__(self, seconds: float = RECENT_SECONDS) -> None:
        self._seconds = seconds
        self._slices: deque[tuple[float, Counter[str]]] = deque()
        self._first: float | None = None

    def add(self, kind: str, at: float) -> None:
        """Counts one event of ``kind`` at time ``at`` [s], which must not decrease."""
        if self._first is None:
            self._first = at
        begin = at - at % _SLICE_SECONDS
        if not self._slices or self._slices[-1][0] < begin:
            self._slices.append((begin, Counter()))
        self._slices[-1][1][kind] += 1
        self._drop(at)

    def counts(self, now: float) -> Counter[str]:
        """Returns the counts by kind within the window before ``now`` [s]."""
        self._drop(now)
        total: Counter[str] = Counter()
        for _, counted in self._slices:
            total.update(counted)
        return total

    def share(self, kind: str, now: float) -> float:
        """Returns count(kind) / count(all); 0 without events."""
        counted = self.counts(now)
        return counted[kind] / counted.total() if counted else 0.0

    def rate(self, now: float) -> float:
        """Returns the rate of all events in 1/s; 0 until the first slice is over."""
        # The window begins with the first event, so that the rate is right from the start.
        counted = self.counts(now).total()
        span = min(self._seconds, now - self._first) if self._first is not None else 0.0
        return counted / span if span >= _SLICE_SECONDS else 0.0

    def _drop(self, now: float) -> None:
        while self._slices and self._slices[0][0] <= now - self._seconds:
            self._slices.popleft()


# 20 s at 20 Hz: recent enough to show the present latency. The limit keeps the memory of many robots bounded.
_RETAINED_LATENCIES = 400


@dataclass
class RobotOverview:
    """One robot: newest messages, counts since its first message, and counts over the last ten seconds."""

    name: str
    since: float
    """Time [s] of the first message."""
    state: StateMessage | None = None
    state_at: float = 0.0
    """Time [s] at which it was measured."""
    verdict: VerdictMessage | None = None
    verdict_at: float = 0.0
    """Time [s] at which the state was measured that the verdict is about."""
    finding: FindingMessage | None = None
    finding_at: float = 0.0
    seen: SurroundingsMessage | None = None
    """What its sensors perceive; None for a robot without sensors."""
    seen_at: float = 0.0
    health: dict[str, tuple[HealthMessage, float]] = field(default_factory=dict)
    """By service: the newest heartbeat about this robot, and its time of arrival [s]."""
    verdicts: Counter[str] = field(default_factory=Counter)
    """Verdicts by status."""
    ticks: int = 0
    late_ticks: int = 0
    """Ticks in which the robot's watchdog acted because no action arrived in time."""
    recent_verdicts: SlidingCounter = field(default_factory=SlidingCounter)
    recent_ticks: SlidingCounter = field(default_factory=SlidingCounter)
    """Kinds: the source of the applied action (``filter``, ``watchdog``, ``none``)."""
    latencies: deque[float] = field(default_factory=lambda: deque(maxlen=_RETAINED_LATENCIES))
    """Latencies in s from publishing a state to accepting its action, measured by the robot, newest last."""
    new_latencies: list[float] = field(default_factory=list)
    """The same since a reader last emptied the list; for histograms."""
    times: MeasurementTimes = field(default_factory=MeasurementTimes)

    @property
    def ended_in_order(self) -> bool:
        """Whether its last heartbeat says that it was shut down."""
        own = self.health.get("robot")
        return own is not None and own[0].state == "braked" and own[1] >= self.state_at

    def heard_at(self) -> float:
        """Returns the time [s] of the last message from the robot itself."""
        own = self.health.get("robot")
        return max(self.state_at, own[1] if own else 0.0, self.since)

    def silent_for(self, now: float) -> float:
        """Returns the time in s since the last message from the robot itself."""
        return max(0.0, now - self.heard_at())

    def hear(self, message: Message, at: float) -> None:
        """Handles one message about this robot that arrived at time ``at`` [s]; repetitions count once."""
        if isinstance(message, StateMessage):
            self._hear_state(message, at)
        elif isinstance(message, VerdictMessage):
            self._hear_verdict(message, at)
        elif isinstance(message, HealthMessage):
            self.health[message.service] = (message, at)
            self.latencies.extend(message.latencies)
            self.new_latencies.extend(message.latencies)
        elif isinstance(message, FindingMessage):
            self.finding, self.finding_at = message, self.times.of(message, at)
        elif isinstance(message, SurroundingsMessage):
            self.seen, self.seen_at = message, self.times.of(message, at)

    def _hear_state(self, message: StateMessage, at: float) -> None:
        # A robot repeats its state while it waits for an action; a repetition is not another tick.
        known = self.state
        if known is not None and (known.epoch, known.tick) == (message.epoch, message.tick):
            return
        self.state, self.state_at = message, self.times.of(message, at)
        self.ticks += 1
        self.late_ticks += message.applied_by == "watchdog"
        self.recent_ticks.add(message.applied_by, at)

    def _hear_verdict(self, message: VerdictMessage, at: float) -> None:
        known = self.verdict
        if known is not None and (known.epoch, known.tick) == (message.epoch, message.tick):
            return
        self.verdict, self.verdict_at = message, self.times.of(message, at)
        self.verdicts[message.status] += 1
        self.recent_verdicts.add(message.status, at)

    def sources(self, now: float) -> dict[str, float | None]:
        """Returns the age in s, at ``now``, of the newest measurement of each source; None: no measurement arrived."""
        names = () if self.state is None else self.state.sources
        since = max(0.0, now - self.seen_at)
        ages = () if self.seen is None else [age + since if age >= 0.0 else age for age in self.seen.ages]
        reported = dict(zip(names, ages, strict=False))
        return {name: reported[name] if reported.get(name, -1.0) >= 0.0 else None for name in names}

    def latency(self, share: float) -> float | None:
        """Returns the ``share`` quantile of the retained latencies [s]; None without any."""
        ordered = sorted(self.latencies)
        return ordered[min(len(ordered) - 1, int(share * len(ordered)))] if ordered else None


_SAMPLE_SECONDS = 0.25


@dataclass
class ServiceOverview:
    """One process of a service. It sends a separate heartbeat, with separate counts, about each robot."""

    name: str
    pid: int
    health: HealthMessage
    """The newest heartbeat about any robot."""
    at: float
    """Time of its arrival [s]."""
    retained: dict[str, tuple[HealthMessage, float]] = field(default_factory=dict)
    """By robot (``-``: none): the newest heartbeat about it, and its time of arrival [s]."""

    def __post_init__(self) -> None:
        self._gone_steps = self._gone_stale = self._seen_steps = 0
        self._samples: deque[tuple[float, int]] = deque()

    @property
    def robots(self) -> list[str]:
        """Names of the robots that the process serves."""
        return [name for name in self.retained if name != NO_ROBOT]

    @property
    def steps(self) -> int:
        """Steps for all robots; never decreases while the process lives."""
        return self._gone_steps + sum(message.steps for message, _ in self.retained.values())

    @property
    def stale(self) -> int:
        """Steps with a missing input for all robots; never decreases while the process lives."""
        return self._gone_stale + sum(message.stale for message, _ in self.retained.values())

    @property
    def refused(self) -> int:
        """Lower bound of the number of rejected messages: the maximum over the robots."""
        # Each heartbeat includes the messages that belong to no robot, so a sum would count those several times.
        return max((message.refused for message, _ in self.retained.values()), default=0)

    @property
    def failing(self) -> HealthMessage | None:
        """A heartbeat that reports a failure; None without one."""
        return next((message for message, _ in self.retained.values() if message.state == "failing"), None)

    @property
    def state(self) -> str:
        """``failing`` if that is so for one of its robots, else the state in the newest heartbeat."""
        return "failing" if self.failing else self.health.state

    @property
    def detail(self) -> str:
        """Detail of the failure, or of the newest heartbeat."""
        return (self.failing or self.health).detail

    def hear(self, robot: str, message: HealthMessage, at: float) -> None:
        """Handles one heartbeat; ignores one that arrives after a newer one."""
        before = self.retained.get(robot)
        # Heartbeats may arrive out of order: a bundle and a single message travel under different keys.
        if before is not None and message.publish_time < before[0].publish_time:
            return
        if before is not None and (message.steps < before[0].steps or message.stale < before[0].stale):
            self._remember(before[0])  # the robot restarted, and its counts started at 0 again
        elif before is not None:
            self._seen_steps += message.steps - before[0].steps
        self.retained[robot] = (message, at)
        self.health, self.at = message, at
        if not self._samples or at - self._samples[-1][0] >= _SAMPLE_SECONDS:
            self._samples.append((at, self._seen_steps))
        while self._samples[0][0] < at - RECENT_SECONDS:
            self._samples.popleft()

    def forget(self, oldest: float) -> None:
        """Drops robots without a heartbeat since ``oldest`` [s]; their counts remain in the totals."""
        for robot in [name for name, (_, at) in self.retained.items() if at < oldest]:
            self._remember(self.retained.pop(robot)[0])

    def _remember(self, message: HealthMessage) -> None:
        self._gone_steps += message.steps
        self._gone_stale += message.stale

    def age(self, now: float) -> float:
        """Returns the time in s since the newest heartbeat."""
        return max(0.0, now - self.at)

    def steps_per_second(self) -> float:
        """Returns the rate of steps for all robots over the last seconds; 0 with a single heartbeat."""
        (begin, first), (end, last) = self._samples[0], self._samples[-1]
        return (last - first) / (end - begin) if end > begin else 0.0


# A robot that was shut down, or a process with a successor, is left out after this time.
_FORGET_SECONDS = 300.0
# Silent robots and processes that are kept although they are on no roster. Any client of a plain-text bus may invent
# names; the ones that are silent for longest are left out first.
_MOST_SILENT = 1000
# A run that ends in order takes up to 20 s: robots brake, and the recorder ends last.
_ENDING_SECONDS = 60.0
# A service without a heartbeat about a robot for this long no longer serves it.
_LEFT_SECONDS = 5.0


@dataclass
class FleetOverview:
    """Listens to a fleet and holds one entry per robot and process. Call ``listen`` often."""

    bus: Bus
    robot: str = "*"
    clock: Callable[[], float] = time.monotonic
    robots: dict[str, RobotOverview] = field(default_factory=dict)
    services: dict[tuple[str, int], ServiceOverview] = field(default_factory=dict)
    """By service and pid."""
    roster: Roster = field(default_factory=Roster)
    """Who should be there."""
    refused: int = 0
    """Number of rejected messages."""

    def __post_init__(self) -> None:
        self._ended: dict[str, float] = {}
        """By name of a robot or service: when its supervisor ended its run in order."""
        topics = (STATE, VERDICT, HEALTH, FINDING, SURROUNDINGS, *((ROSTER,) if self.robot == "*" else ()))
        self._inbox = self.bus.inbox(topics, self.robot, keep_all=True, clock=self.clock)
        # Processes that serve no robot send their heartbeats under "-", which a subscription to one robot excludes.
        self._fleet_wide = None
        if self.robot != "*":
            self._fleet_wide = self.bus.inbox((HEALTH, ROSTER), NO_ROBOT, keep_all=True, clock=self.clock)
        self.since = self.clock()

    @property
    def is_empty(self) -> bool:
        """Whether no message has arrived yet."""
        return not self.robots and not self.services and not self.roster.members

    def replaced(self, service: ServiceOverview) -> bool:
        """Whether a process is silent and another one of the same service has sent a heartbeat since."""
        others = [known for known in self.services.values() if known.name == service.name and known.at > service.at]
        return service.age(self.clock()) > SILENT_SECONDS and bool(others)

    def listen(self, wait: float) -> None:
        """Waits for ``wait`` [s], then handles all messages that arrived."""
        end = self.clock() + wait
        # Sleep instead of waiting for messages, which would wake this process for each one and take CPU time from the
        # control loop.
        while (rest := end - self.clock()) > 0.0:
            before = self.clock()
            time.sleep(min(rest, 0.05))
            if self.clock() - before > SILENT_SECONDS:
                self.roster.excuse(self.clock())
        taken = [item for inbox in (self._inbox, self._fleet_wide) if inbox is not None for item in inbox.take(0.0)]
        heard = [item for item in taken if isinstance(item, ReceivedMessage)]
        self.refused += len(taken) - len(heard)
        # In order of arrival: what is heard of a member counts from the roster on that lists it.
        for item in sorted(heard, key=lambda item: item.at):
            self.hear(item)
        self._forget()

    def hear(self, item: ReceivedMessage) -> None:
        """Handles one message."""
        message = item.message
        if isinstance(message, RosterMessage):
            if message.ended:
                members = self.roster.members.values()
                self._ended |= {known.name: item.at for known in members if known.source == message.source}
            self.roster.hear(message, item.at)
            if message.dismisses:
                self._dismiss(message.dismisses)
            return
        if isinstance(message, HealthMessage) and message.service != "robot":
            self._hear_service(item.robot, message, item.at)
        if item.robot == NO_ROBOT:
            return
        known = self.robots.get(item.robot)
        if known is None:
            known = self.robots[item.robot] = RobotOverview(item.robot, item.at)
        known.hear(message, item.at)
        if isinstance(message, StateMessage):
            self.roster.note("robot", item.robot, known.state_at, max(SILENT_SECONDS, 5.0 * message.period))

    def _hear_service(self, robot: str, message: HealthMessage, at: float) -> None:
        which = (message.service, message.pid)
        if which not in self.services:
            self.services[which] = ServiceOverview(*which, message, at)
        self.services[which].hear(robot, message, at)
        self.roster.note("service", message.service, at)

    @property
    def is_unsupervised(self) -> bool:
        """Whether a process reports that a supervisor started it, and no supervisor is or was on the bus."""
        waited = self.clock() - self.since > SILENT_SECONDS
        return waited and not self.roster.members and any(known.health.supervised for known in self.services.values())

    def _dismiss(self, names: tuple[str, ...]) -> None:
        """Leaves out silent robots and processes of these names."""
        now = self.clock()
        self.robots = {
            name: known
            for name, known in self.robots.items()
            if name not in names or known.silent_for(now) <= SILENT_SECONDS
        }
        self.services = {
            which: known
            for which, known in self.services.items()
            if known.name not in names or known.age(now) <= SILENT_SECONDS
        }

    def _forget(self) -> None:
        """Leaves out what ended in order or has a successor; everything else stays until it returns or is dismissed."""
        now = self.clock()
        self._ended = {name: at for name, at in self._ended.items() if now - at <= _ENDING_SECONDS}
        for name, robot in list(self.robots.items()):
            left = robot.ended_in_order and robot.silent_for(now) > _FORGET_SECONDS
            if left or (name in self._ended and robot.silent_for(now) > SILENT_SECONDS):
                del self.robots[name]
        for which, service in list(self.services.items()):
            service.forget(now - _LEFT_SECONDS)
            left = service.age(now) > _FORGET_SECONDS and self.replaced(service)
            if left or (service.name in self._ended and service.age(now) > SILENT_SECONDS):
                del self.services[which]
        if len(self.robots) + len(self.services) > _MOST_SILENT:
            self._bound(now)

    def _bound(self, now: float) -> None:
        silent = [(robot.heard_at(), name) for name, robot in self.robots.items() if robot.silent_for(now) > 60.0]
        for _, name in sorted(silent)[: max(0, len(silent) - _MOST_SILENT)]:
            del self.robots[name]
        gone = [(service.at, which) for which, service in self.services.items() if service.age(now) > 60.0]
        for _, which in sorted(gone)[: max(0, len(gone) - _MOST_SILENT)]:
            del self.services[which]
