"""What is known of one robot of a fleet from what is said on the bus."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field

from safedpa.bus.overview.recent import Recent
from safedpa.bus.wire.messages import (
    FindingMessage,
    HealthMessage,
    Message,
    StateMessage,
    SurroundingsMessage,
    VerdictMessage,
)

__all__ = ["RobotOverview"]

_KEPT_LATENCIES = 400
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
    recent_verdicts: Recent = field(default_factory=Recent)
    recent_ticks: Recent = field(default_factory=Recent)
    """Kinds: who chose the action that was in force (``filter``, ``watchdog``, ``none``)."""
    latencies: deque[float] = field(default_factory=lambda: deque(maxlen=_KEPT_LATENCIES))
    """s from publishing a state to accepting its action, as the robot measured it, newest last."""
    new_latencies: list[float] = field(default_factory=list)
    """The same since somebody emptied the list; for histograms."""

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
        told = dict(zip(names, ages, strict=False))
        return {name: told[name] if told.get(name, -1.0) >= 0.0 else None for name in names}

    def latency(self, share: float) -> float | None:
        """The ``share``-quantile of the kept latencies [s]: the smallest one that so many do not exceed."""
        ordered = sorted(self.latencies)
        return ordered[min(len(ordered) - 1, int(share * len(ordered)))] if ordered else None
