"""What is known of one process of a fleet from its heartbeats."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

from safedpa.bus.overview.recent import RECENT_SECONDS
from safedpa.bus.wire.messages import HealthMessage

__all__ = ["ServiceOverview"]

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
    kept: dict[str, tuple[HealthMessage, float]] = field(default_factory=dict)
    """By robot (``-``: none): the newest heartbeat about it, and when it came."""

    def __post_init__(self) -> None:
        self._gone_steps = self._gone_stale = self._seen_steps = 0
        self._samples: deque[tuple[float, int]] = deque()

    @property
    def robots(self) -> list[str]:
        """Those that it serves."""
        return [name for name in self.kept if name != "-"]

    @property
    def steps(self) -> int:
        """Of all robots together; never falls while the process lives."""
        return self._gone_steps + sum(message.steps for message, _ in self.kept.values())

    @property
    def stale(self) -> int:
        """Steps without some input, of all robots together; never falls while the process lives."""
        return self._gone_stale + sum(message.stale for message, _ in self.kept.values())

    @property
    def refused(self) -> int:
        """Refused messages: the most that it tells of one robot, those of nobody included; at least so many."""
        return max((message.refused for message, _ in self.kept.values()), default=0)

    @property
    def failing(self) -> HealthMessage | None:
        """A heartbeat that tells of a failure; None while there is none."""
        return next((message for message, _ in self.kept.values() if message.state == "failing"), None)

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
        before = self.kept.get(robot)
        if before is not None and message.publish_time < before[0].publish_time:
            return
        if before is not None and (message.steps < before[0].steps or message.stale < before[0].stale):
            self._remember(before[0])  # the robot began anew, and with it the counts
        elif before is not None:
            self._seen_steps += message.steps - before[0].steps
        self.kept[robot] = (message, at)
        self.health, self.at = message, at
        if not self._samples or at - self._samples[-1][0] >= _SAMPLE_SECONDS:
            self._samples.append((at, self._seen_steps))
        while self._samples[0][0] < at - RECENT_SECONDS:
            self._samples.popleft()

    def forget(self, oldest: float) -> None:
        """Leaves out robots of which it told nothing since ``oldest`` [s]; what was counted for them stays."""
        for robot in [name for name, (_, at) in self.kept.items() if at < oldest]:
            self._remember(self.kept.pop(robot)[0])

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
