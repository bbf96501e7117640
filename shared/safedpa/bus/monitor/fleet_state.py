"""The whole fleet as one listener knows it: robots by name, processes by service and number.

Counts over the last seconds, in memory that does not grow with the rate.

What is known of one robot of a fleet from what is said on the bus.

What is known of one process of a fleet from its heartbeats.
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
    StateMessage,
    SurroundingsMessage,
    VerdictMessage,
)
from safedpa.bus.messages.topics import FINDING, HEALTH, STATE, SURROUNDINGS, VERDICT
from safedpa.bus.transport.bus import Bus
from safedpa.bus.transport.inbox import ReceivedMessage

__all__ = [
    "RECENT_SECONDS",
    "FleetOverview",
    "RobotOverview",
    "ServiceOverview",
    "SlidingCounter",
]

RECENT_SECONDS = 10.0
"""s; shares and rates are told over so long: long enough for a share of a percent, short enough to be the present."""
_SLICE_SECONDS = 0.5


class SlidingCounter:
    """How often each kind of thing happened within the last ``seconds``, kept in slices of half a second."""

    def __init__(self, seconds: float = RECENT_SECONDS) -> None:
        self._seconds = seconds
        self._slices: deque[tuple[float, Counter[str]]] = deque()
        self._first: float | None = None

    def add(self, kind: str, at: float) -> None:
        """One more of ``kind`` at the time ``at`` [s], which does not run backwards."""
        if self._first is None:
            self._first = at
        begin = at - at % _SLICE_SECONDS
        if not self._slices or self._slices[-1][0] < begin:
            self._slices.append((begin, Counter()))
        self._slices[-1][1][kind] += 1
        self._drop(at)

    def counts(self, now: float) -> Counter[str]:
        """The counts by kind within the last seconds before ``now`` [s]."""
        self._drop(now)
        total: Counter[str] = Counter()
        for _, counted in self._slices:
            total.update(counted)
        return total

    def share(self, kind: str, now: float) -> float:
        """count(kind) / count(all); 0 while nothing was counted."""
        counted = self.counts(now)
        return counted[kind] / counted.total() if counted else 0.0

    def rate(self, now: float) -> float:
        """Everything counted over the time in which it was, in 1/s; 0 while that is shorter than a slice."""
        counted = self.counts(now).total()
        span = min(self._seconds, now - self._first) if self._first is not None else 0.0
        return counted / span if span >= _SLICE_SECONDS else 0.0

    def _drop(self, now: float) -> None:
        while self._slices and self._slices[0][0] <= now - self._seconds:
            self._slices.popleft()


_RETAINED_LATENCIES = 400
"""20 s at 20 Hz."""


@dataclass
class RobotOverview:
    """Newest messages, counts since this listener heard the robot first, shares over the last ten seconds."""

    name: str
    since: float
    """s; when it was heard first."""
    state: StateMessage | None = None
    state_at: float = 0.0
    verdict: VerdictMessage | None = None
    verdict_at: float = 0.0
    finding: FindingMessage | None = None
    seen: SurroundingsMessage | None = None
    """What its sensors see; None of a robot without any."""
    health: dict[str, tuple[HealthMessage, float]] = field(default_factory=dict)
    """By service: the newest heartbeat about this robot, and when it came."""
    verdicts: Counter[str] = field(default_factory=Counter)
    """Verdicts by status."""
    ticks: int = 0
    late_ticks: int = 0
    """Ticks before which the robot's watchdog acted because no action had arrived in time."""
    recent_verdicts: SlidingCounter = field(default_factory=SlidingCounter)
    recent_ticks: SlidingCounter = field(default_factory=SlidingCounter)
    """Kinds: who chose the action that was in force (``filter``, ``watchdog``, ``none``)."""
    latencies: deque[float] = field(default_factory=lambda: deque(maxlen=_RETAINED_LATENCIES))
    """s from publishing a state to accepting its action, as the robot measured it, newest last."""
    new_latencies: list[float] = field(default_factory=list)
    """The same since someone emptied the list; for histograms."""

    def heard_at(self) -> float:
        """s; when anything came last that the robot itself said."""
        own = self.health.get("robot")
        return max(self.state_at, own[1] if own else 0.0, self.since)

    def silent_for(self, now: float) -> float:
        """Seconds since the robot said anything."""
        return max(0.0, now - self.heard_at())

    def hear(self, message: Message, at: float) -> None:
        """Takes one message about this robot that came at the time ``at`` [s]; repetitions count once."""
        if isinstance(message, StateMessage):
            self._hear_state(message, at)
        elif isinstance(message, VerdictMessage):
            self._hear_verdict(message, at)
        elif isinstance(message, HealthMessage):
            self.health[message.service] = (message, at)
            self.latencies.extend(message.latencies)
            self.new_latencies.extend(message.latencies)
        elif isinstance(message, FindingMessage):
            self.finding = message
        elif isinstance(message, SurroundingsMessage):
            self.seen = message

    def _hear_state(self, message: StateMessage, at: float) -> None:
        known = self.state
        if known is not None and (known.epoch, known.tick) == (message.epoch, message.tick):
            return
        self.state, self.state_at = message, at
        self.ticks += 1
        self.late_ticks += message.applied_by == "watchdog"
        self.recent_ticks.add(message.applied_by, at)

    def _hear_verdict(self, message: VerdictMessage, at: float) -> None:
        known = self.verdict
        if known is not None and (known.epoch, known.tick) == (message.epoch, message.tick):
            return
        self.verdict, self.verdict_at = message, at
        self.verdicts[message.status] += 1
        self.recent_verdicts.add(message.status, at)

    def sources(self) -> dict[str, float | None]:
        """s since each of its sources measured what was looked at last, by its clock; None: nothing was."""
        names = () if self.state is None else self.state.sources
        ages = () if self.seen is None else self.seen.ages
        reported = dict(zip(names, ages, strict=False))
        return {name: reported[name] if reported.get(name, -1.0) >= 0.0 else None for name in names}

    def latency(self, share: float) -> float | None:
        """The ``share``-quantile of the kept latencies [s]: the smallest one that so many do not exceed."""
        ordered = sorted(self.latencies)
        return ordered[min(len(ordered) - 1, int(share * len(ordered)))] if ordered else None


_SAMPLE_SECONDS = 0.25


@dataclass
class ServiceOverview:
    """One process, by service and process number. It sends one heartbeat for each robot, which counts that robot's."""

    name: str
    pid: int
    health: HealthMessage
    """The newest heartbeat, about whichever robot."""
    at: float
    """s; when it came."""
    retained: dict[str, tuple[HealthMessage, float]] = field(default_factory=dict)
    """By robot (``-``: none): the newest heartbeat about it, and when it came."""

    def __post_init__(self) -> None:
        self._gone_steps = self._gone_stale = self._seen_steps = 0
        self._samples: deque[tuple[float, int]] = deque()

    @property
    def robots(self) -> list[str]:
        """Those that it serves."""
        return [name for name in self.retained if name != "-"]

    @property
    def steps(self) -> int:
        """Of all robots together; never falls while the process lives."""
        return self._gone_steps + sum(message.steps for message, _ in self.retained.values())

    @property
    def stale(self) -> int:
        """Steps without some input, of all robots together; never falls while the process lives."""
        return self._gone_stale + sum(message.stale for message, _ in self.retained.values())

    @property
    def refused(self) -> int:
        """Refused messages: the most that it tells of one robot, those of no one included; at least so many."""
        return max((message.refused for message, _ in self.retained.values()), default=0)

    @property
    def failing(self) -> HealthMessage | None:
        """A heartbeat that tells of a failure; None while there is none."""
        return next((message for message, _ in self.retained.values() if message.state == "failing"), None)

    @property
    def state(self) -> str:
        """``failing`` when it is so for one of its robots, else what the newest heartbeat says."""
        return "failing" if self.failing else self.health.state

    @property
    def detail(self) -> str:
        """What the failure, or the newest heartbeat, says."""
        return (self.failing or self.health).detail

    def hear(self, robot: str, message: HealthMessage, at: float) -> None:
        """Takes one heartbeat; one that was overtaken by a newer one is left out."""
        before = self.retained.get(robot)
        if before is not None and message.publish_time < before[0].publish_time:
            return
        if before is not None and (message.steps < before[0].steps or message.stale < before[0].stale):
            self._remember(before[0])  # the robot began again, and with it the counts
        elif before is not None:
            self._seen_steps += message.steps - before[0].steps
        self.retained[robot] = (message, at)
        self.health, self.at = message, at
        if not self._samples or at - self._samples[-1][0] >= _SAMPLE_SECONDS:
            self._samples.append((at, self._seen_steps))
        while self._samples[0][0] < at - RECENT_SECONDS:
            self._samples.popleft()

    def forget(self, oldest: float) -> None:
        """Leaves out robots of which it told nothing since ``oldest`` [s]; what was counted for them stays."""
        for robot in [name for name, (_, at) in self.retained.items() if at < oldest]:
            self._remember(self.retained.pop(robot)[0])

    def _remember(self, message: HealthMessage) -> None:
        self._gone_steps += message.steps
        self._gone_stale += message.stale

    def age(self, now: float) -> float:
        """Seconds since the newest heartbeat."""
        return max(0.0, now - self.at)

    def steps_per_second(self) -> float:
        """Of all robots together over the last seconds; 0 while there is only one heartbeat."""
        (begin, first), (end, last) = self._samples[0], self._samples[-1]
        return (last - first) / (end - begin) if end > begin else 0.0


_FORGET_SECONDS = 300.0
"""What was silent for so long has left; until then its silence is told."""
_LEFT_SECONDS = 5.0
"""A service that tells nothing of a robot for so long does not serve it any more."""
_NO_ROBOT = "-"
_SILENT_SECONDS = 1.5


@dataclass
class FleetOverview:
    """Listens to a fleet from now on; ``listen`` must be called often. It holds at most one entry a robot."""

    bus: Bus
    robot: str = "*"
    clock: Callable[[], float] = time.monotonic
    robots: dict[str, RobotOverview] = field(default_factory=dict)
    services: dict[tuple[str, int], ServiceOverview] = field(default_factory=dict)
    """By service and process number."""
    refused: int = 0
    """What arrived and was no message of this project."""

    def __post_init__(self) -> None:
        topics = (STATE, VERDICT, HEALTH, FINDING, SURROUNDINGS)
        self._inbox = self.bus.inbox(topics, self.robot, keep_all=True, clock=self.clock)
        self._fleet_wide = None
        if self.robot != "*":
            self._fleet_wide = self.bus.inbox((HEALTH,), _NO_ROBOT, keep_all=True, clock=self.clock)
        self.since = self.clock()

    @property
    def is_empty(self) -> bool:
        """Whether nothing at all was heard so far."""
        return not self.robots and not self.services

    def replaced(self, service: ServiceOverview) -> bool:
        """Whether a process fell silent and another one of the same service was heard since."""
        others = [known for known in self.services.values() if known.name == service.name and known.at > service.at]
        return service.age(self.clock()) > _SILENT_SECONDS and bool(others)

    def listen(self, wait: float) -> None:
        """Takes in what arrived, after ``wait`` [s] at most; not woken by every message."""
        end = self.clock() + wait
        while (rest := end - self.clock()) > 0.0:
            time.sleep(min(rest, 0.05))  # the loop has the processor first
        for inbox in (self._inbox, self._fleet_wide):
            for item in inbox.take(0.0) if inbox is not None else ():
                if isinstance(item, ReceivedMessage):
                    self.hear(item)
                else:
                    self.refused += 1
        self._forget()

    def hear(self, item: ReceivedMessage) -> None:
        """Takes one message."""
        message = item.message
        if isinstance(message, HealthMessage) and message.service != "robot":
            self._hear_service(item.robot, message, item.at)
        if item.robot == _NO_ROBOT:
            return
        known = self.robots.get(item.robot)
        if known is None:
            known = self.robots[item.robot] = RobotOverview(item.robot, item.at)
        known.hear(message, item.at)

    def _hear_service(self, robot: str, message: HealthMessage, at: float) -> None:
        which = (message.service, message.pid)
        if which not in self.services:
            self.services[which] = ServiceOverview(*which, message, at)
        self.services[which].hear(robot, message, at)

    def _forget(self) -> None:
        oldest = self.clock() - _FORGET_SECONDS
        self.robots = {name: known for name, known in self.robots.items() if known.heard_at() >= oldest}
        self.services = {which: known for which, known in self.services.items() if known.at >= oldest}
        for service in self.services.values():
            service.forget(self.clock() - _LEFT_SECONDS)
