"""Many robots in one process, in real time: each senses at its moment of the period and waits for its own action.

A robot's period begins when its state is published. Its action must be there after 0.9 of the period; otherwise the
watchdog brakes and the tick is late. The world moves as soon as the action is known, since an action acts over the
whole period that follows its state. What this process itself is late by is measured apart: a state that goes out late
is a fault of the simulation, not of those who answer it.
"""

from __future__ import annotations

import dataclasses
import heapq
import os
import time
from array import array
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import ceil
from typing import Any, final

from safedpa.bus import ACTION, HEALTH, STATE, Bus, HealthMessage, ReceivedMessage
from safedpa.bus.messages.messages import ActionMessage
from safedpa_sim.robots.robot import SimulatedRobot

__all__ = ["Durations", "FleetLoop"]

_BIN_SECONDS = 1e-5
_BINS = 100_000


@final
class Durations:
    """Counts durations [s] in bins of 10 us up to one second; longer ones stand in the last bin.

    The memory is the same after a second and after a day, which is asked of a process whose memory is watched.
    """

    def __init__(self) -> None:
        self._counts = array("Q", bytes(8 * _BINS))
        self.count = 0
        self.longest = 0.0

    def add(self, seconds: float) -> None:
        """One more; a negative one counts as 0."""
        self._counts[min(max(int(seconds / _BIN_SECONDS), 0), _BINS - 1)] += 1
        self.count += 1
        self.longest = max(self.longest, seconds)

    def percentile(self, share: float) -> float | None:
        """The smallest entry [s] that ``share`` of all do not exceed, rounded up to its bin; None of nothing."""
        wanted, seen = share * self.count, 0
        for index, count in enumerate(self._counts):
            seen += count
            if seen and seen >= wanted:
                return min((index + 1) * _BIN_SECONDS, self.longest)
        return None

    def summary(self) -> dict[str, float | None]:
        """p50, p99, p99.9 and the longest, in microseconds."""
        shares = {"p50": 0.5, "p99": 0.99, "p999": 0.999}
        found = {name: self.percentile(share) for name, share in shares.items()}
        reported = {name: None if value is None else round(1e6 * value) for name, value in found.items()}
        return {**reported, "longest": round(1e6 * self.longest) if self.count else None}


_FEWEST_MOMENTS, _MOST_MOMENTS, _MANY = 2, 5, 300
"""Of a period, at which robots sense where there are several, the fewer the more robots there are: larger bundles cost
less for each robot, and take longer. With two, one half of the fleet moves while the other half is decided about."""
_FEW = 8
"""Robots that have each a moment of their own."""
_DEADLINE_SHARE = 0.9
"""Of the period, after which an action is late."""
_HELD_UP_SHARE = 0.1
"""Of the period, by which a state goes out late before the tick counts as one in which this process was held up."""
_LARGEST_AGE_PERIODS = 2.0
"""An action that would begin to act later than so long after its state was sent is not taken any more."""
_HEARTBEAT_SECONDS = 0.25
_LONGEST_WAIT_SECONDS = 0.1
_CACHED_TICKS = 10
_CACHED_MOMENTS = 10_000
"""Of the newest late ticks, and of the newest actions with how long they took; by the machine's monotonic clock, s."""


@dataclass
class _ScheduledRobot:
    """One robot, and where it is in its period."""

    robot: SimulatedRobot
    due: float
    """s; when its state of this tick should go out."""
    reported_every: int
    """Ticks from one heartbeat to the next."""
    reported_at: int
    """Tick among those in which it is sent: not all robots' at once."""
    published: float = 0.0
    held_up: bool = False
    braked: deque[bool] = field(default_factory=lambda: deque(maxlen=_CACHED_TICKS))
    """Of the newest ticks: whether the watchdog acted."""


def _moments(robots: int) -> int:
    return robots if robots < _FEW else max(_FEWEST_MOMENTS, min(_MOST_MOMENTS, _MANY // robots))


@final
class FleetLoop:
    """Turns ``robots`` by name. With ``in_step`` all sense at the same moment, else spread over the period.

    Where there are many they share two to five moments, and the states of one moment travel in one bundle.
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
        self._turning = {}
        for index, (name, robot) in enumerate(robots.items()):
            due = self._begin + index * self._moments // len(robots) / self._moments * robot.period
            every = max(1, round(_HEARTBEAT_SECONDS / robot.period))
            self._turning[name] = _ScheduledRobot(robot, due, every, index % every)
        self._ready: deque[tuple[str, int]] = deque()
        """Robots whose action of a tick is there, and which have not moved yet."""
        self._events = [(turning.due, name, turning.robot.tick, True) for name, turning in self._turning.items()]
        """When each robot has to sense (True), or when its action of a tick is late."""
        heapq.heapify(self._events)
        self.begin_counting()

    def begin_counting(self) -> None:
        """Forgets what was counted so far: the fleet is warm."""
        self.latency, self.lateness = Durations(), Durations()
        self.ticks = self.late = self.late_held_up = self.held_up = self.overruns = 0
        self.late_of: Counter[str] = Counter()
        self.late_ones: deque[tuple[float, str, int]] = deque(maxlen=_CACHED_MOMENTS)
        self.acted: deque[tuple[float, float]] = deque(maxlen=_CACHED_MOMENTS)
        self._counting_since = self._clock()
        self.collisions: list[dict[str, Any]] = []

    def run(self, stopped: Callable[[], bool], seconds: float) -> None:
        """Turns for ``seconds``, or until ``stopped``."""
        end = self._clock() + seconds
        while not stopped() and self._clock() < end:
            if not self._ready:
                self._take(min(self._next_moment(), end))
            self.turn()

    def turn(self) -> None:
        """Takes actions, senses, brakes where one is late, and moves robots until one has to sense. Never waits."""
        self._take(0.0)
        self._bus.hold()
        sensed = []
        while self._events[0][0] <= self._clock():
            _, name, tick, sensor_inputs = heapq.heappop(self._events)
            turning = self._turning[name]
            if sensor_inputs:
                self._sense(name, turning)
                sensed.append(turning)
            elif turning.robot.tick == tick:
                self._take(0.0)  # what is there already counts
                self._move(name, turning)
        self._bus.flush()
        self._sent(sensed)
        while self._ready and self._events[0][0] > self._clock():
            name, tick = self._ready.popleft()
            if self._turning[name].robot.tick == tick:
                self._move(name, self._turning[name])

    def _next_moment(self) -> float:
        """s; when a robot has to sense, or an action is late: no one wakes up for one that came."""
        events = self._events
        while not events[0][3] and self._turning[events[0][1]].robot.tick != events[0][2]:
            heapq.heappop(events)
        return events[0][0]

    def _sense(self, name: str, turning: _ScheduledRobot) -> None:
        robot = turning.robot
        turning.published = self._clock()
        self._bus.publish(STATE, name, robot.state_message())
        if robot.tick % turning.reported_every == turning.reported_at:
            self._report_health(name, robot)
        heapq.heappush(self._events, (turning.published + _DEADLINE_SHARE * robot.period, name, robot.tick, False))

    def _sent(self, sensed: Sequence[_ScheduledRobot]) -> None:
        """The states are out now: from here they are late, if they are."""
        now = self._clock()
        for turning in sensed:
            self.lateness.add(now - turning.due)
            turning.held_up = now - turning.due > _HELD_UP_SHARE * turning.robot.period

    def _take(self, until: float) -> None:
        """Takes actions; waits for the first one at most until then."""
        wait = min(max(until - self._clock(), 0.0), _LONGEST_WAIT_SECONDS)
        for item in self._inbox.take(wait):
            turning = self._turning.get(item.robot)
            if turning is None:
                continue
            if not isinstance(item, ReceivedMessage) or not isinstance(item.message, ActionMessage):
                turning.robot.guard.refuse("malformed")
            elif turning.robot.receive(item.message) is None:
                self.latency.add(item.at - turning.published)
                self.acted.append((item.at, item.at - turning.published))
                self._ready.append((item.robot, turning.robot.tick))

    def _move(self, name: str, turning: _ScheduledRobot) -> None:
        robot = turning.robot
        late = robot.guard.accepted is None
        if not late and self._clock() - turning.published > _LARGEST_AGE_PERIODS * robot.period:
            robot.guard.withdraw("too old")  # this process was held up
        tick, touched, braked = robot.tick, len(robot.collisions), robot.watchdog_ticks
        robot.advance()
        turning.braked.append(robot.watchdog_ticks > braked)
        for collision in robot.collisions[touched:]:
            about = {"robot": name, **robot.about, "tick": tick, "braked_before": list(turning.braked)}
            self.collisions.append({**about, **dataclasses.asdict(collision)})
        self.ticks += 1
        self.held_up += turning.held_up
        if late:
            self.late += 1
            self.late_held_up += turning.held_up
            self.late_of[name] += 1
            self.late_ones.append((self._clock(), name, tick))
        turning.due += robot.period
        if turning.due < self._clock():  # periods that were slept through are not made up in a hurry
            self.overruns += 1
            apart = robot.period / self._moments
            turning.due = self._begin + ceil((self._clock() - self._begin) / apart) * apart  # with others again
        heapq.heappush(self._events, (turning.due, name, robot.tick, True))

    def _report_health(self, name: str, robot: SimulatedRobot) -> None:
        message = HealthMessage(
            epoch=robot.guard.epoch,
            tick=robot.tick,
            robot_time=robot.tick * robot.period,
            publish_time=time.time(),
            service="robot",
            pid=os.getpid(),
            state="running",
            steps=robot.tick,
            stale=robot.watchdog_ticks,
            refused=sum(robot.guard.refusals.values()),
        )
        self._bus.publish(HEALTH, name, message, "robot")

    def account(self) -> dict[str, Any]:
        """What was counted: robot-ticks, late ones, sense to act and the own lateness in microseconds."""
        robots = [turning.robot for turning in self._turning.values()]
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
