"""The control loop of many robots in one process, in real time, each with its own phase within the period.

A robot's period begins when its state is published. Its action must arrive within 0.9 of the period; otherwise the
watchdog acts and the tick is late. The simulation advances as soon as the action arrives, since an action acts over the
whole period after its state. Delays of this process are measured separately: a state that is published late is a fault
of the simulation, not of the services.
"""

from __future__ import annotations

import dataclasses
import heapq
import time
from array import array
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import ceil
from typing import Any, final

from safedpa.bus import ACTION, HEALTH, STATE, Bus, ReceivedMessage
from safedpa.bus.messages.messages import ActionMessage
from safedpa_sim.robots.robot import SimulatedRobot

_BIN_SECONDS = 1e-5
_BINS = 100_000


@final
class Durations:
    """A histogram of durations [s] with bins of 10 us up to one second; longer ones are in the last bin.

    Its memory is constant, because tests watch the memory of this process.
    """

    def __init__(self) -> None:
        self._counts = array("Q", bytes(8 * _BINS))
        self.count = 0
        self.longest = 0.0

    def add(self, seconds: float) -> None:
        """Adds a duration; a negative one counts as 0."""
        self._counts[min(max(int(seconds / _BIN_SECONDS), 0), _BINS - 1)] += 1
        self.count += 1
        self.longest = max(self.longest, seconds)

    def percentile(self, share: float) -> float | None:
        """Returns the smallest duration [s] that ``share`` of all do not exceed, rounded up to its bin; None if
        empty."""
        wanted, seen = share * self.count, 0
        for index, count in enumerate(self._counts):
            seen += count
            if seen and seen >= wanted:
                return min((index + 1) * _BIN_SECONDS, self.longest)
        return None

    def summary(self) -> dict[str, float | None]:
        """Returns p50, p99, p99.9 and the longest duration in microseconds."""
        shares = {"p50": 0.5, "p99": 0.99, "p999": 0.999}
        found = {name: self.percentile(share) for name, share in shares.items()}
        reported = {name: None if value is None else round(1e6 * value) for name, value in found.items()}
        return {**reported, "longest": round(1e6 * self.longest) if self.count else None}


_FEWEST_MOMENTS, _MOST_MOMENTS, _MANY = 2, 5, 300
"""Number of publication times per period for large fleets: 300 / robots, between 2 and 5. Larger bundles are cheaper
per robot but take longer. With two, half of the fleet is simulated while the actions of the other half are computed."""
_FEW = 8
"""Below this number each robot has its own publication time."""
_DEADLINE_SHARE = 0.9
"""Share of the period after which an action is late."""
_HELD_UP_SHARE = 0.1
"""A tick counts as held up by this process if its state is published late by more than this share of the period."""
_LARGEST_AGE_PERIODS = 2.0
"""An action is not applied if its state was published more than this many periods before."""
_HEARTBEAT_SECONDS = 0.25
_LONGEST_WAIT_SECONDS = 0.1
_CACHED_TICKS = 10
_CACHED_MOMENTS = 10_000
"""Number of late ticks, and of actions with their latency, that are stored with their time (monotonic clock, s)."""


@dataclass
class _ScheduledRobot:
    """A robot and its schedule."""

    robot: SimulatedRobot
    due: float
    """s; time at which its state of this tick should be published."""
    reported_every: int
    """Ticks between heartbeats."""
    reported_at: int
    """Tick offset of the heartbeat; staggered, so that not all robots report at once."""
    published: float = 0.0
    held_up: bool = False
    braked: deque[bool] = field(default_factory=lambda: deque(maxlen=_CACHED_TICKS))
    """Whether the watchdog acted, for each of the newest ticks."""


def _moments(robots: int) -> int:
    return robots if robots < _FEW else max(_FEWEST_MOMENTS, min(_MOST_MOMENTS, _MANY // robots))


@final
class FleetLoop:
    """Runs ``robots`` by name. With ``in_step`` all publish at the same time, otherwise spread over the period.

    Large fleets share two to five publication times, and the states of one time travel in one bundle.
    """

    def __init__(
        self,
        robots: Mapping[str, SimulatedRobot],
        bus: Bus,
        *,
        in_step: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._bus, self._clock = bus, clock
        self._inbox = bus.inbox((ACTION,), clock=clock)
        self._begin, self._moments = clock(), 1 if in_step else _moments(len(robots))
        self._scheduled = {}
        for index, (name, robot) in enumerate(robots.items()):
            due = self._begin + index * self._moments // len(robots) / self._moments * robot.period
            every = max(1, round(_HEARTBEAT_SECONDS / robot.period))
            self._scheduled[name] = _ScheduledRobot(robot, due, every, index % every)
        self._ready: deque[tuple[str, int]] = deque()
        """Robots whose action has arrived and which have not advanced yet, with the tick."""
        self._events = [
            (scheduled.due, name, scheduled.robot.tick, True) for name, scheduled in self._scheduled.items()
        ]
        """Heap of (time, name, tick, kind): a robot has to publish its state (True), or its action is late (False)."""
        heapq.heapify(self._events)
        self.begin_counting()

    def begin_counting(self) -> None:
        """Resets all counters, after warm-up."""
        self.latency, self.lateness = Durations(), Durations()
        self.ticks = self.late = self.late_held_up = self.held_up = self.overruns = 0
        self.late_of: Counter[str] = Counter()
        self.late_ones: deque[tuple[float, str, int]] = deque(maxlen=_CACHED_MOMENTS)
        self.acted: deque[tuple[float, float]] = deque(maxlen=_CACHED_MOMENTS)
        self._counting_since = self._clock()
        self.collisions: list[dict[str, Any]] = []

    def run(self, stopped: Callable[[], bool], seconds: float) -> None:
        """Runs for ``seconds``, or until ``stopped``."""
        end = self._clock() + seconds
        while not stopped() and self._clock() < end:
            if not self._ready:
                self._take(min(self._next_moment(), end))
            self.step()

    def step(self) -> None:
        """Processes all due work without waiting: receives actions, publishes states, advances robots."""
        self._take(0.0)
        self._bus.hold()
        sensed = []
        while self._events[0][0] <= self._clock():
            _, name, tick, sensor_inputs = heapq.heappop(self._events)
            scheduled = self._scheduled[name]
            if sensor_inputs:
                self._sense(name, scheduled)
                sensed.append(scheduled)
            elif scheduled.robot.tick == tick:
                self._take(0.0)  # an action that has already arrived counts
                self._move(name, scheduled)
        self._bus.flush()
        self._sent(sensed)
        while self._ready and self._events[0][0] > self._clock():
            name, tick = self._ready.popleft()
            if self._scheduled[name].robot.tick == tick:
                self._move(name, self._scheduled[name])

    def _next_moment(self) -> float:
        """Returns the time [s] of the next event; deadlines of actions that have arrived are dropped."""
        events = self._events
        while not events[0][3] and self._scheduled[events[0][1]].robot.tick != events[0][2]:
            heapq.heappop(events)
        return events[0][0]

    def _sense(self, name: str, scheduled: _ScheduledRobot) -> None:
        robot = scheduled.robot
        scheduled.published = self._clock()
        self._bus.publish(STATE, name, robot.state_message())
        if robot.tick % scheduled.reported_every == scheduled.reported_at:
            self._bus.publish(HEALTH, name, robot.health_message(), "robot")
        heapq.heappush(self._events, (scheduled.published + _DEADLINE_SHARE * robot.period, name, robot.tick, False))

    def _sent(self, sensed: Sequence[_ScheduledRobot]) -> None:
        """Records by how much the states of this step were published late."""
        now = self._clock()
        for scheduled in sensed:
            self.lateness.add(now - scheduled.due)
            scheduled.held_up = now - scheduled.due > _HELD_UP_SHARE * scheduled.robot.period

    def _take(self, until: float) -> None:
        """Receives actions; waits for the first one at most until the time ``until``."""
        wait = min(max(until - self._clock(), 0.0), _LONGEST_WAIT_SECONDS)
        for item in self._inbox.take(wait):
            scheduled = self._scheduled.get(item.robot)
            if scheduled is None:
                continue
            if not isinstance(item, ReceivedMessage) or not isinstance(item.message, ActionMessage):
                scheduled.robot.guard.refuse("malformed")
            elif scheduled.robot.receive(item.message) is None:
                self.latency.add(item.at - scheduled.published)
                self.acted.append((item.at, item.at - scheduled.published))
                self._ready.append((item.robot, scheduled.robot.tick))

    def _move(self, name: str, scheduled: _ScheduledRobot) -> None:
        robot = scheduled.robot
        late = robot.guard.accepted is None
        if not late and self._clock() - scheduled.published > _LARGEST_AGE_PERIODS * robot.period:
            robot.guard.withdraw("too old")  # this process was suspended after the action arrived
        tick, touched, braked = robot.tick, len(robot.collisions), robot.watchdog_ticks
        robot.advance()
        scheduled.braked.append(robot.watchdog_ticks > braked)
        for collision in robot.collisions[touched:]:
            about = {"robot": name, **robot.about, "tick": tick, "braked_before": list(scheduled.braked)}
            self.collisions.append({**about, **dataclasses.asdict(collision)})
        self.ticks += 1
        self.held_up += scheduled.held_up
        if late:
            self.late += 1
            self.late_held_up += scheduled.held_up
            self.late_of[name] += 1
            self.late_ones.append((self._clock(), name, tick))
        scheduled.due += robot.period
        if scheduled.due < self._clock():  # missed periods are skipped
            self.overruns += 1
            apart = robot.period / self._moments
            scheduled.due = self._begin + ceil((self._clock() - self._begin) / apart) * apart  # a time it shares
        heapq.heappush(self._events, (scheduled.due, name, robot.tick, True))

    def account(self) -> dict[str, Any]:
        """Returns the counts: robot ticks, late ticks, sense-to-act latency and own lateness in microseconds."""
        robots = [scheduled.robot for scheduled in self._scheduled.values()]
        return {
            "robots": len(robots),
            "robot_ticks": self.ticks,
            "late_ticks": self.late,
            "late_while_held_up": self.late_held_up,
            "robots_with_late_ticks": len(self.late_of),
            "moments": {
                "counted": [self._counting_since, self._clock()],
                "late": list(self.late_ones),
                "acted": list(self.acted),
            },
            "sense_to_act_us": self.latency.summary(),
            "own_lateness_us": self.lateness.summary(),
            "held_up_ticks": self.held_up,
            "overruns": self.overruns,
            "goals_reached": sum(robot.goals_reached for robot in robots),
            "collisions": sum(len(robot.collisions) for robot in robots),
            "collision_list": self.collisions,
            "refusals": dict(sum((robot.guard.refusals for robot in robots), Counter[str]())),
        }
