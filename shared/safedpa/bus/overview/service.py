"""What is known of one process of a fleet from its heartbeats."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

from safedpa.bus.messages import HealthMessage
from safedpa.bus.overview.recent import RECENT_SECONDS

__all__ = ["ServiceOverview"]


@dataclass
class ServiceOverview:
    """One process, by service and process number; the newest heartbeat about any of its robots tells its counts."""

    health: HealthMessage
    at: float
    """s; when the newest heartbeat came."""
    robots: dict[str, float] = field(default_factory=dict)
    """Robots that it serves, with the time of the newest heartbeat about each; without the one that stands for none."""

    def __post_init__(self) -> None:
        self._steps: deque[tuple[float, int]] = deque([(self.at, self.health.steps)])

    @property
    def name(self) -> str:
        """Of the service."""
        return self.health.service

    def hear(self, message: HealthMessage, at: float) -> None:
        """Takes one more heartbeat."""
        self.health, self.at = message, at
        self._steps.append((at, message.steps))
        while self._steps[0][0] < at - RECENT_SECONDS:
            self._steps.popleft()

    def age(self, now: float) -> float:
        """Seconds since the newest heartbeat."""
        return max(0.0, now - self.at)

    def steps_per_second(self) -> float:
        """Over the last seconds; 0 while there is only one heartbeat."""
        (begin, first), (end, last) = self._steps[0], self._steps[-1]
        return (last - first) / (end - begin) if end > begin else 0.0
