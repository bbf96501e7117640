"""Who hears everything on the bus from next to the proxy, and keeps what a fault is judged by."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf

from safedpa.bus import (
    NO_ROBOT,
    TOPICS,
    ActionMessage,
    Bus,
    HealthMessage,
    LatentMessage,
    Message,
    ModelMessage,
    ReceivedMessage,
    StateMessage,
    TakeoverMessage,
    VerdictMessage,
)

__all__ = ["Observer", "Stamp"]

Stamp = tuple[int, int]
"""(epoch, tick)."""


@dataclass
class Observer:
    """Collects until asked; ``listen`` must be called often. ``robot`` is the one that is judged."""

    bus: Bus
    robot: str
    health: dict[str, tuple[HealthMessage, float]] = field(default_factory=dict)
    """By service: the newest heartbeat and when it came (monotonic, s)."""
    states: dict[Stamp, StateMessage] = field(default_factory=dict)
    verdicts: dict[Stamp, VerdictMessage] = field(default_factory=dict)
    actions: dict[Stamp, set[tuple[float, ...]]] = field(default_factory=dict)
    """All that were sent for a state."""
    latent_models: dict[Stamp, str] = field(default_factory=dict)
    """Fingerprint of the model to which the latent of a state belongs."""
    acknowledged: dict[int, int] = field(default_factory=dict)
    """By process of a recorder: how many messages it said were on the disk."""
    notice: list[tuple[float, ModelMessage | TakeoverMessage]] = field(default_factory=list)
    """When it came (monotonic, s), and every step of every change of the model."""
    heard: dict[Stamp, float] = field(default_factory=dict)
    """When each state came first; monotonic, s."""
    newest: Stamp = (0, -1)

    def __post_init__(self) -> None:
        self._inbox = self.bus.inbox(tuple(TOPICS.values()), keep_all=True)

    def listen(self, wait: float) -> None:
        """Takes in what arrived within ``wait`` [s]."""
        for item in self._inbox.take(wait):
            if isinstance(item, ReceivedMessage) and item.robot in (self.robot, NO_ROBOT):
                self._take(item.message, item.at)

    def lives(self, robot: str, service: str) -> bool:
        """Whether a sign of life of the service is seen now."""
        return bool(self.bus.instances(robot, service))

    def silent_for(self, service: str, now: float) -> float:
        """Seconds since the last heartbeat; infinite before the first."""
        return now - self.health[service][1] if service in self.health else float("inf")

    def _take(self, message: Message, at: float) -> None:
        stamp = (message.epoch, message.tick)
        match message:
            case HealthMessage():
                self.health[message.service] = (message, at)
                if message.service == "recorder":
                    self.acknowledged[message.pid] = message.acknowledged
            case StateMessage():
                self.states[stamp], self.newest = message, stamp
                self.heard.setdefault(stamp, at)
            case VerdictMessage():
                self.verdicts.setdefault(stamp, message)
            case ActionMessage():
                self.actions.setdefault(stamp, set()).add(message.values)
            case LatentMessage():
                self.latent_models[stamp] = message.model
            case ModelMessage() | TakeoverMessage():
                self.notice.append((at, message))
            case _:
                return

    def drives(self, ticks: int, since: float = 0.0, within: float = inf) -> bool:
        """Whether the newest ``ticks`` periods, all later than ``since``, were driven by a filter with all it needs.

        ``within``: s from the first to the last of them at most; a robot that is held up itself lives no period at all.
        """
        epoch, last = self.newest
        recent = [(epoch, tick) for tick in range(last - ticks + 1, last + 1)]
        driven = last >= ticks and all(self.heard.get(one, 0.0) > since and self._driven(one) for one in recent)
        return driven and self.heard[recent[-1]] - self.heard[recent[0]] <= within

    def _driven(self, stamp: Stamp) -> bool:
        state, before = self.states.get(stamp), self.verdicts.get((stamp[0], stamp[1] - 1))
        return state is not None and state.applied_by == "filter" and before is not None and before.status != "fallback"
