"""The whole fleet as one listener knows it: robots by name, processes by service and number."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

from safedpa.bus.overview.robot import RobotOverview
from safedpa.bus.overview.service import ServiceOverview
from safedpa.bus.transport.bus import Bus
from safedpa.bus.transport.inbox import Received
from safedpa.bus.wire.messages import HealthMessage
from safedpa.bus.wire.topics import FINDING, HEALTH, STATE, SURROUNDINGS, VERDICT

__all__ = ["FleetOverview"]

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
    def nobody(self) -> bool:
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
                if isinstance(item, Received):
                    self.hear(item)
                else:
                    self.refused += 1
        self._forget()

    def hear(self, item: Received) -> None:
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
