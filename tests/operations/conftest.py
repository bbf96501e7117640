"""A fleet that only talks: messages as its processes would send them, on a bus in memory, at times of our choice."""

import itertools
from dataclasses import dataclass, field
from typing import Any

import pytest

from safedpa.bus import (
    FINDING,
    HEALTH,
    NO_ROBOT,
    ROSTER,
    STATE,
    VERDICT,
    Bus,
    FindingMessage,
    HealthMessage,
    MemoryBroker,
    MemoryTransport,
    RosterEntry,
    RosterMessage,
    StateMessage,
    VerdictMessage,
)
from safedpa.bus.monitor import FleetOverview

LOOP = ("adaptation", "policy", "safety_filter")


@dataclass
class TalkingFleet:
    """Says what a healthy fleet says; ``notice`` changes parts of it. ``now`` [s] is the clock of the listener."""

    now: float = 100.0
    broker: MemoryBroker = field(default_factory=MemoryBroker)
    ticks: dict[str, int] = field(default_factory=dict)
    roster: tuple[RosterEntry, ...] = ()
    """Repeated while the fleet drives, unless the supervisor is silent."""

    def __post_init__(self) -> None:
        self.bus = Bus(MemoryTransport(self.broker), "test")
        self.overview = FleetOverview(Bus(MemoryTransport(self.broker), "test"), clock=lambda: self.now)
        self._counts = itertools.count(1)

    def tick(self, robot: str, *, period: float = 0.05, state: dict[str, Any], verdict: dict[str, Any]) -> None:
        """One state and its verdict, with those fields changed."""
        tick = self.ticks[robot] = self.ticks.get(robot, -1) + 1
        stamp = {"epoch": 7, "tick": tick, "robot_time": tick * period, "publish_time": 1e9 + self.now}
        self.bus.publish(STATE, robot, StateMessage(**{**stamp, **STATE_FIELDS, "period": period, **state}))
        self.bus.publish(VERDICT, robot, VerdictMessage(**{**stamp, **VERDICT_FIELDS, **verdict}))

    def beat(self, service: str, robot: str = "-", pid: int = 0, **changes: Any) -> None:
        """One heartbeat."""
        about = {"epoch": 7, "tick": self.ticks.get(robot, 0), "robot_time": 0.0, "publish_time": 1e9 + self.now}
        known = {"service": service, "pid": pid or 1000 + len(service), "state": "running", "software": "1.2.3"}
        steps = {"steps": next(self._counts), "step_microseconds": 150.0}
        self.bus.publish(HEALTH, robot, HealthMessage(**{**about, **known, **steps, **changes}), service)

    def list_members(self, *entries: RosterEntry, **fields: Any) -> None:
        """A roster of the supervisor, or with ``fields`` a dismissal."""
        self.roster = entries
        stamp = {"epoch": 0, "tick": 0, "robot_time": 0.0, "publish_time": 1e9 + self.now}
        self.bus.publish(ROSTER, NO_ROBOT, RosterMessage(**stamp, **{"source": "run", "entries": entries, **fields}))
        self.overview.listen(0.0)

    def finding(self, robot: str, stage: str, sentence: str) -> None:
        """What the diagnosis says."""
        stamp = {"epoch": 7, "tick": 0, "robot_time": 0.0, "publish_time": 0.0}
        reported = {"error": 0.3, "band": 0.1, "evidence": 14.0, "threshold": 13.8, "coverage": 0.9, "where": ""}
        message = FindingMessage(**stamp, **reported, model="0123456789ab", stage=stage, sentence=sentence, number=1)
        self.bus.publish(FINDING, robot, message)

    def drive(self, robots: int, seconds: float = 2.0, *, silent: tuple[str, ...] = (), **changes: Any) -> None:
        """Lets so many robots drive: twenty ticks and four heartbeats a second; ``silent`` services send none.

        ``changes`` are by robot: ``{"state": {...}, "verdict": {...}}``.
        """
        for quarter in range(round(4 * seconds)):
            for number in range(1, robots + 1):
                name = f"r{number}"
                changed = changes.get(name, {})
                for _ in range(5):
                    self.now += 0.05 / robots
                    self.tick(name, state=changed.get("state", {}), verdict=changed.get("verdict", {}))
                for service in LOOP:
                    if service not in silent:
                        self.beat(service, name, model="0123456789ab")
                self.beat("robot", name, pid=2000 + number, latencies=(0.0031, 0.0042))
            if "recorder" not in silent and quarter % 2 == 0:
                self.beat("recorder", acknowledged=40, free_bytes=50_000_000_000)
            if self.roster and "supervisor" not in silent:
                self.list_members(*self.roster)
            self.overview.listen(0.0)


STATE_FIELDS: dict[str, Any] = {
    "values": (0.5, 0.0, 0.0, 1.0),
    "applied": (1.0, 0.0),
    "applied_by": "filter",
    "lockstep": False,
    "goal": (2.0, 0.0),
    "obstacles": (),
    "field": (-4.0, 4.0, -4.0, 4.0),
    "footprint": (0.08, 0.4, 0.12),
}
VERDICT_FIELDS: dict[str, Any] = {
    "status": "passed",
    "sentence": "The nominal action satisfies every barrier condition and is handed on unchanged.",
    "action": (1.0, 0.0),
    "nominal": (1.0, 0.0),
    "slack": 0.0,
    "active": (),
    "h_now": 0.6,
    "h_next": 0.6,
    "margin": 0.02,
    "solver": "not needed",
    "microseconds": 60.0,
    "coverage": 0.995,
    "promised": 0.99,
}


@pytest.fixture
def fleet() -> TalkingFleet:
    """A fleet that has sent nothing yet."""
    return TalkingFleet()
